"""Ask an agent what it would have done over a recording: ``python -m rcdsac_trl.replay recording=<bag or CARMEN log>``.

The recording may also stand first without its key: ``python -m rcdsac_trl.replay drive.mcap beta=-1``.
"""

import sys
from collections.abc import Sequence

from rcdsac_trl.cli import Command

_replay = Command(
    "replay",
    "rcdsac_trl.evaluation.replay_run:make_replay",
    describe="rcdsac_trl.report.replay_report:write_replay",
    look="rcdsac_trl.config.first_look:look_at_replay",
)


def with_key(arguments: Sequence[str]) -> list[str]:
    r"""Put the key before a recording that stands first without it.

    Example:
        >>> with_key(["a bag.mcap", "beta=-1"])
        ['recording="a bag.mcap"', 'beta=-1']
        >>> with_key(["recording=x.bag"]), with_key(["--help"])
        (['recording=x.bag'], ['--help'])
    """
    first, *others = arguments or [""]
    if not first or first.startswith("-") or "=" in first:
        return list(arguments)
    escaped = first.replace("\\", "\\\\").replace('"', '\\"')
    return [f'recording="{escaped}"', *others]


def main() -> None:
    """Do what ``python -m rcdsac_trl.replay`` does."""
    sys.argv[1:] = with_key(sys.argv[1:])
    _replay()


if __name__ == "__main__":
    main()
