"""What the benchmarks share: learners on made-up episodes, the machine's matrix-product rate, output."""

import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.run_config import training_settings
from rcdsac_trl.robot.observation import vector_observations
from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.seeding import torch_stream
from rcdsac_trl.training import make_learner as training_learner
from rcdsac_trl.training.learner import Learner

EPISODES = 20


def make_learner(algo: str, overrides: list[str], device: str = "cpu") -> Learner:
    """Make the learner of a training, its replay filled with random episodes of the configured sensor."""
    settings = training_settings(compose("train", [f"+algo={algo}", *overrides, "replay.capacity_steps=20000"]))
    learner = training_learner.make_learner(settings, device)
    mask = torch.from_numpy(sensor_mask(settings.sensor.name))
    vectors = vector_observations(settings.sensor.memory_s)
    learner.replay.add_episodes(random_episodes(EPISODES, settings.task.episode_steps, mask, vectors))
    return learner


def random_episodes(number: int, steps: int, mask: torch.Tensor, vectors: dict[str, int]) -> TensorDict:
    """Return episodes ``[number, steps]`` of noise, as a collector would."""
    generator = torch_stream(0, "benchmark")

    def uniform(*size: int) -> torch.Tensor:
        return torch.rand(number, steps, *size, generator=generator)

    def observations() -> dict[str, torch.Tensor]:
        # A third of the bins is out of range, which reads 0.
        ranges = (0.5 + 2.4 * uniform(180)) * (uniform(180) > 1 / 3) * mask
        return {"range": ranges} | {key: uniform(size) for key, size in vectors.items()}

    outcome = observations() | {"reward_components": -uniform(5)}
    content = observations() | {"action": 2.0 * uniform(2) - 1.0, "risk": -uniform(1), "next": outcome}
    return TensorDict(content, batch_size=[number, steps])


def seconds(call: Callable[[], Any], repeats: int, threads: int | None = None) -> float:
    """Return the mean time of a call: with one thread this process's own, so that other programs count less.

    Args:
        call: is measured.
        repeats: of it.
        threads: that it takes; None: as many as torch.
    """
    one_thread = (torch.get_num_threads() if threads is None else threads) == 1
    clock = time.process_time if one_thread else time.perf_counter
    start = clock()
    for _ in range(repeats):
        call()
    return (clock() - start) / repeats


def gemm_peak() -> float:
    """Return the float32 operations per second of a large square matrix product, with torch's current threads."""
    size = 2048
    a, b = torch.randn(size, size), torch.randn(size, size)
    torch.mm(a, b)
    return 2 * size**3 / min(seconds(lambda: torch.mm(a, b), 2) for _ in range(5))


def median(values: list[float]) -> float:
    """Return the median, as everything here is reported."""
    return statistics.median(values)


def report(result: dict[str, Any], table: str, *, as_json: bool, out: Path | None) -> None:
    """Print a table, or exactly one JSON object; also write that object to a file when asked."""
    print(json.dumps(result) if as_json else table)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(result, indent=2) + "\n")
