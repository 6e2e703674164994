"""WorkerGroup drive what the environment and its transforms would have, whoever holds the agents; and their faults."""

import contextlib
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rcdsac_trl.config.conditions import Condition
from rcdsac_trl.rollout.environments import environment, evaluation_worker, rollout_worker
from rcdsac_trl.rollout.make_agent import make_loss, make_policy
from rcdsac_trl.rollout.make_collector import make_episodes
from rcdsac_trl.rollout.policies import AgentNoise, PursuitPolicy
from rcdsac_trl.rollout.worker import EpisodeBatch, RolloutWorker, side_by_side
from rcdsac_trl.rollout.worker_processes import Drive, RolloutRequest, WorkerProcesses
from rcdsac_trl.system import liveness
from rcdsac_trl.system.processes import WorkerError
from rcdsac_trl.training.make_learner import make_replay
from rcdsac_trl.world.task.env import make_env
from rcdsac_trl.world.task.rules import REWARD_COMPONENTS, total_reward
from rcdsac_trl.world.task.world_settings import WorldSettings
from tiny import STEPS, tiny_settings

HAPPENED = ("contact", "goal_reached", "reward_components")
CONDITIONS = {
    "rcdsac_pow": [Condition(beta=-2.0), Condition(beta=-1.0)],
    "rcwr": [Condition(collision_weight=0.5), Condition(collision_weight=2.0)],
}


# ------------------------------------------------------------------------------------------------ the same episodes
def by_transforms(
    env: EnvBase, policy: TensorDictModuleBase, episode: int, observed: tuple[str, ...], context: list[str]
) -> TensorDictBase:
    """Drive an episode through the environment's transforms, a tensordict a step."""
    tensordict, steps = env.reset(episode=episode), []
    for _ in range(STEPS):
        tensordict = env.step(policy(tensordict))
        kept = [*observed, *context, "action", *(("next", key) for key in (*observed, *HAPPENED))]
        steps.append(tensordict.select(*kept).flatten())
        tensordict = env.step_mdp(tensordict)
    return torch.stack(steps, 1)


@pytest.mark.parametrize("row", ["rcdsac_pow", "rcwr", None])
@pytest.mark.parametrize("workers", [0, 2])
def test_a_worker_drives_as_the_environment_with_its_transforms(
    row: str | None, workers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rcdsac_trl.rollout.environments.make_env", partial(make_env, serial=True))
    settings = tiny_settings(row or "sac", "task.range_noise_std_m=0.1")
    algo = settings.algo if row else None
    conditions = CONDITIONS.get(row or "", [Condition()])
    agents = 4 * len(conditions)
    world = WorldSettings(settings.map, settings.task, "narrow", num_agents=agents, num_workers=workers)
    state_size, observed = settings.network.state_size, ("range", "velocity")

    def policy() -> TensorDictModuleBase:
        if row is None:
            return PursuitPolicy()
        noise = AgentNoise(range(agents))
        noise.begin(0, "test")
        return make_policy(make_loss(settings, "cpu").actor_network, noise, "cpu")

    worker = evaluation_worker(world, algo, conditions, "evaluation", 0, 4, state_size)
    env = environment(
        world,
        algo,
        split="evaluation",
        seed=0,
        agent_ids=[0, 1, 2, 3] * len(conditions),
        state_size=state_size,
        conditions=[condition for condition in conditions for _ in range(4)],
    )
    context = [] if algo is None or algo.context_key is None else [algo.context_key]
    one, other = policy(), policy()
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        for episode in (3, 3, 1):
            found = worker.rollout(one, episode, observed=observed, happened=HAPPENED).tensordict()
            expected = by_transforms(env, other, episode, observed, context)
            assert found.batch_size == expected.batch_size == (agents, STEPS)
            assert set(found.keys(True, True)) == set(expected.keys(True, True))
            for key in found.keys(True, True):
                assert torch.equal(found[key], expected[key]), key
    worker.close()
    env.close()


COLLECTORS = {
    "one process": ("collector.num_processes=0",),
    "two": ("collector.num_processes=2",),
    "single": ("collector=single",),
    "parallel": ("collector=parallel_env", "world.num_workers=3"),
}
AGENTS = 3


def collected(row: str, *overrides: str) -> list[TensorDictBase]:
    """Two iterations' episodes: one driven by pursuit, one by the agent, whose weights have changed meanwhile."""
    given = [f"world.num_agents={AGENTS}", "learner.sequence_length=2", "task.range_noise_std_m=0.1", *overrides]
    if not any(each.startswith("collector=") for each in overrides):
        given.append("collector=multi")
    settings = tiny_settings(row, *given)
    actor = make_loss(settings, "cpu").actor_network
    episodes = make_episodes(settings, actor, "cpu")
    batches = []
    for iteration in range(2):
        batches.append(episodes.collect(iteration, iteration).clone())
        with torch.no_grad():
            for value in actor.parameters():
                value.mul_(1.5)
    episodes.close()
    return batches


@pytest.mark.parametrize("row", ["rcdsac_pow", "rcwr"])
def test_episodes_do_not_depend_on_what_collects_them(row: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rcdsac_trl.rollout.environments.make_env", partial(make_env, serial=True))
    first = collected(row, *COLLECTORS["one process"])
    assert first[0].batch_size == (AGENTS, STEPS)
    for name in ("two", "single", "parallel"):
        for batch, expected in zip(collected(row, *COLLECTORS[name]), first, strict=True):
            for key in expected.keys(True, True):
                assert torch.equal(batch[key], expected[key]), (name, key)
    assert not torch.equal(first[0]["action"], first[1]["action"])
    assert not multiprocessing.active_children()


def test_a_worker_whose_policy_cannot_be_made_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[RolloutWorker] = []
    close = RolloutWorker.close
    monkeypatch.setattr(RolloutWorker, "close", lambda self: (closed.append(self), close(self)))
    monkeypatch.setattr("rcdsac_trl.rollout.make_collector.make_actor", lambda *_: 1 / 0)
    settings = tiny_settings("sac", "collector.num_processes=0")
    actor = make_loss(settings, "cpu").actor_network
    with pytest.raises(ZeroDivisionError):
        make_episodes(settings, actor, "cpu")
    assert len(closed) == 1


def test_episodes_that_end_early_are_the_beginning_of_whole_ones() -> None:
    settings = tiny_settings("sac")
    worker = evaluation_worker(settings.training_world, None, [Condition()], "validation", 0, 2, state_size=4)
    calls = iter(range(100))
    drive = partial(worker.rollout, PursuitPolicy(), 1, observed=("pose",), happened=("contact",))
    whole, short = drive(), drive(ended=lambda written: "contact" in written and next(calls) == 6)
    worker.close()
    assert whole.tensordict().shape == (2, STEPS)
    assert short.tensordict().shape == (2, 7)
    for key in ("action", "pose", ("next", "pose"), ("next", "contact")):
        assert torch.equal(short.tensordict()[key], whole.tensordict()[key][:, :7])


@pytest.mark.parametrize("weight", [1.0, 3.0])
def test_a_weight_of_all_collisions_reaches_updates_and_rewards_and_is_not_told(weight: float) -> None:
    settings = tiny_settings("rcdsac_pow", f"algo.collision_weight=[{weight},{weight}]")
    assert make_replay(settings, "cpu").collision_weight == weight
    world = WorldSettings(settings.map, settings.task, "narrow", num_agents=2, num_workers=0)
    made = {"split": "train", "seed": 0, "agent_ids": [0, 1], "state_size": settings.network.state_size}
    env, worker = environment(world, settings.algo, **made), rollout_worker(world, settings.algo, **made)
    assert set(env.reset().keys()).isdisjoint({"collision_weight"})
    for agents in (env.base_env.agents, worker.env.agents):
        agents.reset(range(2))
        collided = False
        for _ in range(150):  # straight on, into whatever comes
            agents.step(np.array([[1.0, 0.0], [1.0, 0.0]]))
            components = agents.buffers.reward_components
            collided |= bool((components[:, REWARD_COMPONENTS.index("collision")] < 0.0).any())
            np.testing.assert_array_equal(agents.buffers.reward[:, 0], total_reward(components, weight))
        assert collided
    env.close()
    worker.close()


def test_episodes_are_views_of_what_was_seen() -> None:
    steps = np.arange(6.0, dtype=np.float32).reshape(1, 6, 1)
    driven = EpisodeBatch(
        {"range": steps}, {"action": steps[:, :5], "contact": steps[:, :5]}, {"risk": np.ones((1, 1))}
    )
    both = side_by_side([driven, driven]).tensordict()
    assert both["range"][1, :, 0].tolist() == [0, 1, 2, 3, 4]
    assert both["next", "range"][1, :, 0].tolist() == [1, 2, 3, 4, 5]
    assert both["risk"].shape == (2, 5, 1)
    assert set(both["next"].keys()) == {"range", "contact"}
    one = driven.tensordict()
    assert one["range"].untyped_storage().data_ptr() == one["next", "range"].untyped_storage().data_ptr()


# ------------------------------------------------------------------------------------------------ faults
FIRST, SECOND = (RolloutRequest(iteration, map_index=0, weights=b"") for iteration in range(2))
TIMEOUT_S = 5.0


@contextlib.contextmanager
def answering(does: str, until: Path | None = None) -> Iterator[Drive]:
    """Answer the first request at once; the second one in some way, or when a file is there."""

    def drive(request: RolloutRequest, before_step: Callable[[], None]) -> EpisodeBatch:
        while request == SECOND and until is not None and not until.exists():
            time.sleep(0.01)
            if does == "steps":
                before_step()
        if request == SECOND and does == "ends":
            os._exit(7)
        if request == SECOND and does == "fails":
            raise ValueError("a mistake")
        return EpisodeBatch({}, {"action": np.full((1, 1, 2), os.getpid() % 1000, np.float32)}, {})

    yield drive


@pytest.fixture
def processes() -> Iterator[Callable[..., WorkerProcesses]]:
    """Start processes that have answered once: what starting takes counts for nothing here."""
    started: list[WorkerProcesses] = []

    def start(*makes: Any, timeout_s: float = TIMEOUT_S) -> WorkerProcesses:
        started.append(group := WorkerProcesses(makes, [f"agents {n}" for n in range(len(makes))], None))
        group.ask(FIRST)
        group.pool._timeout_s = timeout_s
        return group

    yield start
    for group in started:
        group.close()
        group.close()  # once more does no harm
    assert not multiprocessing.active_children()


class Clock:
    """Stands in for the pool's clock: whenever it is looked at and time passes, that is nearly what the pool allows.

    When time passes is the test's to say, so nothing depends on how busy the machine is.
    """

    def __init__(self, passes: Callable[[], bool]) -> None:
        self._passes, self.now_s = passes, 0.0

    def runs(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(liveness, "time", self)
        monkeypatch.setattr(liveness, "_LONGEST_LOOK_S", TIMEOUT_S)

    def monotonic(self) -> float:
        self.now_s += 0.9 * TIMEOUT_S * self._passes()
        return self.now_s


def test_slow_processes_that_take_steps_do_not_count_as_hung(
    processes: Callable[..., WorkerProcesses], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    group = processes(*[partial(answering, "steps", tmp_path / "enough")] * 2)
    pids = [process.pid for process in group.pool.processes]
    before = [0, 0]

    def both_have_stepped() -> bool:
        steps = [each.value for each in group.pool._steps]
        if any(now == then for now, then in zip(steps, before, strict=True)):
            return False
        before[:] = steps
        if clock.now_s > 3 * TIMEOUT_S:
            (tmp_path / "enough").touch()
        return True

    clock = Clock(both_have_stepped)
    clock.runs(monkeypatch)
    assert group.ask(SECOND)["action"][:, 0, 0].tolist() == [pid % 1000 for pid in pids]
    assert clock.now_s > 3 * TIMEOUT_S


def test_a_process_that_takes_no_step_is_named(
    processes: Callable[..., WorkerProcesses], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    group = processes(partial(answering, "answers"), partial(answering, "sleeps", tmp_path / "never"))
    Clock(lambda: not group.pool._open_requests[0]).runs(monkeypatch)
    with pytest.raises(WorkerError, match=r"^worker process 2 of 2 \(agents 1\) made no step within 5 s$"):
        group.ask(SECOND)


@pytest.mark.parametrize(("does", "code"), [("ends", 7), ("fails", 1)])
def test_a_process_that_fails_is_named(processes: Callable[..., WorkerProcesses], does: str, code: int) -> None:
    group = processes(partial(answering, "answers"), partial(answering, does))
    with pytest.raises(WorkerError, match=rf"^worker process 2 of 2 \(agents 1\) ended with exit code {code}$"):
        group.ask(SECOND)


@pytest.mark.parametrize(
    ("number", "timeout_s", "told"),
    [
        (signal.SIGKILL, TIMEOUT_S, "was killed by SIGKILL"),
        (signal.SIGSTOP, 0.2, "made no step within 0.2 s"),
    ],
)
def test_a_process_that_cannot_even_be_asked_is_named(
    processes: Callable[..., WorkerProcesses], number: signal.Signals, timeout_s: float, told: str
) -> None:
    group = processes(*[partial(answering, "answers")] * 2, timeout_s=timeout_s)
    os.kill(group.pool.processes[0].pid, number)
    large = SECOND._replace(weights=bytes(10_000_000))  # more than a pipe holds
    with pytest.raises(WorkerError, match=rf"^worker process 1 of 2 \(agents 0\) {told}$"):
        group.ask(large)
