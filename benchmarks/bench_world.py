"""What the benchmarks of the world share: recorded drives, the bare PyBullet loop, blocks that alternate, output."""

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rcdsac_trl.system import runtime
from rcdsac_trl.system.cores import usable_cores

NUM_AGENTS = 10


def cores() -> list[int]:
    """Return the cores that this process may use."""
    allowed = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)
    return sorted(allowed)[: usable_cores()]


def prepare(threads: int = 1) -> None:
    """Set the process up as the commands do: an allocator that keeps its pages, TorchRL's notes off, the threads."""
    runtime.keep_pages()
    runtime.quiet_libraries()
    runtime.set_threads(threads)


@dataclass
class Recording:
    """What one agent was told in an episode, and which PyBullet calls that took.

    Attributes:
        actions: of each agent step, float32 [T, N, 2].
        calls: of each agent: one list a motor step, of the movers' places ``(body, xyz)`` and the robot's velocities
            ``(linear, angular)``.
    """

    actions: list[Any] = field(default_factory=list)
    calls: list[list[tuple[list[tuple[int, Any]], Any, Any]]] = field(default_factory=list)


def record(env: Any, episode: int, steps: int) -> Recording:
    """Drive an episode by noisy pursuit and note what happens; not timed.

    Args:
        env: a ``NavigationEnv``.
        episode: its number.
        steps: its length, agent steps.
    """
    import torch

    from rcdsac_trl.rollout.planners.pursuit import pursuit_action
    from rcdsac_trl.seeding import torch_stream
    from rcdsac_trl.world.sim import simulation

    recording = Recording(calls=[[] for _ in range(len(env.agents))])
    generator = torch_stream(0, "benchmark", episode)
    tensordict = env.reset(episode=episode)
    clients = {client: row for row, (client, _) in enumerate(bodies(env))}
    moved: list[list[tuple[int, Any]]] = [[] for _ in clients]
    original = simulation.pybullet

    class Noting:
        """PyBullet, which notes what moves."""

        def __getattr__(self, name: str) -> Any:
            return getattr(original, name)

        def resetBasePositionAndOrientation(self, body: int, xyz: Any, turn: Any, client: int) -> None:
            moved[clients[client]].append((body, xyz))
            original.resetBasePositionAndOrientation(body, xyz, turn, client)

        def resetBaseVelocity(self, robot: int, linear: Any, angular: Any, client: int) -> None:
            row = clients[client]
            recording.calls[row].append((moved[row], linear, angular))
            moved[row] = []
            original.resetBaseVelocity(robot, linear, angular, client)

    simulation.pybullet = Noting()
    noise = torch.zeros(len(env.agents), 2)
    try:
        for _ in range(steps):
            # The noise keeps its sign for a second or two, as in training's first iterations.
            noise = 0.9 * noise + 0.43 * torch.randn(noise.shape, generator=generator)
            action = (pursuit_action(tensordict["waypoint"]) + 0.7 * noise).clamp(-1.0, 1.0)
            recording.actions.append(action)
            tensordict = env.step(tensordict.set("action", action))["next"]
    finally:
        simulation.pybullet = original
    return recording


def bodies(env: Any) -> list[tuple[int, int]]:
    """Return PyBullet's client and the robot's body of every agent of a ``NavigationEnv``."""
    simulations = [agent._simulation for agent in env.agents._agents]
    return [(simulation._client, simulation._robot) for simulation in simulations]


def only_bullet(env: Any, recording: Recording) -> None:
    """Make a recorded episode's PyBullet calls, and no other: the floor of every environment on this engine.

    For each motor step: the movers where they have to be moved, the robot's velocity, the step, then pose, velocity
    and contacts. The agents take turns after each agent step, as in every environment, which is told an action of each
    of them at a time; one agent's whole episode at once would keep its simulation in the processor's cache.
    """
    from rcdsac_trl.world.sim.bullet import pybullet

    upright = (0.0, 0.0, 0.0, 1.0)
    agents = [
        (client, robot, calls, len(calls) // len(recording.actions))
        for (client, robot), calls in zip(bodies(env), recording.calls, strict=True)
    ]
    for step in range(len(recording.actions)):
        for client, robot, calls, motor_steps in agents:
            for movers, linear, angular in calls[step * motor_steps : (step + 1) * motor_steps]:
                for body, xyz in movers:
                    pybullet.resetBasePositionAndOrientation(body, xyz, upright, client)
                pybullet.resetBaseVelocity(robot, linear, angular, client)
                pybullet.stepSimulation(client)
                pybullet.getBasePositionAndOrientation(robot, client)
                pybullet.getBaseVelocity(robot, client)
                pybullet.getContactPoints(bodyA=robot, physicsClientId=client)


def cpu_seconds(work: Callable[[], object]) -> float:
    """Return the processor time that this process needs for something."""
    started = time.process_time()
    work()
    return time.process_time() - started


def wall_seconds(work: Callable[[], object]) -> float:
    """Return how long something takes."""
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def middle(values: Sequence[float]) -> float:
    """Return the median."""
    return statistics.median(values)


def parser(description: str | None) -> argparse.ArgumentParser:
    """Return the options that all benchmarks have."""
    made = argparse.ArgumentParser(description=(description or "").splitlines()[0])
    made.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    made.add_argument("--out", type=Path, help="file to write the JSON object to as well")
    return made


def report(results: dict[str, Any], options: argparse.Namespace) -> None:
    """Print the results as a table or as JSON, and write them where asked."""
    results = {key: float(f"{value:.4g}") if isinstance(value, float) else value for key, value in results.items()}
    text = json.dumps(results, indent=2)
    if options.out is not None:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(text + "\n")
    if options.json:
        print(text)
        return
    width = max(map(len, results))
    for key, value in results.items():
        print(f"{key:<{width}}  {value:,}" if isinstance(value, int | float) else f"{key:<{width}}  {value}")


def note(message: str) -> None:
    """Say something that is not a result."""
    print(message, file=sys.stderr)
