"""Export an agent for a robot: ``python -m rcdsac_trl.export run=<folder or shipped agent>``."""

from rcdsac_trl.cli import Command

main = Command(
    "export",
    "rcdsac_trl.release.agent_export:make_export",
    look="rcdsac_trl.config.first_look:look_at_export",
)

if __name__ == "__main__":
    main()
