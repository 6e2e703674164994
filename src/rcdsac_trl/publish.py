"""Ship agents with the package: ``python -m rcdsac_trl.publish runs=[<folder>,..]``."""

from omegaconf import DictConfig

from rcdsac_trl.cli import entry_point


def check(cfg: DictConfig) -> None:
    """Refuse what cannot work, before anything is written."""
    from rcdsac_trl.release.make_publication import make_publication

    make_publication(cfg)


@entry_point("publish", check=check)
def main(cfg: DictConfig) -> None:
    """Write each agent's weights, card and tables."""
    from rcdsac_trl.release.make_publication import make_publication
    from rcdsac_trl.report.card import driving_section

    for line in make_publication(cfg).run(driving_section):
        print(line)


if __name__ == "__main__":
    main()
