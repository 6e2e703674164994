"""Evaluate an agent on unseen maps: ``python -m rcdsac_trl.evaluate run=<folder or shipped agent> beta=[-2,-1]``."""

from rcdsac_trl.cli import Command

main = Command(
    "evaluate",
    "rcdsac_trl.evaluation.evaluation:make_evaluation",
    describe="rcdsac_trl.report.barn_report:describe_evaluation",
    look="rcdsac_trl.config.first_look:look_at_evaluation",
)

if __name__ == "__main__":
    main()
