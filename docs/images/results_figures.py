"""Draw beta_response.png, beta_response_cvar.png and differences_collisions.png, of what results/ holds.

python docs/images/results_figures.py
"""

from pathlib import Path

from matplotlib.figure import Figure

from rcdsac_trl.report.comparison_figures import paired_differences
from rcdsac_trl.report.read import read_episodes
from rcdsac_trl.report.response_figures import beta_response

HERE = Path(__file__).parent
RESULTS = HERE.parents[1] / "results"
REFERENCE = "sac"
# Agents first, then what they are compared with; others behind them.
ORDER = ("rcdsac_pow", "rcdsac_cvar", "dsac", "rcwr", "sac", "pursuit")


def place(run: Path) -> int:
    """Return where a run stands in the order."""
    return next((i for i, name in enumerate(ORDER) if run.name.startswith(name)), len(ORDER))


def main() -> None:
    """Read, draw."""
    # An agent or a baseline a folder; those of the study lie deeper, or are called otherwise.
    narrow = sorted(RESULTS.glob("*-narrow"), key=lambda run: (place(run), run))
    episodes = read_episodes(narrow)
    of_both_sensors = read_episodes([*narrow, *sorted(RESULTS.glob("*-sparse"))])
    reference = episodes.conditions["agent"].tolist().index(REFERENCE)
    figures: dict[str, Figure | None] = {
        "beta_response": beta_response(of_both_sensors, "pow"),
        "beta_response_cvar": beta_response(of_both_sensors, "cvar"),
        "differences_collisions": paired_differences(episodes, reference, "collisions"),
    }
    for name, figure in figures.items():
        if figure is None:
            raise SystemExit(f"{name}.png: results/ has no agent that was driven at two betas")
        figure.savefig(HERE / f"{name}.png", dpi=130)


if __name__ == "__main__":
    main()
