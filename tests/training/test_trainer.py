"""The training loop: what it counts, when it looks and saves, and that training is real, for every row."""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule, SoftUpdate

from rcdsac_trl.config.schedule import Schedule
from rcdsac_trl.errors import TrainingError, UserInputError
from rcdsac_trl.rollout.env_workers import EnvWorkers
from rcdsac_trl.rollout.episode_collectors import TorchRLEpisodeCollector
from rcdsac_trl.rollout.make_agent import make_loss
from rcdsac_trl.rollout.metrics import METRICS
from rcdsac_trl.storage.checkpoint import load_weights
from rcdsac_trl.storage.checkpoint_record import Progress
from rcdsac_trl.system.invocation import program
from rcdsac_trl.system.processes import WorkerError
from rcdsac_trl.training.learner import LOSS_KEYS, Learner
from rcdsac_trl.training.restart_budget import RestartBudget
from rcdsac_trl.training.run_log import RunLog
from rcdsac_trl.training.trainer import StopTraining, Trainer, saved_sentence
from rcdsac_trl.training.validation import Snapshot, Validation
from rcdsac_trl.world.maps.shapes import Map
from rcdsac_trl.world.task import episode
from rcdsac_trl.world.task.env import NavigationEnv, make_env
from tiny import (
    AGENTS,
    ITERATIONS,
    NARROW,
    ROWS,
    STEPS,
    UPDATES,
    evaluate,
    evaluation_betas,
    filled_learner,
    load_progress,
    tiny_settings,
    tiny_trainer,
)

METRIC_COLUMNS = list(METRICS)


# ------------------------------------------------------------------------------------------------ the loop, with stubs
FAULTY: set[int] = set()
"""Maps on which a worker of the stubs dies."""


class Collector:
    """Yields episodes whose reward says which iteration they are from."""

    def __init__(self, events: list[Any], iteration: int, map_index: int) -> None:
        self.events = events
        self.iteration = iteration
        self.map_index = map_index

    def __iter__(self) -> Iterator[TensorDictBase]:
        for iteration, map_index in zip(count(self.iteration), count(self.map_index), strict=False):
            self.events.append(("collect", iteration, map_index))
            if map_index in FAULTY:
                raise WorkerError("worker process 1 of 1 was killed by SIGKILL")
            components = torch.zeros(1, 2, 4, 5)
            components[:, 0, :, 1] = iteration
            components[:, 1, :, 1] = 10.0 * iteration
            flag = torch.zeros(1, 2, 4, 1, dtype=torch.bool)
            after = {
                "contact": flag,
                "goal_reached": flag,
                "reward_components": components,
                "velocity": torch.zeros(1, 2, 4, 4),
            }
            risk = torch.tensor([-1.0, -2.0]).view(1, 2, 1, 1).expand(1, 2, 4, 1)
            # One worker with two agents, four steps: [workers, agents, time].
            yield TensorDict({"risk": risk, "next": after}, batch_size=[1, 2, 4])

    def shutdown(self, raise_on_error: bool = True) -> None:
        assert not raise_on_error
        self.events.append("collector closed")


class StubLearner(Learner):
    """Notes what it is asked for."""

    def __init__(self, events: list[Any], interrupt_in: int | None = None, begun_after: int = 0) -> None:
        self.events = events
        self.interrupt_in = interrupt_in
        self.begun_after = begun_after
        self.calls = 0
        self.replay = self  # type: ignore[assignment]

    def add_episodes(self, episodes: TensorDictBase) -> None:
        assert episodes.batch_size == torch.Size([2, 4])
        self.events.append("store")

    def updates(self, number: int, distortion_strength: float, learning_rate_share: float) -> dict[str, float]:
        if self.calls == self.interrupt_in:
            raise KeyboardInterrupt
        self.calls += 1
        self.events.append(("update", number, distortion_strength, learning_rate_share))
        return {"loss_qvalue": 1.0}

    def averaged_actor(self) -> bytes:
        return b"actor after %d iterations" % (self.begun_after + self.calls)


class StubEvaluator:
    """Finds episodes of two conditions whose mean reward is the next of some scores."""

    def __init__(self, events: list[Any], scores: Sequence[float], beside: bool) -> None:
        self.events = events
        self.scores = iter(scores)
        self.steps = 4
        self.beside = beside
        self.snapshot: Snapshot | None = None

    def start(self, snapshot: Snapshot, *, alone: bool) -> None:
        assert self.snapshot is None
        assert snapshot.actor == b"actor after %d iterations" % snapshot.progress.iterations
        self.snapshot = snapshot
        self.events.append(("validate", snapshot.progress.iterations, "alone" if alone else "beside"))

    def poll(self) -> None:
        if self.snapshot is not None:
            self.events.append("poll")

    def finish(self) -> pd.DataFrame:
        assert self.snapshot is not None
        self.events.append(("validated", self.snapshot.progress.iterations))
        score = next(self.scores)
        if math.isnan(score):
            raise WorkerError("driving process 1 of 1 made no step within 1 s")
        self.snapshot = None
        rows = pd.DataFrame({"beta": [-2.0, -2.0, -1.0], "collision_weight": [math.nan] * 3})
        # Conditions count alike, however many episodes they have.
        rows[METRIC_COLUMNS] = 0.0
        rows["reward"] = [score + 3.0, score - 1.0, score - 1.0]
        return rows

    def close(self) -> None:
        self.events.append("validation closed")


class StubCheckpoints:
    """Notes what is saved."""

    def __init__(self, events: list[Any]) -> None:
        self.events = events
        self.saved_iterations: int | None = None

    def save(self, progress: Progress, logs: dict[str, int]) -> None:
        self.events.append(("save", progress))
        self.saved_iterations = progress.iterations


class StubGuard:
    """Notes when it looks."""

    def __init__(self, events: list[Any], fail_in: int | None = None) -> None:
        self.events = events
        self.fail_in = fail_in

    def start_iteration(self, iteration: int) -> None:
        self.iteration = iteration

    def check_episodes(self, episodes: TensorDictBase) -> None:
        self.events.append("check episodes")

    def end_iteration(self) -> None:
        self.events.append("check updates")
        if self.iteration == self.fail_in:
            raise TrainingError("it is NaN")


class StubLock:
    def __init__(self, events: list[Any]) -> None:
        self.events = events

    def close(self) -> None:
        self.events.append("lock open")


def stub_trainer(folder: Path, events: list[Any], **changes: Any) -> Trainer:
    schedule = {
        "iterations": 5,
        "updates_per_iteration": 3,
        "pursuit_iterations": 0,
        "pursuit_noise": 0.0,
        "neutral_iterations": 1,
        "ramp_iterations": 2,
        "decay_iterations": 2,
        "final_learning_rate_share": 0.5,
    }
    parts = {
        "scores": range(100),
        "validate_every": 1,
        "beside": False,
        "pending": None,
        "checkpoint_every": 100,
        "interrupt_in": None,
        "fail_in": None,
        "max_restarts": 3,
        "progress": Progress(),
        "on_iteration_end": None,
    } | changes
    layout = Schedule(**schedule | changes.get("schedule", {}))
    checkpoints, log = StubCheckpoints(events), RunLog(folder, [])
    restarts = RestartBudget(
        parts["max_restarts"],
        parts["progress"].restarts,
        message=log.message,
        saved=lambda: saved_sentence(checkpoints, log),  # type: ignore[arg-type]
    )
    return Trainer(
        schedule=layout,
        progress=parts["progress"],
        episodes=TorchRLEpisodeCollector(
            lambda iteration, map_index: Collector(events, iteration, map_index),  # type: ignore[arg-type,return-value]
            lambda iteration: events.append(("iteration", iteration)),
            workers=EnvWorkers([], None),
            begin=lambda map_index: None,
        ),
        learner=StubLearner(events, parts["interrupt_in"], parts["progress"].iterations),
        guard=StubGuard(events, parts["fail_in"]),  # type: ignore[arg-type]
        validation=Validation(
            StubEvaluator(events, parts["scores"], parts["beside"]),  # type: ignore[arg-type]
            iterations=layout.iterations,
            every_iterations=parts["validate_every"],
            restarts=restarts,
            log=log,
            pending=parts["pending"],
        ),
        checkpoints=checkpoints,  # type: ignore[arg-type]
        checkpoint_every=parts["checkpoint_every"],
        restarts=restarts,
        log=log,
        lock=StubLock(events),  # type: ignore[arg-type]
        context_key="risk",
        on_iteration_end=parts["on_iteration_end"],
    )


def kinds(events: list[Any], kind: str) -> list[Any]:
    return [event for event in events if (event[0] if isinstance(event, tuple) else event) == kind]


def test_an_iteration_collects_stores_updates_validates_and_saves_in_this_order(tmp_path: Path) -> None:
    events: list[Any] = []
    stub_trainer(tmp_path, events, schedule={"iterations": 1}).run()
    names = [event if isinstance(event, str) else event[0] for event in events]
    assert names == [
        *("save", "iteration", "collect", "check episodes", "store", "update", "check updates", "validate"),
        *("validated", "save"),
        *("collector closed", "validation closed", "lock open"),
    ]


def test_steps_and_updates_are_counted(tmp_path: Path) -> None:
    events: list[Any] = []
    trainer = stub_trainer(tmp_path, events, checkpoint_every=2, validate_every=100, scores=[-1.0])
    trainer.run()
    assert (trainer.progress.steps, trainer.progress.updates) == (5 * 2 * 4, 5 * 3)
    saved = [event[1] for event in kinds(events, "save")]
    assert [(progress.iterations, progress.steps, progress.updates) for progress in saved] == [
        (0, 0, 0),
        (2, 16, 6),
        (4, 32, 12),
        (5, 40, 15),
    ]
    assert 0 < saved[1].elapsed_s < saved[2].elapsed_s


def test_a_run_goes_on_from_its_progress(tmp_path: Path) -> None:
    events: list[Any] = []
    done = Progress(iterations=3, steps=24, updates=9, elapsed_s=1000.0, best_score=5.0, best_iterations=2)
    trainer = stub_trainer(tmp_path, events, progress=done, scores=[5.0, 6.0])
    trainer.checkpoints.saved_iterations = 3
    trainer.run()
    assert [event[1] for event in kinds(events, "iteration")] == [3, 4]
    assert [event[2:] for event in kinds(events, "update")] == [(1.0, 0.75), (1.0, 0.5)]
    # The fourth iteration's score is not above the best one's, the fifth's is.
    progress = kinds(events, "save")[-1][1]
    assert progress.elapsed_s > 1000.0
    assert replace(progress, elapsed_s=0.0) == Progress(5, 40, 15, 0.0, 6.0, 5)


def test_each_iteration_is_told_before_its_episodes_and_its_updates_get_its_strength(tmp_path: Path) -> None:
    events: list[Any] = []
    stub_trainer(tmp_path, events).run()
    assert [event[1] for event in kinds(events, "iteration")] == [0, 1, 2, 3, 4]
    told = [event[:2] for event in events if event[0] in ("iteration", "collect")]
    assert told == [(kind, iteration) for iteration in range(5) for kind in ("iteration", "collect")]
    # one neutral iteration, then a ramp of two; the learning rates fall in the last two
    assert [event[1] for event in kinds(events, "update")] == [3] * 5
    assert [event[2] for event in kinds(events, "update")] == [0.0, 0.5, 1.0, 1.0, 1.0]
    assert [event[3] for event in kinds(events, "update")] == [1.0, 1.0, 1.0, 0.75, 0.5]


@pytest.mark.parametrize(("every", "validated"), [(1, 5), (2, 3), (5, 1), (50, 1)])
def test_validation_comes_every_so_often_and_at_the_end(tmp_path: Path, every: int, validated: int) -> None:
    events: list[Any] = []
    stub_trainer(tmp_path, events, validate_every=every).run()
    assert len(kinds(events, "validate")) == validated


def test_best_is_the_highest_validation_score(tmp_path: Path) -> None:
    events: list[Any] = []
    trainer = stub_trainer(tmp_path, events, scores=[-50.0, -20.0, -30.0, -20.0, -10.0])
    trainer.run()
    saved = [event[1] for event in kinds(events, "save")][1:]
    # An equal score is no better: the earlier agent stays. Every best one is saved, and after the last iteration.
    assert [(progress.iterations, progress.best_iterations, progress.best_score) for progress in saved] == [
        (1, 1, -50.0),
        (2, 2, -20.0),
        (5, 5, -10.0),
    ]


def test_what_runs_beside_is_taken_in_when_the_next_is_due_and_changes_nothing(tmp_path: Path) -> None:
    ran: dict[bool, list[Any]] = {True: [], False: []}
    logged: dict[bool, list[tuple[int, float]]] = {True: [], False: []}
    scores = [-50.0, -20.0, -30.0]
    for beside, events in ran.items():
        (tmp_path / str(beside)).mkdir()
        trainer = stub_trainer(tmp_path / str(beside), events, beside=beside, scores=scores, validate_every=2)
        scalars = logged[beside]
        trainer.log.scalars = lambda values, step, scalars=scalars: scalars.extend(  # type: ignore[method-assign]
            (step, values[key]) for key in values if key == "validation/score"
        )
        trainer.run()
        assert (trainer.progress.best_score, trainer.progress.best_iterations) == (-20.0, 4)
    kept = ("update", "validate", "poll", "validated")
    assert [event for event in ran[True] if event[0] in kept or event in kept] == [
        *(("update", 3, 0.0, 1.0), ("update", 3, 0.5, 1.0), ("validate", 2, "beside")),
        *(("update", 3, 1.0, 1.0), "poll", ("update", 3, 1.0, 0.75), ("validated", 2), ("validate", 4, "beside")),
        *(("update", 3, 1.0, 0.5), ("validated", 4), ("validate", 5, "alone"), ("validated", 5)),
    ]
    # What is found stands where it belongs, whenever it was found.
    assert logged[True] == logged[False] == [(16, -50.0), (32, -20.0), (40, -30.0)]
    name = "validation_episodes.csv"
    assert (tmp_path / "True" / name).read_bytes() == (tmp_path / "False" / name).read_bytes()
    # The agent under validation is in a checkpoint that names it, until the one that knows the result.
    saved = [event[1] for event in kinds(ran[True], "save")]
    assert [(p.iterations, p.validating_iterations, p.best_iterations) for p in saved] == [
        (0, None, None), (2, 2, None), (4, 4, 2), (5, None, 4),
    ]  # fmt: skip
    told = (tmp_path / "True" / "train.log").read_text()
    assert told.index("validation after 2 iterations") > told.index("   3/5") > told.index("   2/5")


def test_a_run_goes_on_with_the_validation_that_was_under_way(tmp_path: Path) -> None:
    events: list[Any] = []
    snapshot = Snapshot(Progress(2, 16, 6, validating_iterations=2), b"actor after 2 iterations")
    done = Progress(3, 24, 9, validating_iterations=2)
    trainer = stub_trainer(tmp_path, events, progress=done, pending=snapshot, validate_every=2, beside=True)
    trainer.run()
    assert [event for event in events if event[0] in ("validate", "validated", "collect")] == [
        *(("validate", 2, "beside"), ("collect", 3, 3), ("validated", 2), ("validate", 4, "beside")),
        *(("collect", 4, 4), ("validated", 4), ("validate", 5, "alone"), ("validated", 5)),
    ]
    rows = pd.read_csv(tmp_path / "validation_episodes.csv")
    assert rows[["iteration", "updates"]].drop_duplicates().to_numpy().tolist() == [[1, 6], [3, 12], [4, 15]]


def test_a_hook_sees_every_iteration_once_it_is_logged_and_before_it_is_saved(tmp_path: Path) -> None:
    seen: list[tuple[int, int | None, float]] = []

    def hook(trainer: Trainer, record: Mapping[str, float]) -> None:
        logged = len(pd.read_csv(tmp_path / "training_episodes.csv")) // 2
        assert logged == trainer.progress.iterations
        seen.append((trainer.progress.iterations, trainer.checkpoints.saved_iterations, record["train/reward"]))

    trainer = stub_trainer(tmp_path, [], checkpoint_every=1, on_iteration_end=hook, schedule={"iterations": 3})
    trainer.run()
    assert seen == [(1, 0, 0.0), (2, 1, 22.0), (3, 2, 44.0)]


def continuation(folder: Path) -> str:
    """Return what is said of how a run goes on: a line to be copied."""
    return f"continue: {program()} train resume={folder}"


def test_a_hook_may_stop_a_run_and_its_error_ends_it(tmp_path: Path) -> None:
    def stop(trainer: Trainer, record: Mapping[str, float]) -> None:
        if trainer.progress.iterations == 2:
            raise StopTraining("good enough")

    events: list[Any] = []
    stub_trainer(tmp_path, events, validate_every=100, on_iteration_end=stop).run()
    assert [event[1].iterations for event in kinds(events, "save")] == [0, 2]
    assert events[-3:] == ["collector closed", "validation closed", "lock open"]
    sentence = f"stopped after 2 iterations (good enough); 2 iterations are saved, {continuation(tmp_path)}"
    assert (tmp_path / "train.log").read_text().splitlines()[-1] == sentence

    def fail(trainer: Trainer, record: Mapping[str, float]) -> None:
        raise ZeroDivisionError

    events.clear()
    with pytest.raises(ZeroDivisionError):
        stub_trainer(tmp_path, events, checkpoint_every=1, on_iteration_end=fail).run()
    sentence = "on_iteration_end failed in iteration 1 (ZeroDivisionError:); 0 iterations are saved, continue: "
    assert sentence in (tmp_path / "train.log").read_text()
    assert events[-3:] == ["collector closed", "validation closed", "lock open"]


def test_wrong_input_that_a_hook_finds_is_logged_once(tmp_path: Path) -> None:
    def refuse(trainer: Trainer, record: Mapping[str, float]) -> None:
        raise UserInputError("beta=9 is none")

    events: list[Any] = []
    told = f"beta=9 is none: training stops in iteration 1; 0 iterations are saved, {continuation(tmp_path)}"
    with pytest.raises(UserInputError, match=f"^{re.escape(told)}$"):
        stub_trainer(tmp_path, events, on_iteration_end=refuse).run()
    assert [line for line in (tmp_path / "train.log").read_text().splitlines() if "beta=9" in line] == [told]
    assert events[-3:] == ["collector closed", "validation closed", "lock open"]


def test_ctrl_c_drops_the_iteration_and_closes_everything(tmp_path: Path) -> None:
    events: list[Any] = []
    trainer = stub_trainer(tmp_path, events, interrupt_in=2, validate_every=100, checkpoint_every=1)
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    assert [event[1].iterations for event in kinds(events, "save")] == [0, 1, 2]
    assert events[-3:] == ["collector closed", "validation closed", "lock open"]
    told = f"interrupted in iteration 3; 2 iterations are saved, {continuation(tmp_path)}"
    assert told in (tmp_path / "train.log").read_text().splitlines()


def test_what_is_not_finite_ends_a_run_before_it_is_saved(tmp_path: Path) -> None:
    events: list[Any] = []
    trainer = stub_trainer(tmp_path, events, fail_in=2, checkpoint_every=1)
    with pytest.raises(TrainingError, match="it is NaN"):
        trainer.run()
    assert [event[1].iterations for event in kinds(events, "save")] == [0, 1, 2]
    assert events[-3:] == ["collector closed", "validation closed", "lock open"]
    assert (tmp_path / "train.log").read_text().splitlines()[-1] == "it is NaN"


def test_training_episodes_stand_under_the_updates_they_were_driven_with(tmp_path: Path) -> None:
    stub_trainer(tmp_path, [], schedule={"iterations": 2}).run()
    rows = pd.read_csv(tmp_path / "training_episodes.csv")
    assert list(rows) == ["iteration", "updates", "episode", "beta", *METRICS]
    assert rows["iteration"].tolist() == [0, 0, 1, 1]
    assert rows["updates"].tolist() == [0, 0, 3, 3]
    assert rows["episode"].tolist() == [0, 1, 0, 1]
    assert rows["beta"].tolist() == [-1.0, -2.0, -1.0, -2.0]
    assert rows["reward"].tolist() == [0.0, 0.0, 4.0, 40.0]


def test_training_metrics_are_logged_for_all_and_for_each_half_of_beta(tmp_path: Path) -> None:
    trainer = stub_trainer(tmp_path, [], schedule={"iterations": 2})
    records: list[dict[str, float]] = []
    trainer.log.scalars = lambda values, step: records.append({"step": step, **values})  # type: ignore[method-assign]
    trainer.run()
    records = [record for record in records if "validation/score" not in record]
    # Of the two agents the averse one (beta -2) is the second, whose reward is 40 in iteration 1.
    reward = [
        {key.partition("reward")[2]: record[key] for key in record if "train/reward" in key} for record in records
    ]
    assert reward[0] == {"": 0.0, "/low_beta": 0.0, "/high_beta": 0.0}
    assert reward[1] == {"": 22.0, "/low_beta": 40.0, "/high_beta": 4.0}
    assert [record["step"] for record in records] == [8, 16]  # one row an iteration


def test_validation_episodes_stand_under_the_updates_before_them(tmp_path: Path) -> None:
    stub_trainer(tmp_path, [], schedule={"iterations": 2}, scores=[5.0, 6.0]).run()
    rows = pd.read_csv(tmp_path / "validation_episodes.csv")
    assert list(rows) == ["iteration", "updates", "beta", "collision_weight", *METRICS]
    assert rows["updates"].tolist() == [3, 3, 3, 6, 6, 6]
    assert rows["reward"].tolist() == [8.0, 4.0, 4.0, 9.0, 5.0, 5.0]


def test_losses_are_averaged_over_the_updates() -> None:
    class Counting(Learner):
        def __init__(self) -> None:
            self.value = 0.0
            self.strengths: list[float] = []
            self.loss = SimpleNamespace(distortion_strength=None)
            self.optimizer = SimpleNamespace(param_groups=[{"lr": 1.0}, {"lr": 3.0}])  # type: ignore[assignment]
            self._learning_rates = [2.0, 4.0]

        def update(self) -> dict[str, torch.Tensor]:
            self.value += 1.0
            self.strengths.append(self.loss.distortion_strength)
            return {"a": torch.tensor(self.value), "b": torch.tensor(-self.value)}

    learner = Counting()
    assert learner.updates(4, 0.5, 0.25) == {"a": 2.5, "b": -2.5}
    assert learner.strengths == [0.5] * 4
    # Shares are of the rates at the start, not of those of the updates before.
    assert [group["lr"] for group in learner.optimizer.param_groups] == [0.5, 1.0]
    assert learner.updates(0, 0.5, 1.0) == {}
    assert [group["lr"] for group in learner.optimizer.param_groups] == [2.0, 4.0]


# ------------------------------------------------------------------------------------------------ every row, for real
def fresh_loss(row: str = "rcdsac_pow", *overrides: str) -> LossModule:
    """Return the loss that a training of a row begins with."""
    loss = make_loss(tiny_settings(row, *overrides), "cpu")
    SoftUpdate(loss, tau=0.001)  # TorchRL warns of targets that nothing moves
    return loss


def networks(loss: LossModule) -> dict[str, torch.Tensor]:
    """Every weight by its name: those of actor, critics and their targets, and the temperature."""
    parts = {
        "actor": loss.actor_network_params,
        "critic": loss.critic_network_params,
        "target": loss.target_critic_network_params,
    }
    named = {
        f"{part}/{'/'.join(key)}": value for part, params in parts.items() for key, value in params.items(True, True)
    } | {"alpha": loss.log_alpha}
    # Constants, such as the frequencies of the cosines, are no weights.
    learnt = {name for name, value in named.items() if isinstance(value, torch.nn.Parameter)}
    learnt |= {name for name in named if name.replace("target/", "critic/") in learnt}
    return {name: named[name].detach().clone() for name in sorted(learnt)}


Trained = Callable[[str], tuple[Path, Trainer]]
"""Gives the finished tiny training of a row."""


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """Finished tiny trainings with narrow networks, one a row that is asked for; tests change nothing of them."""

    @cache
    def of_row(row: str) -> tuple[Path, Trainer]:
        folder = tmp_path_factory.mktemp(row) / "run"
        trainer = tiny_trainer(folder, row, NARROW)
        trainer.run()
        return folder, trainer

    return of_row


@pytest.mark.parametrize("row", ROWS)
def test_training_changes_every_network(trained: Trained, row: str) -> None:
    before = networks(fresh_loss(row, NARROW))
    after = networks(trained(row)[1].learner.loss)
    assert before.keys() == after.keys()
    unchanged = [name for name in before if torch.equal(before[name], after[name])]
    assert unchanged == []
    assert all(value.isfinite().all() for value in after.values())


@pytest.mark.parametrize("row", ROWS)
def test_an_update_moves_each_network_by_its_own_rule(row: str) -> None:
    learner = filled_learner(row, NARROW)
    learner.updates(UPDATES, 1.0, 1.0)
    before = networks(learner.loss)
    losses = learner.update()
    after = networks(learner.loss)
    assert set(LOSS_KEYS) <= set(losses)
    assert all(value.isfinite().all() and not value.requires_grad for value in losses.values())
    assert all(parameter.grad is None for group in learner.optimizer.param_groups for parameter in group["params"])

    settings = tiny_settings(row).learner
    rates = {"actor": settings.actor_lr, "critic": settings.critic_lr, "alpha": settings.alpha_lr}
    for name in before:
        part = name.split("/")[0]
        if part == "target":  # moves by the coefficient towards what the critic has just become
            online = after[name.replace("target/", "critic/")]
            expected = before[name].lerp(online, settings.target_coefficient)
            torch.testing.assert_close(after[name], expected, rtol=0, atol=1e-7)
        else:  # Adam's steps are of the learning rate's size, and no larger for long
            step = (after[name] - before[name]).abs().max().item()
            assert 0 < step < 3 * rates[part], name


def test_the_average_follows_the_actor_by_its_decay() -> None:
    learner = filled_learner("rcdsac_pow", NARROW, "learner.actor_average_decay=0.75")
    learner.updates(UPDATES, 1.0, 1.0)
    before = [p.detach().clone() for p in learner.average.module.parameters()]
    learner.update()
    online = list(learner.loss.actor_network.parameters())
    for old, new, actor in zip(before, learner.average.module.parameters(), online, strict=True):
        torch.testing.assert_close(new, 0.75 * old + 0.25 * actor, rtol=0, atol=1e-6)


def test_without_decay_the_average_is_the_actor() -> None:
    learner = filled_learner("rcdsac_pow", NARROW)
    learner.updates(UPDATES, 1.0, 1.0)
    pairs = zip(learner.average.module.parameters(), learner.loss.actor_network.parameters(), strict=True)
    assert all(torch.equal(average, actor) for average, actor in pairs)


@pytest.mark.parametrize("row", ["rcdsac_pow", "dsac_cvar", "rcwr", "sac"])  # told beta, one, a weight, nothing
def test_a_run_evaluates(trained: Trained, row: str) -> None:
    betas = evaluation_betas(row)
    out = evaluate(f"run={trained(row)[0]}", *([f"beta={betas}"] if betas else []))
    episodes = pd.read_csv(out / "episodes.csv")
    conditions = len(betas) or len(tiny_settings(row).algo.default_conditions)
    assert len(episodes) == conditions * 2
    assert episodes[METRIC_COLUMNS].notna().all(axis=None)


@pytest.mark.parametrize("row", ROWS)
def test_a_run_logs_what_its_row_tells(trained: Trained, row: str) -> None:
    folder, _ = trained(row)
    algo = tiny_settings(row).algo
    training = pd.read_csv(folder / "training_episodes.csv")
    told = {"risk": ["beta"], "collision_weight": ["collision_weight"], None: []}[algo.context_key]
    assert list(training) == ["iteration", "updates", "episode", *told, *METRICS]
    assert len(training) == ITERATIONS * AGENTS
    validation = pd.read_csv(folder / "validation_episodes.csv")
    assert list(validation) == ["iteration", "updates", "beta", "collision_weight", "map", "episode", *METRICS]
    assert len(validation) == ITERATIONS * len(algo.default_conditions) * AGENTS
    seen = validation[["beta", "collision_weight"]].drop_duplicates().astype(object).where(pd.notna, None)
    asked = [(c.beta, c.collision_weight) for c in algo.default_conditions]
    assert sorted(map(tuple, seen.to_numpy().tolist()), key=str) == sorted(asked, key=str)


@pytest.mark.parametrize("row", [row for row in ROWS if row.startswith("rc")])  # the others are told nothing
def test_every_episode_is_told_a_number_of_its_own(trained: Trained, row: str) -> None:
    algo = tiny_settings(row).algo
    training = pd.read_csv(trained(row)[0] / "training_episodes.csv")
    if algo.context_key == "risk":  # the whole range from the first iteration, also while its distortion is ramped up
        low, high, told = algo.distortion.low, algo.distortion.high, training["beta"]
    else:
        assert algo.told_weights is not None
        (low, high), told = algo.told_weights, training["collision_weight"]
    assert told.between(low, high).all()
    assert told.nunique() == AGENTS * ITERATIONS


def test_the_distortion_is_ramped_up_to_all_of_it(trained: Trained) -> None:
    _, trainer = trained("rcdsac_pow")
    # The smoke schedule: one neutral iteration, then a ramp of one.
    assert [trainer.schedule.distortion_strength(iteration) for iteration in range(ITERATIONS)] == [0.0, 1.0]
    assert trainer.learner.loss.distortion_strength == 1.0


def test_one_agent_alone_trains_too(tmp_path: Path) -> None:
    trainer = tiny_trainer(tmp_path / "run", "rcdsac_pow", NARROW, "world.num_agents=1", "schedule.iterations=1")
    records: list[dict[str, float]] = []
    trainer.log.scalars = lambda values, step: records.append(dict(values))  # type: ignore[method-assign, assignment]
    trainer.run()
    assert len(records) == 2  # of the validation and of the iteration
    assert all(math.isfinite(value) for record in records for value in record.values())


@pytest.mark.parametrize("row", ["rcdsac_pow", "rcwr"])
def test_gradients_are_clipped_per_network(row: str) -> None:
    limit = 1e-3
    learner = filled_learner(row, NARROW, f"learner.max_grad_norm={limit}")
    optimizer, norms = learner.optimizer, []
    step = optimizer.step

    def watched_step() -> None:
        groups = [[p.grad.flatten() for p in group["params"]] for group in optimizer.param_groups]
        norms.append([torch.cat(group).norm().item() for group in groups])
        step()

    optimizer.step = watched_step  # type: ignore[method-assign, assignment]
    learner.updates(UPDATES, 1.0, 1.0)
    assert len(norms) == UPDATES
    for actor, critics, alpha in norms:
        assert actor == pytest.approx(limit, rel=1e-3)
        assert critics == pytest.approx(limit, rel=1e-3)
        assert alpha > limit  # a single number needs no clipping


# ------------------------------------------------------------------------------------------------ repeatability
def saved_weights(run: Path, *overrides: str) -> dict[str, torch.Tensor]:
    loss = fresh_loss("rcdsac_pow", *overrides)
    load_weights(run / "checkpoints", "last", loss=loss)
    return networks(loss)


def assert_equal_runs(first: Path, second: Path) -> None:
    for table in ("training_episodes.csv", "validation_episodes.csv"):
        assert (first / table).read_bytes() == (second / table).read_bytes(), table
    a, b = saved_weights(first), saved_weights(second)
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_the_same_seed_gives_the_same_run_bit_for_bit(tiny_run: Path, tmp_path: Path) -> None:
    torch.manual_seed(99)  # the global generator has no say
    tiny_trainer(tmp_path / "again").run()
    assert_equal_runs(tiny_run, tmp_path / "again")


def test_another_seed_gives_another_run(tiny_run: Path, tmp_path: Path) -> None:
    tiny_trainer(tmp_path / "other", "rcdsac_pow", "seed=1").run()
    table = "training_episodes.csv"
    assert (tiny_run / table).read_bytes() != (tmp_path / "other" / table).read_bytes()
    a, b = saved_weights(tiny_run), saved_weights(tmp_path / "other", "seed=1")
    assert not any(torch.equal(a[name], b[name]) for name in a if value_varies(a[name]))


def value_varies(value: torch.Tensor) -> bool:
    return bool((value != value.flatten()[0]).any())


def test_threads_do_not_change_a_run(tmp_path: Path) -> None:
    trainers = {}
    for threads in (1, 3):
        given = "learner.batch_size=8", f"threads={threads}"  # enough for the compiled twins
        trainers[threads] = tiny_trainer(tmp_path / str(threads), "rcdsac_pow", *given)
        assert (trainers[threads].learner.loss.threads, torch.get_num_threads()) == (threads, 1)
        trainers[threads].run()
    assert_equal_runs(tmp_path / "1", tmp_path / "3")


@pytest.mark.parametrize("workers", [1, 2])
def test_workers_do_not_change_a_run(
    tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, workers: int
) -> None:
    """Workers in this process: the same code with the same shapes, without the time that processes take."""
    driven: list[torch.Size] = []

    def make(*args: Any, **given: Any) -> EnvBase:
        env = make_env(*args, **given, serial=True)
        driven.append(env.batch_size)
        return env

    monkeypatch.setattr("rcdsac_trl.rollout.environments.make_env", make)
    trainer = tiny_trainer(tmp_path / "run", "rcdsac_pow", "collector=parallel_env", f"world.num_workers={workers}")
    assert isinstance(trainer.episodes, TorchRLEpisodeCollector)
    trainer.run()
    assert torch.Size([workers, AGENTS // workers]) in driven
    assert_equal_runs(tiny_run, tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize("given", [["collector=parallel_env", "world.num_workers=2"], ["collector.num_processes=2"]])
def test_worker_processes_do_not_change_a_run(tiny_run: Path, tmp_path: Path, given: list[str]) -> None:
    tiny_trainer(tmp_path / "run", "rcdsac_pow", *given).run()
    assert_equal_runs(tiny_run, tmp_path / "run")


@pytest.fixture
def faulty() -> Iterator[set[int]]:
    yield FAULTY
    FAULTY.clear()


def test_an_iteration_whose_workers_fail_is_driven_on_the_next_map(tmp_path: Path, faulty: set[int]) -> None:
    events: list[Any] = []
    faulty.update([1, 4, 5])
    stub_trainer(tmp_path, events, checkpoint_every=1).run()
    # What fails is neither stored nor counted, and every later iteration is one map further on.
    assert [event[1:] for event in kinds(events, "collect")] == [
        (0, 0), (1, 1), (1, 2), (2, 3), (3, 4), (3, 5), (3, 6), (4, 7),
    ]  # fmt: skip
    assert [event[1] for event in kinds(events, "iteration")] == [0, 1, 1, 2, 3, 3, 3, 4]
    assert events.count("store") == 5
    saved = [event[1] for event in kinds(events, "save")]
    assert [(p.iterations, p.steps, p.restarts, p.skipped_maps) for p in saved] == [
        (0, 0, 0, 0), (1, 8, 0, 0), (2, 16, 1, 1), (3, 24, 1, 1), (4, 32, 3, 3), (5, 40, 3, 3),
    ]  # fmt: skip
    told = (tmp_path / "train.log").read_text().splitlines()
    assert told[4:6] == [
        "iteration 2, training map 1: worker process 1 of 1 was killed by SIGKILL; restart 1 of at most 3",
        "the episodes on map 1 are dropped: iteration 2 drives on the next",
    ]
    # A run that is continued goes on behind the maps that were given up.
    events.clear()
    trainer = stub_trainer(tmp_path, events, progress=replace(saved[2]))
    trainer.run()
    assert kinds(events, "collect")[0] == ("collect", 2, 3)


def test_a_validation_whose_workers_fail_begins_again(tmp_path: Path) -> None:
    events: list[Any] = []
    stub_trainer(tmp_path, events, scores=[1.0, math.nan, math.nan, 2.0], validate_every=2, checkpoint_every=1,
                 schedule={"iterations": 4}).run()  # fmt: skip
    assert kinds(events, "validated") == [("validated", 2)] + [("validated", 4)] * 3
    last = kinds(events, "save")[-1][1]
    assert (last.best_score, last.best_iterations, last.restarts, last.skipped_maps) == (2.0, 4, 2, 0)
    assert (
        "validation after 4 iterations: driving process 1 of 1 made no step within 1 s; restart 2 of at most 3"
        in (tmp_path / "train.log").read_text()
    )


def test_workers_that_fail_too_often_end_a_run(tmp_path: Path, faulty: set[int]) -> None:
    events: list[Any] = []
    faulty.update([2, 3])
    trainer = stub_trainer(tmp_path, events, checkpoint_every=1, max_restarts=1)
    told = (
        "iteration 3, training map 3: worker process 1 of 1 was killed by SIGKILL; world.max_restarts=1 allows no "
        f"further restart: training stops; 2 iterations are saved, {continuation(tmp_path)}"
    )
    with pytest.raises(TrainingError, match=re.escape(told)):
        trainer.run()
    assert [event[1].iterations for event in kinds(events, "save")] == [0, 1, 2]
    assert events[-2:] == ["validation closed", "lock open"]
    assert events.count("collector closed") == 2
    assert (tmp_path / "train.log").read_text().splitlines()[-1] == told


# ------------------------------------------------------------------------------------------------ maps and episodes
Spied = list[tuple[str, int, int, Map]]


@pytest.fixture
def spied_maps(monkeypatch: pytest.MonkeyPatch) -> Iterator[Spied]:
    """Every map that is generated: split, seed, index and the map itself."""
    seen: Spied = []
    original: Callable[..., Map] = episode.make_map

    def spy(source: Any, split: str, seed: int, index: int, robot_radius_m: float) -> Map:
        map_ = original(source, split, seed, index, robot_radius_m)
        seen.append((split, seed, index, map_))
        return map_

    episode.load_map.cache_clear()
    monkeypatch.setattr(episode, "make_map", spy)
    yield seen
    episode.load_map.cache_clear()


def test_training_maps_are_never_validated_or_evaluated_on(tmp_path: Path, spied_maps: Spied) -> None:
    tiny_trainer(tmp_path / "run", "rcdsac_pow", NARROW, "seed=0").run()
    training = {(split, seed) for split, seed, _, _ in spied_maps if split == "train"}
    validation = {(split, seed) for split, seed, _, _ in spied_maps if split != "train"}
    assert (training, validation) == ({("train", 0)}, {("validation", 0)})
    of_training = [entry for entry in spied_maps if entry[0] == "train"]
    before = len(spied_maps)
    # Even with the run's own seed the evaluation's maps are others, because the split is in their stream.
    evaluate(f"run={tmp_path / 'run'}", "beta=[-1]", "seed=0", "num_maps=2")
    of_evaluation = spied_maps[before:]
    assert {(split, seed) for split, seed, _, _ in of_evaluation} == {("evaluation", 0)}
    assert {index for _, _, index, _ in of_evaluation} >= {0, 1}

    def texts(entries: Spied) -> set[str]:
        return {str(map_.to_json()) for _, _, _, map_ in entries}

    assert texts(of_training).isdisjoint(texts([entry for entry in spied_maps if entry[0] != "train"]))


def test_every_validation_sees_the_same_maps_whatever_the_seed_of_the_run(tmp_path: Path, spied_maps: Spied) -> None:
    for seed in (3, 4):
        tiny_trainer(tmp_path / str(seed), "sac", NARROW, f"seed={seed}", "validation.num_maps=2").run()
    looked_at = {(seed, index) for split, seed, index, _ in spied_maps if split == "validation"}
    assert looked_at == {(0, 0), (0, 1)}


@pytest.mark.parametrize("collector", ["multi", "single"])
def test_each_iteration_is_one_new_map_and_an_episode_of_every_agent(tmp_path: Path, collector: str) -> None:
    settings = tiny_settings()
    trainer = tiny_trainer(tmp_path / "run", "rcdsac_pow", f"collector={collector}")
    for iteration in range(ITERATIONS):
        batch = trainer.episodes.collect(iteration, iteration)
        assert batch.batch_size == torch.Size([AGENTS, STEPS])
        fresh = NavigationEnv(settings.training_world, seed=0, first_episode=iteration)
        start = fresh.reset()
        for key in ("range", "waypoint", "velocity"):
            assert torch.equal(batch[key][:, 0], start[key]), key
        fresh.close()
        if collector == "single":  # else nobody asks: an episode is what a worker drives
            # Nobody terminates, and only the time limit truncates.
            assert not batch["next", "terminated"].any()
            assert batch["next", "truncated"].squeeze(-1).tolist() == [[False] * (STEPS - 1) + [True]] * AGENTS
        # What is told stays for the whole episode.
        assert (batch["risk"] == batch["risk"][:, :1]).all()
    trainer.episodes.close()
    trainer.validation.close()
    trainer.log.close()
    trainer.lock.close()


def test_progress_is_saved_with_the_weights(tiny_run: Path) -> None:
    progress = load_progress(tiny_run / "checkpoints", "last")
    assert progress.iterations == ITERATIONS
    assert progress.steps == ITERATIONS * AGENTS * STEPS
    assert progress.updates == ITERATIONS * UPDATES
    validation = pd.read_csv(tiny_run / "validation_episodes.csv")
    means = validation.groupby("iteration")[["reward", "collisions", "contact_fraction"]].mean()
    scores = means["reward"] - 10.0 * means["collisions"] - STEPS * means["contact_fraction"]
    assert progress.best_score == pytest.approx(scores.max(), rel=1e-4)
    assert load_progress(tiny_run / "checkpoints", "best").iterations == scores.idxmax() + 1
