"""Search for better hyper-parameters: ``python -m rcdsac_trl.search +algo=rcdsac_pow search.name=mine``."""

from rcdsac_trl.cli import OverridesCommand

main = OverridesCommand("search", "rcdsac_trl.experiments.optuna_search:make_search")

if __name__ == "__main__":
    main()
