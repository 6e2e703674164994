"""How the world's speed grows with agents, workers and obstacles, and the replay's memory with steps.

Rates are agent steps a second: of processor time in one process, of wall time with workers; the fastest of some
repetitions counts. ``docs/images/scaling_figures.py`` draws ``scaling_world.png`` of it.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import bench_world as bench

RESULT = Path(__file__).parents[1] / "results" / "scaling_world.json"
AGENTS = (1, 2, 5, 10, 20, 40)
WORKERS = (0, 1, 2, 5, 10)
CLUTTER_PER_M2 = (0.0, 0.035, 0.07, 0.14, 0.28)
REPLAY_STEPS = (10_000, 20_000, 50_000, 100_000)
_STEPS, _TURNS = 10, 15


def rates(envs: dict[float, Any], seconds_of: Callable[[Callable[[], object]], float]) -> dict[float, float]:
    """Drive environments by noisy pursuit, in turns so that what disturbs one disturbs all; close them.

    Returns:
        Agent steps a second of each, from the fastest of its turns.
    """
    import torch

    from rcdsac_trl.rollout.planners.pursuit import pursuit_action

    now = {key: env.reset() for key, env in envs.items()}
    fastest = dict.fromkeys(envs, float("inf"))

    def drive(key: float) -> None:
        env, tensordict = envs[key], now[key]
        for _ in range(_STEPS):
            noise = torch.randn(*env.batch_size, 2)
            tensordict["action"] = (pursuit_action(tensordict["waypoint"]) + 0.7 * noise).clamp(-1.0, 1.0)
            tensordict = env.step(tensordict)["next"]
        now[key] = tensordict

    for _ in range(_TURNS):
        for key in envs:
            fastest[key] = min(fastest[key], seconds_of(partial(drive, key)))
    numbers = {key: _STEPS * env.batch_size.numel() / fastest[key] for key, env in envs.items()}
    for env in envs.values():
        env.close()
    return numbers


def scaling() -> dict[str, dict[float, float]]:
    """Measure all four curves."""
    from rcdsac_trl.world.maps.generator import MapSettings
    from rcdsac_trl.world.task.env import make_env

    agents: dict[float, Any] = {n: make_env(agent_ids=range(n), num_workers=0) for n in AGENTS}
    clutter = {
        density: make_env(map_settings=MapSettings(clutter_per_m2=density), num_workers=0) for density in CLUTTER_PER_M2
    }
    return {
        "agents": rates(agents, bench.cpu_seconds),
        "workers": rates({n: make_env(num_workers=n) for n in WORKERS}, bench.wall_seconds),
        "clutter_per_m2": rates(clutter, bench.cpu_seconds),
        "replay_megabytes": {steps: replay_bytes(steps) / 1e6 for steps in REPLAY_STEPS},
    }


def replay_bytes(steps: int) -> int:
    """Return the memory of a full replay of the default sensor, counted over its tensors."""
    import torch
    from tensordict import TensorDict

    from rcdsac_trl.robot.range_sensor import sensor_mask
    from rcdsac_trl.storage.sequence_replay import SequenceReplay
    from rcdsac_trl.world.task.spaces import Buffers

    episode_steps = 1000
    replay = SequenceReplay(
        capacity_steps=steps,
        episode_steps=episode_steps,
        sequence_length=8,
        batch_size=2,
        sensor_mask=torch.from_numpy(sensor_mask("narrow")),
        context_keys=("risk",),
        seed=0,
        device="cpu",
    )
    written = Buffers.zeros(1, memory_s=0.0)
    seen = {key: torch.zeros(1, episode_steps, array.shape[1]) for key, array in written.items()}
    flags = {key: torch.zeros(1, episode_steps, 1, dtype=torch.bool) for key in ("done", "terminated", "truncated")}
    episode = TensorDict(
        {**seen, "risk": torch.zeros(1, episode_steps, 1), "action": torch.zeros(1, episode_steps, 2)},
        batch_size=[1, episode_steps],
    )
    episode["next"] = TensorDict({**seen, **flags, "risk": torch.zeros(1, episode_steps, 1)}, [1, episode_steps])
    for _ in range(steps // episode_steps):
        replay.add_episodes(episode)
    return sum(value.untyped_storage().nbytes() for value in replay.buffer.storage._storage.values(True, True))


def main() -> None:
    parser = bench.parser(__doc__)
    parser.set_defaults(out=RESULT)
    options = parser.parse_args()
    bench.prepare()
    bench.report({"cores": len(bench.cores()), "num_agents": bench.NUM_AGENTS, **scaling()}, options)


if __name__ == "__main__":
    main()
