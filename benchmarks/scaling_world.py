"""How the world's speed grows with agents, workers and obstacles, and the replay's memory with steps; a figure.

Rates are agent steps a second: of processor time in one process, of wall time with workers; the fastest of some
repetitions counts.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import bench_world as bench
from rcdsac_trl.colors import LIGHT

IMAGE = Path(__file__).parents[1] / "docs" / "images" / "scaling_world.png"
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
        "replay_megabytes": {float(steps): replay_bytes(steps) / 1e6 for steps in REPLAY_STEPS},
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


def draw(curves: dict[str, dict[float, float]], path: Path) -> None:
    """Draw one panel a curve."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    titles = {
        "agents": ("agents in one process", "agent steps / s"),
        "workers": (f"worker processes of {bench.NUM_AGENTS} agents, {len(bench.cores())} cores", "agent steps / s"),
        "clutter_per_m2": ("pieces of clutter per m²", "agent steps / s"),
        "replay_megabytes": ("agent steps in the replay", "MB"),
    }
    figure, axes = plt.subplots(1, 4, figsize=(15, 3.4), layout="constrained")
    for axis, (key, (xlabel, ylabel)) in zip(axes, titles.items(), strict=True):
        axis.plot(list(curves[key]), list(curves[key].values()), "o-", color=LIGHT.accent)
        axis.set(xlabel=xlabel, ylabel=ylabel)
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    options = bench.parser(__doc__).parse_args()
    bench.prepare()
    curves = scaling()
    draw(curves, IMAGE)
    bench.report({"cores": len(bench.cores()), **curves}, options)


if __name__ == "__main__":
    main()
