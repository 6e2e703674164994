"""Evaluate an agent on unseen maps: ``python -m rcdsac_trl.evaluate run=<folder> beta=[-2,-1]``."""

from omegaconf import DictConfig

from rcdsac_trl.cli import entry_point


def check(cfg: DictConfig) -> None:
    """Refuse what cannot work, before anything is written."""
    from rcdsac_trl.evaluation.make_evaluation import make_evaluation

    make_evaluation(cfg)


@entry_point("evaluate", check=check)
def main(cfg: DictConfig) -> None:
    """Drive the episodes, write one row each and a summary."""
    from rcdsac_trl.evaluation.make_evaluation import make_evaluation

    make_evaluation(cfg).run()


if __name__ == "__main__":
    main()
