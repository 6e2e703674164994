"""Hold the critics' quantiles against what happens: ``python -m rcdsac_trl.calibrate run=<agent> beta=[-2,-1]``."""

from rcdsac_trl.cli import Command

main = Command(
    "calibrate",
    "rcdsac_trl.evaluation.calibration:make_calibration",
    describe="rcdsac_trl.report.calibration_report:write_calibration",
    look="rcdsac_trl.config.first_look:look_at_calibration",
)

if __name__ == "__main__":
    main()
