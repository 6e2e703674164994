"""Train an agent: ``python -m rcdsac_trl.train +algo=rcdsac_pow``."""

from omegaconf import DictConfig

from rcdsac_trl.pipeline.cli import entry_point


def check(cfg: DictConfig) -> None:
    """Refuse what cannot work, before anything is written."""
    from rcdsac_trl.pipeline import build

    build.check_training(cfg)


@entry_point("train", check=check)
def main(cfg: DictConfig) -> None:
    """Train one agent; the run folder is Hydra's output folder."""
    from rcdsac_trl.pipeline import build

    build.trainer(cfg, build.run_folder()).run()


if __name__ == "__main__":
    main()
