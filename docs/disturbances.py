"""Drive agents and planners while noise, delay, clutter or people disturb them, for the table of docs/off-the-maps.md.

Each disturbance is one evaluation on the same maps, goals and movers; `--name`'s go into ``results/disturbances``.
What has been driven already, in ``build/disturbances``, is not driven again::

    python docs/disturbances.py --name rcdsac_cvar-narrow run=rcdsac_cvar-narrow beta=[0.25]
    python docs/disturbances.py --name mppi baseline=mppi
    make tables

With ``--tell-latency`` an agent is told how late its commands act where they are delayed, as a robot's can be.
"""

import argparse
import zlib
from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from rcdsac_trl.config.compose import compose
from rcdsac_trl.evaluation.evaluation import make_evaluation

ROOT = Path(__file__).resolve().parents[1]
DISTURBANCES: Mapping[str, tuple[str, ...]] = {
    "none": (),
    "ranges: 2 cm noise, 5 % lost": ("task.range_noise_std_m=0.02", "task.range_dropout=0.05"),
    "pose: off by 15 cm and 2.3 degrees": ("task.pose_noise_std=[0.15,0.04]",),
    "delay: one period": ("task.action_delay_steps=1",),
    "delay: two periods": ("task.action_delay_steps=2",),
    "motors: a fifth slower": ("task.motor_slowness=0.2",),
    "clutter: twice as dense": ("map.clutter_per_m2=0.14",),
    "movers: eight instead of four": ("map.num_movers=8",),
    "movers: they do not yield": ("map.yielding_fraction=0",),
}
"""Name to overrides of the evaluation's config."""

LATENCY_S: Mapping[str, float] = {"delay: one period": 0.14, "delay: two periods": 0.28}
"""What an agent can be told of a disturbance, s: so many mean control periods."""

COLUMNS = ("map", "episode", "collisions", "reward")
"""What is kept of an episode, besides the disturbance."""


def main() -> None:
    """Drive what is not driven yet, and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--name", required=True, help="of the file in results/disturbances, and in the table")
    parser.add_argument("--maps", type=int, default=20, help="evaluation maps (default: %(default)s)")
    parser.add_argument("--episodes", type=int, default=5, help="on each of them (default: %(default)s)")
    parser.add_argument("--tell-latency", action="store_true", help="delayed commands: the agent knows it")
    parser.add_argument("overrides", nargs="+", help="whom evaluate drives: run=<agent> beta=[<one>], baseline=<name>")
    options = parser.parse_args()
    done = ROOT / "build" / "disturbances"
    tables = []
    for disturbance, changes in DISTURBANCES.items():
        if options.tell_latency and disturbance in LATENCY_S:
            changes = (*changes, f"latency_s={LATENCY_S[disturbance]}")
        asked = [*options.overrides, *changes, f"num_maps={options.maps}", f"num_episodes={options.episodes}"]
        folder = done / f"{options.name}-{zlib.crc32(' '.join(asked).encode()):08x}"
        if not (folder / "episodes.csv").is_file():
            make_evaluation(compose("evaluate", [*asked, f"out={folder}"])).run()
        episodes = pd.read_csv(folder / "episodes.csv")[list(COLUMNS)]
        tables.append(episodes.assign(disturbance=disturbance))
    target = ROOT / "results" / "disturbances" / f"{options.name}.csv"
    target.parent.mkdir(parents=True, exist_ok=True)
    pd.concat(tables)[["disturbance", *COLUMNS]].to_csv(target, index=False, float_format="%.6g")


if __name__ == "__main__":
    main()
