"""How speed grows with what one may turn: one plot a curve.

``python benchmarks/scaling_learner.py`` draws updates per second against sequences, steps and quantile fractions into
``docs/images/scaling_learner.png``; ``--json`` prints the numbers.
"""

import argparse
from pathlib import Path
from typing import Any

from rcdsac_trl.colors import LIGHT
from rcdsac_trl.system import runtime

IMAGES = Path(__file__).parents[1] / "docs" / "images"
#: The laptop's mini-batch, one of whose sizes is turned.
CENTRE = {"learner.batch_size": 32, "learner.sequence_length": 8, "quantiles": 16}
LEARNER = {
    "learner.batch_size": ("sequences of a mini-batch", [8, 16, 32, 64, 128]),
    "learner.sequence_length": ("transitions of a sequence", [4, 8, 16, 32]),
    "quantiles": ("quantile fractions, N = N' = K", [1, 4, 8, 16, 32]),
}
TURNS = 7


def learner_curves() -> dict[str, dict[int, float]]:
    """Return seconds an update for every size; all sizes take turns, the least of a size's turns counts."""
    from bench_common import make_learner, seconds

    runtime.set_threads(1)
    learners = {}
    for key, (_, values) in LEARNER.items():
        for value in values:
            sizes = CENTRE | {key: value}
            number = sizes.pop("quantiles")
            fractions = [f"learner.num_{kind}={number}" for kind in ("quantiles", "target_quantiles", "risk_samples")]
            overrides = [f"{name}={size}" for name, size in sizes.items()]
            learners[key, value] = make_learner("rcdsac_pow", ["preset=laptop", *overrides, *fractions])
    took: dict[tuple[str, int], list[float]] = {size: [] for size in learners}
    for turn in range(TURNS + 1):
        for size, learner in learners.items():
            duration = seconds(learner.update, 1)
            if turn:  # the first one makes what is kept
                took[size].append(duration)
    return {key: {value: min(took[key, value]) for value in values} for key, (_, values) in LEARNER.items()}


def draw(curves: dict[str, dict[int, float]], labels: dict[str, str], path: Path) -> None:
    """Draw milliseconds an update against every size, and what it would be in proportion to the size."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(curves), figsize=(4.0 * len(curves), 3.2), sharey=True, layout="constrained")
    for axis, (key, curve) in zip(axes, curves.items(), strict=True):
        sizes, times = list(curve), [1e3 * value for value in curve.values()]
        proportional = [times[-1] * size / sizes[-1] for size in sizes]
        axis.loglog(sizes, times, "o-", color=LIGHT.accent, label="measured", base=2)
        axis.loglog(sizes, proportional, ":", color=LIGHT.faint, label="proportional", base=2)
        axis.set_xticks(sizes, [str(size) for size in sizes])
        axis.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axis.set_xlabel(labels[key])
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("milliseconds an update")
    axes[0].legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def learner(arguments: argparse.Namespace) -> None:
    """Measure and draw the learner's curves."""
    from bench_common import report

    curves = learner_curves()
    draw(curves, {key: label for key, (label, _) in LEARNER.items()}, IMAGES / "scaling_learner.png")
    result: dict[str, Any] = {key: {str(size): value for size, value in curve.items()} for key, curve in curves.items()}
    lines = [f"{key}={size}: {1e3 * value:.1f} ms" for key, curve in curves.items() for size, value in curve.items()]
    report(result, "\n".join(lines), as_json=arguments.json, out=arguments.out)


def main() -> None:
    """Read the command line, measure and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of lines")
    parser.add_argument("--out", type=Path, help="also write the JSON object to this file")
    arguments = parser.parse_args()
    runtime.keep_pages()
    runtime.quiet_libraries()
    learner(arguments)


if __name__ == "__main__":
    main()
