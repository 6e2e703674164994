"""Hold the critics' quantiles against what happens: ``python -m rcdsac_trl.calibrate run=<folder> beta=[-2,-1]``."""

from omegaconf import DictConfig

from rcdsac_trl.cli import entry_point


def check(cfg: DictConfig) -> None:
    """Refuse what cannot work, before anything is written."""
    from rcdsac_trl.evaluation.make_calibration import make_calibration

    make_calibration(cfg)


@entry_point("calibrate", check=check)
def main(cfg: DictConfig) -> None:
    """Roll out, write states and returns, then what they say and a picture of it."""
    from rcdsac_trl.evaluation.make_calibration import make_calibration
    from rcdsac_trl.report.calibration_report import write_calibration

    calibration = make_calibration(cfg)
    calibration.run()
    print(write_calibration(calibration.results.path))
    print(f"written to {calibration.results.path}")


if __name__ == "__main__":
    main()
