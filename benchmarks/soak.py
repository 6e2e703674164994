"""Does a long training stay as it began? Memory, open files and speed of a real run, from its start to its end.

    python benchmarks/soak.py --minutes 30

The run is that of `preset=laptop` with short iterations, so that there are many; it is stopped when the time is over.
A quantity is flat if its median over the last fifth of the iterations exceeds that over the fifth after the start-up
by no more than its tolerance. Exit code 1: one is not.
"""

import argparse
import contextlib
import gc
import json
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import bench_world as bench

# What grows by right (the replay, to its capacity) and what noise there is; shares of the value at the start.
TOLERANCES = {"resident_mb": 0.05, "open_files": 0.0, "iteration_seconds": 0.15, "checkpoint_seconds": 0.5}
# Share of the iterations in which caches, the replay and the allocator fill up.
START_UP = 0.3


class Stop(Exception):
    """The time is over."""


def resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def verdicts(rows: list[dict[str, float]]) -> dict[str, dict[str, Any]]:
    """Compare the last fifth of the iterations with the fifth after the start-up."""
    fifth = max(1, len(rows) // 5)
    begin = int(START_UP * len(rows))
    found = {}
    for name, tolerance in TOLERANCES.items():
        early = statistics.median(row[name] for row in rows[begin : begin + fifth])
        late = statistics.median(row[name] for row in rows[-fifth:])
        growth = late / early - 1.0
        found[name] = {"early": early, "late": late, "growth": growth, "flat": growth <= tolerance}
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--out", type=Path, help="write every iteration and the verdicts to this JSON file")
    parser.add_argument("overrides", nargs="*", help="of train's config, such as world.num_workers=2")
    options = parser.parse_args()
    bench.prepare()
    from rcdsac_trl.config.compose import compose
    from rcdsac_trl.training.setup import make_trainer

    given = [
        "+algo=rcdsac_pow",
        "preset=laptop",
        "schedule.iterations=100000",
        "schedule.updates_per_iteration=10",
        "task.episode_steps=100",
        # Full soon, so that what grows afterwards grows without a reason.
        "replay.capacity_steps=20000",
        "validation.every_iterations=10",
        "validation.num_maps=1",
        *options.overrides,
    ]
    rows: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(sys.stderr):
        trainer = make_trainer(compose("train", given), Path(folder) / "run")
        save, began = trainer.checkpoints.save, time.monotonic()
        last = began

        def measured(*arguments: Any) -> Path:
            nonlocal last
            before = time.monotonic()
            path = save(*arguments)
            now = time.monotonic()
            gc.collect()
            if trainer.progress.iterations and trainer.progress.iterations % 10:  # not those that validate
                rows.append(
                    {
                        "elapsed_s": now - began,
                        "resident_mb": resident_mb(),
                        "open_files": float(len(os.listdir("/proc/self/fd"))),
                        "iteration_seconds": before - last,
                        "checkpoint_seconds": now - before,
                    }
                )
            last = time.monotonic()
            if now - began > 60.0 * options.minutes:
                raise Stop
            return path

        trainer.checkpoints.save = measured  # type: ignore[method-assign]
        with contextlib.suppress(Stop):
            trainer.run()
    found = verdicts(rows)
    print(f"{len(rows)} iterations in {rows[-1]['elapsed_s'] / 60:.1f} minutes")
    print(f"{'':20} {'early':>10} {'late':>10} {'growth':>8}  verdict")
    for name, row in found.items():
        verdict = "flat" if row["flat"] else "GROWS"
        print(f"{name:20} {row['early']:10.4g} {row['late']:10.4g} {row['growth']:8.1%}  {verdict}")
    if options.out is not None:
        written = {"minutes": options.minutes, "verdicts": found, "iterations": rows}
        options.out.write_text(json.dumps(written, indent=1) + "\n")
    raise SystemExit(0 if all(row["flat"] for row in found.values()) else 1)


if __name__ == "__main__":
    main()
