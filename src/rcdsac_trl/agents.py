"""List the agents that are there to be loaded: ``python -m rcdsac_trl.agents [<agent> ..]``."""

import sys

from rcdsac_trl.cli import Command
from rcdsac_trl.config.command_line import with_names

_agents = Command("agents", "rcdsac_trl.release.agent_list:make_agent_list")


def main() -> None:
    """Do what ``python -m rcdsac_trl.agents`` does."""
    sys.argv[1:] = with_names("agents", sys.argv[1:])
    _agents()


if __name__ == "__main__":
    main()
