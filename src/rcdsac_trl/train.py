"""Train an agent: ``python -m rcdsac_trl.train +algo=rcdsac_pow``; go on: ``.. resume=runs/<folder>``; many: ``-m``."""

from pathlib import Path
from typing import TYPE_CHECKING

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from rcdsac_trl.cli import entry_point, late
from rcdsac_trl.config.command_line import SEARCHPATH, key_of

if TYPE_CHECKING:
    from rcdsac_trl.training.trainer import Trainer


def sweep_or_continue(overrides: list[str], multirun: bool) -> bool:
    """Run a sweep, or continue a run, if the call asks for that; return whether it did. Hydra has no part in either."""
    # Each imported as it is needed: a mistake is told before torch is imported.
    from rcdsac_trl.experiments.sweep_jobs import check_single, make_sweep
    from rcdsac_trl.training.resume import run_to_continue

    if multirun:
        make_sweep(overrides).run()
        return True
    check_single(overrides)
    folder = run_to_continue(overrides)
    if folder is None:
        return False
    from rcdsac_trl.training.setup import resume_training

    trainer = resume_training(folder)
    if trainer is None:
        print(f"{folder} is finished: nothing is left to do")
        _lead_on(folder)
    else:
        _run(trainer)
    return True


@entry_point(
    "train",
    look=late("rcdsac_trl.config.run_config:settings_of_new_run"),
    check_folder=late("rcdsac_trl.training.run_folder:check_folder"),
    check=late("rcdsac_trl.training.setup:check_training"),
    instead=sweep_or_continue,
)
def main(cfg: DictConfig) -> None:
    """Train one agent; the run folder is Hydra's output folder."""
    from rcdsac_trl.training.setup import make_trainer

    job = HydraConfig.get()
    # Without the folders in which Hydra looked, nobody could read the others again.
    looked_in = [override for override in job.overrides.hydra if key_of(override) == SEARCHPATH]
    _run(make_trainer(cfg, Path(job.runtime.output_dir), [*looked_in, *job.overrides.task]))


def _run(trainer: "Trainer") -> None:
    from rcdsac_trl.system.interrupts import at_safe_points

    with at_safe_points():
        trainer.run()
    if trainer.is_finished:
        _lead_on(trainer.log.folder)


def _lead_on(folder: Path) -> None:
    """Say what to do with a finished run, in lines to be copied."""
    from rcdsac_trl.config.command_line import assigned
    from rcdsac_trl.system.invocation import from_here, program

    run = assigned("run", from_here(folder))
    print(f"next: {program()} evaluate {run}\n      {program()} plot_training {run}")


if __name__ == "__main__":
    main()
