"""What a training costs beyond its parts: the wall time of a short real run over collection, updates and the rest.

The run is the command's own: `preset=laptop` with fewer and shorter iterations, so that everything that happens once
in some iterations (validation, checkpoints) happens here as often for its length as there.
"""

import contextlib
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bench_world as bench


class Clock:
    """Adds up how long the calls of a function take."""

    def __init__(self, call: Callable[..., Any]) -> None:
        self.call = call
        self.seconds = 0.0

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        started = time.perf_counter()
        try:
            return self.call(*args, **kwargs)
        finally:
            self.seconds += time.perf_counter() - started

    def __getattr__(self, name: str) -> Any:
        return getattr(self.call, name)


def main() -> None:
    parser = bench.parser(__doc__)
    parser.add_argument("--iterations", type=int, default=6, help="iterations of the run")
    parser.add_argument("overrides", nargs="*", default=[], help="further keys of conf/train.yaml, as key=value")
    options = parser.parse_args()
    bench.prepare()
    from rcdsac_trl.pipeline import build
    from rcdsac_trl.pipeline.cli import compose

    shorter = [f"schedule.{name}_iterations=1" for name in ("pursuit", "neutral", "ramp", "decay")]
    given = ["+algo=rcdsac_pow", *shorter, f"schedule.iterations={options.iterations}", *options.overrides]
    started = time.perf_counter()
    # The run's own messages are not results.
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(sys.stderr):
        trainer = build.trainer(compose("train", given), Path(folder) / "run")
        startup = time.perf_counter() - started
        parts = {
            "updates": Clock(trainer.learner.updates),
            "validation": Clock(trainer.validate),
            "checkpoints": Clock(trainer.checkpoints.save),
            "collection": Clock(trainer.episodes.collect),
            "replay_insertion": Clock(trainer.learner.replay.add_episodes),
        }
        trainer.learner.updates = parts["updates"]
        trainer.validate = parts["validation"]
        trainer.checkpoints.save = parts["checkpoints"]
        trainer.learner.replay.add_episodes = parts["replay_insertion"]
        trainer.episodes.collect = parts["collection"]
        wall = bench.wall_seconds(trainer.run)
    total = sum(clock.seconds for clock in parts.values())
    results: dict[str, Any] = {"cores": len(bench.cores()), "startup_seconds": startup, "wall_seconds": wall}
    results |= {f"{name}_seconds": clock.seconds for name, clock in parts.items()}
    results |= {"sum_of_parts_seconds": total, "overhead": wall / total - 1.0}
    bench.report(results, options)


if __name__ == "__main__":
    main()
