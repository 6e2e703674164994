"""Train an agent: ``python -m rcdsac_trl.train +algo=rcdsac_pow``; go on: ``.. resume=runs/<folder>``; many: ``-m``."""

from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from rcdsac_trl.pipeline.cli import entry_point

if TYPE_CHECKING:
    from rcdsac_trl.pipeline.trainer import Trainer


def check(cfg: DictConfig) -> None:
    """Refuse what cannot work, before anything is written."""
    from rcdsac_trl.pipeline import build

    build.check_training(cfg)


def check_folder(folder: Path) -> None:
    """Refuse a folder that already holds a run, before Hydra makes it."""
    from rcdsac_trl.pipeline import logs

    logs.check_folder(folder)


def sweep_or_continue(overrides: list[str], multirun: bool) -> bool:
    """Run a sweep, or continue a run, if the call asks for that; return whether it did. Hydra has no part in either."""
    from rcdsac_trl.pipeline import build

    if multirun:
        build.sweep(overrides).run()
        return True
    build.check_single(overrides)
    folder = build.run_to_continue(overrides)
    if folder is None:
        return False
    trainer = build.resumed(folder)
    if trainer is None:
        print(f"{folder} is finished: nothing is left to do")
    else:
        _run(trainer)
    return True


@entry_point("train", check=check, check_folder=check_folder, instead=sweep_or_continue)
def main(cfg: DictConfig) -> None:
    """Train one agent; the run folder is Hydra's output folder."""
    from rcdsac_trl.pipeline import build

    _run(build.trainer(cfg, build.run_folder(), build.given_overrides()))


def _run(trainer: "Trainer") -> None:
    from rcdsac_trl.pipeline.interrupts import at_safe_points

    with at_safe_points():
        trainer.run()


if __name__ == "__main__":
    main()
