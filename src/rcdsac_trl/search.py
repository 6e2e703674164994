"""Search for better hyper-parameters: ``python -m rcdsac_trl.search +algo=rcdsac_pow search.name=mine``."""

from rcdsac_trl.cli import overrides_entry_point


@overrides_entry_point("search")
def main(overrides: list[str]) -> None:
    """Train one trial after another; beside others, if the same call runs elsewhere."""
    from rcdsac_trl.experiments.make_search import make_search

    make_search(overrides).run()


if __name__ == "__main__":
    main()
