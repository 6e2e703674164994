"""Ship agents with the package: ``python -m rcdsac_trl.publish runs=[<folder>,..]``."""

from rcdsac_trl.cli import Command

main = Command(
    "publish",
    "rcdsac_trl.release.publication:make_publication",
    describe="rcdsac_trl.report.card:measured_values",
    look="rcdsac_trl.config.first_look:look_at_publication",
)

if __name__ == "__main__":
    main()
