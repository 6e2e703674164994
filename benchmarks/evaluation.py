"""Seconds that an evaluation takes: 50 maps x 10 episodes x 1,000 steps with a real agent, on all cores.

It runs the command's own code on an untrained agent, whose networks cost the same, acting by tanh(mean), then by its
critics' choice; two more maps first start the processes and are not counted. With fewer `--maps` the time is
extrapolated linearly.
"""

import tempfile
import time
from pathlib import Path

import bench_world as bench

MAPS = 50
CANDIDATES = 32


def main() -> None:
    parser = bench.parser(__doc__)
    parser.add_argument("--maps", type=int, default=MAPS, help="maps that are driven")
    parser.add_argument("--num-workers", default="auto", help="processes, as num_workers of conf/evaluate.yaml")
    parser.add_argument("overrides", nargs="*", default=[], help="of the training's config, as key=value")
    options = parser.parse_args()
    bench.prepare()
    from rcdsac_trl.config.compose import compose
    from rcdsac_trl.evaluation.evaluation import make_evaluation

    def seconds_per_map(run: Path, num_candidates: int) -> float:
        given = [
            f"run={run}",
            "checkpoint=last",
            "beta=[-1]",
            f"acting.num_candidates={num_candidates}",
            f"num_workers={options.num_workers}",
            f"num_maps={options.maps + 2}",
        ]
        evaluation = make_evaluation(compose("evaluate", given))
        done = [time.perf_counter() for _ in evaluation.measure(lambda steps: None)]
        # From the second map done, when every process of two is at work, to the last.
        return (done[-1] - done[1]) / options.maps

    with tempfile.TemporaryDirectory() as folder:
        run = untrained(Path(folder) / "run", options.overrides)
        by_mean, by_choice = (seconds_per_map(run, number) for number in (1, CANDIDATES))
    bench.report(
        {
            "cores": len(bench.cores()),
            "num_workers": options.num_workers,
            "maps_driven": options.maps,
            "extrapolated": options.maps != MAPS,
            "seconds_for_500_episodes": by_mean * MAPS,
            "agent_steps_per_second": 10_000 / by_mean,
            f"times_as_long_by_choice_among_{CANDIDATES}": by_choice / by_mean,
        },
        options,
    )


def untrained(folder: Path, overrides: list[str]) -> Path:
    """Write a run folder whose agent has its first weights, by default in the default world."""
    from rcdsac_trl.config.compose import compose
    from rcdsac_trl.config.run_config import CHECKPOINTS, training_settings
    from rcdsac_trl.rollout.make_agent import make_average, make_loss
    from rcdsac_trl.storage.checkpoint import Checkpoints
    from rcdsac_trl.storage.checkpoint_record import Progress
    from rcdsac_trl.training.run_folder import start_run_folder

    cfg = compose("train", ["+algo=rcdsac_pow", "logger=none", *overrides])
    settings = training_settings(cfg)
    folder.mkdir(parents=True)
    start_run_folder(folder, cfg, {})
    loss = make_loss(settings, "cpu")
    average = make_average(loss, settings.learner)
    Checkpoints(folder / CHECKPOINTS, {"loss": loss, "average": average}, replay=None, keep=1).save(Progress(), {})
    return folder


if __name__ == "__main__":
    main()
