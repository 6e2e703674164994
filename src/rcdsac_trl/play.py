"""Play: ``python -m rcdsac_trl.play`` opens a page on which a robot drives while you turn beta."""

import os

from rcdsac_trl.cli import Command

command = Command(
    "play",
    "rcdsac_trl.playground.play_session:make_session",
    look="rcdsac_trl.config.first_look:look_at_play",
)


def main() -> None:
    """Do what ``python -m rcdsac_trl.play`` does."""
    # Critics are asked of a hundred actions at a time, in a thread a page: BLAS on several cores would only be slower.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    command()


if __name__ == "__main__":
    main()
