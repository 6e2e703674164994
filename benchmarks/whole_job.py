"""What a training costs beyond its parts: the wall time of a short real run against what its two lanes need.

The run is the command's own: `preset=laptop` with fewer iterations of a fifth of the length, so that collection,
updates and validation are as long for each other as there. It runs twice: validating in place, which times every part
by itself, and as configured, with validation beside training where there is a core for it. The lanes are training
(collection, replay, updates, checkpoints) and all validations but the last, which nothing is left to run beside.
"""

import contextlib
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bench_world as bench

# Imports, compiled code and caches, so that neither run pays for them.
WARM_UP = [
    "schedule.iterations=1",
    "schedule.updates_per_iteration=2",
    "task.episode_steps=20",
    "validation.num_maps=1",
]
SHORTER = [
    "threads=1",  # the other core is validation's, so that lanes add up
    "task.episode_steps=200",
    "schedule.updates_per_iteration=80",
    *(f"schedule.{name}_iterations=1" for name in ("pursuit", "neutral", "ramp", "decay")),
]


class Clock:
    """Adds up how long the calls of a function take."""

    def __init__(self, call: Callable[..., Any]) -> None:
        self.call = call
        self.seconds: list[float] = []

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        started = time.perf_counter()
        try:
            return self.call(*args, **kwargs)
        finally:
            self.seconds.append(time.perf_counter() - started)


def run(overrides: list[str]) -> dict[str, float]:
    """Train, and return the seconds of the whole and of its parts.

    Args:
        overrides: of train's config.
    """
    from rcdsac_trl.config.compose import compose
    from rcdsac_trl.training.setup import make_trainer

    started = time.perf_counter()
    # The run's own messages are not results.
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(sys.stderr):
        trainer = make_trainer(compose("train", overrides), Path(folder) / "run")
        startup = time.perf_counter() - started
        timed = {
            "collection": (trainer.episodes, "collect"),
            "replay_insertion": (trainer.learner.replay, "add_episodes"),
            "updates": (trainer.learner, "updates"),
            "checkpoints": (trainer.checkpoints, "save"),
            "validation": (trainer.validation.evaluator, "finish"),  # in place all of it, else the wait
        }
        clocks = {name: Clock(getattr(owner, call)) for name, (owner, call) in timed.items()}
        for name, (owner, call) in timed.items():
            setattr(owner, call, clocks[name])
        cpu = time.process_time()
        wall = bench.wall_seconds(trainer.run)
        cpu = time.process_time() - cpu
    seconds = {name: sum(clock.seconds) for name, clock in clocks.items()}
    return {"startup": startup, "wall": wall, "cpu": cpu, "last_validation": clocks["validation"].seconds[-1]} | seconds


def main() -> None:
    parser = bench.parser(__doc__)
    parser.add_argument("--iterations", type=int, default=16, help="iterations of each run; every sixth validates")
    parser.add_argument("overrides", nargs="*", default=[], help="further keys of conf/train.yaml, as key=value")
    options = parser.parse_args()
    bench.prepare()
    given = ["+algo=rcdsac_pow", *SHORTER, f"schedule.iterations={options.iterations}", *options.overrides]
    run([*given, *WARM_UP, "validation.processes=0"])
    alone = run([*given, "validation.processes=0"])
    beside = run(given)
    training = sum(alone[name] for name in ("collection", "replay_insertion", "updates", "checkpoints"))
    validation = alone["validation"] - alone["last_validation"]
    one_core = len(bench.cores()) == 1
    lanes = (training + validation if one_core else max(training, validation)) + alone["last_validation"]
    results: dict[str, Any] = {"cores": len(bench.cores())}
    results |= {f"{name}_seconds": value for name, value in alone.items() if name not in ("cpu", "wall")}
    results |= {
        "training_lane_seconds": training,
        "validation_lane_seconds": validation,
        "in_place_wall_seconds": alone["wall"],
        "in_place_overhead": alone["wall"] / (training + alone["validation"]) - 1.0,
        "wall_seconds": beside["wall"],
        "lanes_seconds": lanes,
        "overhead": beside["wall"] / lanes - 1.0,
        "wall_over_in_place": beside["wall"] / alone["wall"],
        # Of the training process alone, which other programs on the cores do not change.
        "processor_time_over_in_place": beside["cpu"] / alone["cpu"],
    }
    bench.report(results, options)


if __name__ == "__main__":
    main()
