"""Export an agent for a robot: ``python -m rcdsac_trl.export run=<folder>``."""

from omegaconf import DictConfig

from rcdsac_trl.cli import entry_point


def check(cfg: DictConfig) -> None:
    """Refuse what cannot work, before anything is written."""
    from rcdsac_trl.release.agent_export import make_export

    make_export(cfg)


@entry_point("export", check=check)
def main(cfg: DictConfig) -> None:
    """Write weights, ONNX and torch programs, once they are seen to agree."""
    from rcdsac_trl.release.agent_export import make_export

    export = make_export(cfg)
    export.run()
    print(f"wrote {export.out}")


if __name__ == "__main__":
    main()
