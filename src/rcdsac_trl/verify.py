"""Measure agents again and hold their cards against it: ``python -m rcdsac_trl.verify [<agent> ..] seed=1``."""

import sys

from rcdsac_trl.cli import Command
from rcdsac_trl.config.command_line import with_names

_verify = Command(
    "verify",
    "rcdsac_trl.evaluation.verification:make_verification",
    describe="rcdsac_trl.report.verification_report:verified",
    look="rcdsac_trl.config.first_look:look_at_verification",
)


def main() -> None:
    """Do what ``python -m rcdsac_trl.verify`` does."""
    sys.argv[1:] = with_names("agents", sys.argv[1:])
    _verify()


if __name__ == "__main__":
    main()
