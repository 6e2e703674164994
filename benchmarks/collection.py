"""Agent steps a second: the bare environment beside PyBullet alone, the whole collection, and a naive variant.

`env_steps_per_second`: `NavigationEnv` alone on one core, whole episodes and their resets. `bullet_fraction`: its rate
over the rate of a loop that makes only the PyBullet calls of the same motor steps; blocks of both alternate.
`collector_steps_per_second`: TorchRL's collector, transforms, GRU policy, replay, on all cores this process may use.
`naive_steps_per_second`: the same environment as one would write it first, a worker for each agent.
"""

from typing import Any

import bench_world as bench


def bare(num_maps: int, repeats: int, steps: int) -> dict[str, float]:
    """Time the environment and PyBullet alone on the same episodes, by processor time."""
    from rcdsac_trl.world.env import NavigationEnv

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
    tensordict = env.fake_tensordict().exclude("next")
    for action in recording.actions:
        env.step(tensordict.set("action", action))


def collected(num_workers: int | str, batches: int, steps: int) -> float:
    """Time the collection of a training.

    Returns:
        Agent steps a second: of processor time where all is in this process, which has one thread; of wall time with
        workers.
    """
    import torch
    from torchrl.collectors import Collector
    from torchrl.envs.utils import ExplorationType

    from rcdsac_trl.pipeline.build.agent import make_loss, make_policy
    from rcdsac_trl.pipeline.build.read import training_settings
    from rcdsac_trl.pipeline.build.training import make_replay
    from rcdsac_trl.pipeline.build.world import environment
    from rcdsac_trl.pipeline.cli import compose

    given = ["+algo=rcdsac_pow", f"task.episode_steps={steps}", f"world.num_workers={num_workers}"]
    settings = training_settings(compose("train", given))
    env = environment(
        settings.training_world,
        settings.algo,
        split="train",
        seed=0,
        agent_ids=range(bench.NUM_AGENTS),
        memory=settings.network.memory,
    )
    policy = make_policy(make_loss(settings, "cpu").actor_network, torch.Generator(), "cpu")
    replay = make_replay(settings, "cpu")
    per_batch = bench.NUM_AGENTS * steps
    collector = Collector(
        env,
        policy,
        frames_per_batch=per_batch,
        total_frames=per_batch * (batches + 1),
        exploration_type=ExplorationType.RANDOM,
        trust_policy=True,
        use_buffers=False,
    )
    episodes = iter(collector)

    def collect() -> None:
        batch = next(episodes)
        replay.add_episodes(batch.reshape(-1, batch.shape[-1]))

    collect()  # workers start, code is compiled
    seconds_of = bench.wall_seconds if num_workers else bench.cpu_seconds
    seconds = min(seconds_of(collect) for _ in range(batches))
    collector.shutdown()
    return per_batch / seconds


def main() -> None:
    parser = bench.parser(__doc__)
    parser.add_argument("--maps", type=int, default=3, help="episodes of the bare environment")
    parser.add_argument("--repeats", type=int, default=5, help="repetitions of each; the fastest counts")
    parser.add_argument("--steps", type=int, default=300, help="agent steps of an episode that are timed")
    options = parser.parse_args()
    bench.prepare()
    import naive

    results: dict[str, Any] = {"cores": len(bench.cores())}
    results |= bare(options.maps, options.repeats, options.steps)
    batches = max(options.repeats - 2, 1)
    results["in_process_steps_per_second"] = collected(0, batches, 1000)
    results["workers_steps_per_second"] = collected("auto", batches, 1000)
    results["collector_steps_per_second"] = max(
        results["in_process_steps_per_second"], results["workers_steps_per_second"]
    )
    results["naive_steps_per_second"] = naive.steps_per_second(steps=100)
    results["collector_over_env"] = results["collector_steps_per_second"] / results["env_steps_per_second"]
    results["env_over_naive"] = results["env_steps_per_second"] / results["naive_steps_per_second"]
    results["collector_over_naive"] = results["collector_steps_per_second"] / results["naive_steps_per_second"]
    bench.report(results, options)


if __name__ == "__main__":
    main()
