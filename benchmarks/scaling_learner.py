"""How an update's duration grows with what one may turn: sequences, steps and quantile fractions.

``python benchmarks/scaling_learner.py`` writes ``results/scaling_learner.json``, of which
``docs/images/scaling_figures.py`` draws ``scaling_learner.png``.
"""

import argparse
from pathlib import Path
from typing import Any

from rcdsac_trl.system import runtime

RESULT = Path(__file__).parents[1] / "results" / "scaling_learner.json"
#: The laptop's mini-batch, one of whose sizes is turned.
CENTRE = {"learner.batch_size": 32, "learner.sequence_length": 8, "quantiles": 16}
LEARNER = {
    "learner.batch_size": [8, 16, 32, 64, 128],
    "learner.sequence_length": [4, 8, 16, 32],
    "quantiles": [1, 4, 8, 16, 32],
}
TURNS = 7


def learner_curves() -> dict[str, dict[int, float]]:
    """Return seconds an update for every size; all sizes take turns, the least of a size's turns counts."""
    from bench_common import make_learner, seconds

    runtime.set_threads(1)
    learners = {}
    for key, values in LEARNER.items():
        for value in values:
            sizes = CENTRE | {key: value}
            number = sizes.pop("quantiles")
            fractions = [f"learner.num_{kind}={number}" for kind in ("quantiles", "target_quantiles", "risk_samples")]
            overrides = [f"{name}={size}" for name, size in sizes.items()]
            learners[key, value] = make_learner("rcdsac_pow", ["preset=laptop", "threads=1", *overrides, *fractions])
    took: dict[tuple[str, int], list[float]] = {size: [] for size in learners}
    for turn in range(TURNS + 1):
        for size, learner in learners.items():
            duration = seconds(learner.update, 1)
            if turn:  # the first one makes what is kept
                took[size].append(duration)
    return {key: {value: min(took[key, value]) for value in values} for key, values in LEARNER.items()}


def learner(arguments: argparse.Namespace) -> None:
    """Measure the learner's curves."""
    from bench_common import report

    curves = learner_curves()
    result: dict[str, Any] = {key: {str(size): value for size, value in curve.items()} for key, curve in curves.items()}
    lines = [f"{key}={size}: {1e3 * value:.1f} ms" for key, curve in curves.items() for size, value in curve.items()]
    report(result, "\n".join(lines), as_json=arguments.json, out=arguments.out)


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of lines")
    parser.add_argument("--out", type=Path, default=RESULT, help="file to write the JSON object to as well")
    arguments = parser.parse_args()
    runtime.keep_pages()
    runtime.quiet_libraries()
    learner(arguments)


if __name__ == "__main__":
    main()
