"""Draw learning_study.png: earlier agents' training episodes, over updates and over minutes of one idle core."""

from pathlib import Path

import pandas as pd

from rcdsac_trl.colors import LIGHT
from rcdsac_trl.report.learning_figures import learning_curves

RESULTS = Path(__file__).parents[2] / "results" / "rules-1"
# Iterations that make one point: 150 episodes a seed.
TOGETHER = 15
UPDATES_PER_ITERATION = 200
# An iteration's seconds on an idle core (docs/study.md), and the seeds' folders.
RUNS = {
    "power law, 8 stratified fractions": (16.8, ["rcdsac_pow-narrow", "seed-1/rcdsac_pow-narrow"]),
    "power law, 16 independent": (19.3, ["16-fractions/rcdsac_pow-narrow", "16-fractions/seed-1/rcdsac_pow-narrow"]),
    "SAC": (14.0, ["sac-narrow", "sac-240-iterations/sac-narrow"]),
}

curves = {}
for name, (seconds, folders) in RUNS.items():
    rows = pd.concat(pd.read_csv(RESULTS / folder / "training_episodes.csv") for folder in folders)
    done = (rows["iteration"] // TOGETHER + 1) * TOGETHER
    curves[name] = rows.assign(updates=UPDATES_PER_ITERATION * done, elapsed_s=seconds * done)
figure = learning_curves(curves)
figure.suptitle(
    "Earlier agents, under rules 1: training episodes, with exploration, at every β; both seeds",
    x=0.01,
    ha="left",
    fontsize=13,
    color=LIGHT.ink,
)
figure.savefig(Path(__file__).with_suffix(".png"), dpi=130)
