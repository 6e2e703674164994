"""Agent steps a second: the bare environment beside PyBullet alone, the whole collection, and a naive variant.

`env_steps_per_second`: `NavigationEnv` alone on one core, whole episodes and their resets. `bullet_fraction`: its rate
over the rate of a loop that makes only the PyBullet calls of the same motor steps; blocks of both alternate.
`collector_steps_per_second`: a training's own collection into its replay, by the faster of one process and one a core;
the same through TorchRL's collector, in one process and through `ParallelEnv`, is told beside it.
`naive_steps_per_second`: the same environment as one would write it first, a worker for each agent.
"""

from typing import Any

import bench_world as bench


def bare(num_maps: int, repeats: int, steps: int) -> dict[str, float]:
    """Time the environment and PyBullet alone on the same episodes, by processor time."""
    from rcdsac_trl.world.task.env import NavigationEnv

    env = NavigationEnv(agent_ids=range(bench.NUM_AGENTS))
    taken: dict[str, list[list[float]]] = {"reset": [], "drive": [], "bullet": []}
    for episode in range(num_maps):
        recording = bench.record(env, episode, steps)
        times: dict[str, list[float]] = {key: [] for key in taken}
        for _ in range(repeats):
            times["reset"].append(bench.cpu_seconds(lambda episode=episode: env.reset(episode=episode)))
            times["drive"].append(bench.cpu_seconds(lambda recording=recording: _drive(env, recording)))
            env.reset(episode=episode)
            times["bullet"].append(bench.cpu_seconds(lambda recording=recording: bench.only_bullet(env, recording)))
        for key, values in times.items():
            taken[key].append(values)
    env.close()
    # The least disturbed repetition of each map: what else runs on the machine only ever adds.
    reset, drive, bullet = (sum(min(values) for values in taken[key]) for key in ("reset", "drive", "bullet"))
    reset *= steps / 1000  # an episode has 1,000 steps
    agent_steps = num_maps * steps * bench.NUM_AGENTS
    return {
        "env_steps_per_second": agent_steps / (drive + reset),
        "bullet_steps_per_second": agent_steps / bullet,
        "bullet_fraction": bullet / (drive + reset),
        "bullet_fraction_without_resets": bullet / drive,
        "reset_seconds": reset / num_maps * 1000 / steps,
    }


def _drive(env: Any, recording: bench.Recording) -> None:
    from tensordict import TensorDict

    for action in recording.actions:
        # A new one each time, as a policy hands it over: TorchRL would merge the last step's "next" into the new one.
        env.step(TensorDict({"action": action}, batch_size=env.batch_size))


def collected(overrides: list[str], batches: int, *, wall: bool) -> float:
    """Time the collection of a training, as the training builds it, into its replay.

    Args:
        overrides: of the training's config.
        batches: iterations that are timed; the fastest counts.
        wall: count time, not this process's processor time.

    Returns:
        Agent steps a second.
    """
    from rcdsac_trl.config.compose import compose
    from rcdsac_trl.config.run_config import training_settings
    from rcdsac_trl.rollout.make_collector import make_episodes
    from rcdsac_trl.training.make_learner import make_learner

    given = ["+algo=rcdsac_pow", "schedule.pursuit_iterations=0", *overrides]
    settings = training_settings(compose("train", given))
    learner = make_learner(settings, "cpu")
    episodes = make_episodes(settings, learner.loss.actor_network, "cpu")
    iterations = iter(range(batches + 1))

    def collect() -> None:
        iteration = next(iterations)
        learner.replay.add_episodes(episodes.collect(iteration, iteration))

    collect()  # workers start, code is compiled
    seconds_of = bench.wall_seconds if wall else bench.cpu_seconds
    seconds = min(seconds_of(collect) for _ in range(batches))
    episodes.close()
    return settings.world.num_agents * settings.task.episode_steps / seconds


def collectors(overrides: list[str], batches: int) -> dict[str, float]:
    """Time every way to collect; processes by wall time, since several of them count."""
    in_process, by_torchrl = ["collector.num_processes=0"], ["collector=single"]
    return {
        "in_process_steps_per_second": collected([*overrides, *in_process], batches, wall=False),
        "processes_steps_per_second": collected(overrides, batches, wall=True),
        "torchrl_steps_per_second": collected([*overrides, *by_torchrl], batches, wall=False),
        "parallel_env_steps_per_second": collected([*overrides, "collector=parallel_env"], batches, wall=True),
    }


def measure(maps: int, repeats: int, steps: int, overrides: list[str]) -> dict[str, Any]:
    """Measure all rates and their ratios."""
    import naive

    results: dict[str, Any] = {"cores": len(bench.cores())}
    results |= bare(maps, repeats, steps)
    results |= collectors(overrides, max(repeats - 2, 1))
    results["collector_steps_per_second"] = max(
        results["in_process_steps_per_second"], results["processes_steps_per_second"]
    )
    results["naive_steps_per_second"] = naive.steps_per_second(steps=min(steps, 100))
    results["collector_over_env"] = results["collector_steps_per_second"] / results["env_steps_per_second"]
    results["env_over_naive"] = results["env_steps_per_second"] / results["naive_steps_per_second"]
    results["collector_over_naive"] = results["collector_steps_per_second"] / results["naive_steps_per_second"]
    return results


def main() -> None:
    parser = bench.parser(__doc__)
    parser.add_argument("--maps", type=int, default=3, help="episodes of the bare environment")
    parser.add_argument("--repeats", type=int, default=5, help="repetitions of each; the fastest counts")
    parser.add_argument("--steps", type=int, default=300, help="agent steps of an episode that are timed")
    parser.add_argument("overrides", nargs="*", default=[], help="further keys of conf/train.yaml, as key=value")
    options = parser.parse_args()
    bench.prepare()
    bench.report(measure(options.maps, options.repeats, options.steps, options.overrides), options)


if __name__ == "__main__":
    main()
