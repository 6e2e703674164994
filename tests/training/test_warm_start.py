"""A training that begins with an agent: it is that agent, of its kind, and what it is not given is said."""

import json
import shutil
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from torchrl.objectives import LossModule

import tiny
from rcdsac_trl import train
from rcdsac_trl.config.checkpoint_name import CheckpointName
from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.run_config import settings_of_run, training_settings
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.release.named_agent import named_agent
from rcdsac_trl.storage.checkpoint import load_states
from rcdsac_trl.storage.checkpoint_record import Saved, find
from rcdsac_trl.system.invocation import program
from rcdsac_trl.training.setup import make_trainer, resume_training
from rcdsac_trl.training.trainer import StopTraining, Trainer
from tiny import TINY, agent_of_before, load_progress

CRITICS, TARGETS = "critic_network_params.", "target_critic_network_params."


def settings(*overrides: str) -> TrainingSettings:
    return training_settings(compose("train", list(overrides)))


def begun(agent: str | Path, folder: Path, *overrides: str) -> Trainer:
    return closed(make_trainer(compose("train", [f"init={agent}", *TINY, *overrides]), folder))


def closed(trainer: Trainer) -> Trainer:
    """End what a trainer holds open, as a run does; what it holds in memory stays."""
    for held in (trainer.episodes, trainer.validation, trainer.log, trainer.lock):
        held.close()
    return trainer


def assert_equal_states(one: torch.nn.Module, other: torch.nn.Module) -> None:
    """Compare all but the state of the loss's random numbers."""
    ours, theirs = ({k: v for k, v in m.state_dict().items() if k != "_extra_state"} for m in (one, other))
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(value, theirs[name]) for name, value in ours.items())


def targets_are_critics(loss: LossModule) -> bool:
    state = loss.state_dict()
    names = [name for name in state if name.startswith(CRITICS)]
    assert names
    return all(torch.equal(state[name], state[TARGETS + name.removeprefix(CRITICS)]) for name in names)


# ------------------------------------------------------------------------------------------------ what is chosen
def test_an_agent_goes_on_as_what_it_is(tmp_path: Path) -> None:
    before = agent_of_before(tmp_path / "before")
    shipped = named_agent(before).settings
    found = settings(f"init={before}", "map=hard")
    assert (found.algo, found.sensor, found.robot) == (shipped.algo, shipped.sensor, shipped.robot)
    assert found.network == shipped.network
    assert found.network.restart_steps == 2  # which the preset's are not
    plain = settings("+algo=dsac_pow", "algo.beta=-1", "map=hard")
    assert found.map == plain.map != shipped.map
    assert found.learner == plain.learner  # hyper-parameters are today's
    early = (found.schedule.pursuit_iterations, found.schedule.neutral_iterations, found.schedule.ramp_iterations)
    assert early == (0, 0, 0)
    assert plain.schedule.pursuit_iterations > 0


def test_what_a_user_chooses_holds(tmp_path: Path) -> None:
    init = f"init={agent_of_before(tmp_path / 'before')}"
    given = (
        "+algo=rcdsac_cvar",
        "sensor=sparse",
        "schedule.pursuit_iterations=2",
        "robot.max_speed_m_per_s=0.3",
    )
    for overrides in ((init, *given), (*given, init)):
        found = settings(*overrides)
        assert (found.algo.name, found.sensor.name) == ("rcdsac_cvar", "sparse")
        assert (found.schedule.pursuit_iterations, found.robot.max_speed_m_per_s) == (2, 0.3)
        assert found.network.restart_steps == 2
    assert settings("+algo=sac", "init=null").init is None


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (["init=nobody"], "^there is no agent 'nobody': "),
        (["+algo=sac", "init=''"], "^init names no agent"),
        (
            ["init=rcdsac_pow-narrow", "algo.beta=-1"],
            r"^algo\.beta=-1\S* does not go with ",
        ),
    ],
)
def test_what_is_no_agent_is_refused(overrides: list[str], told: str) -> None:
    with pytest.raises(UserInputError, match=told):
        settings(*overrides)


# ------------------------------------------------------------------------------------------------ what is copied
def test_a_finished_run_goes_on_as_another_run(tiny_run: Path, tmp_path: Path) -> None:
    loss, average = named_agent(tiny_run, "last").load()
    trainer = begun(tiny_run, tmp_path / "run", "schedule.iterations=1")
    learner, progress = trainer.learner, trainer.progress
    assert_equal_states(learner.loss, loss)
    assert_equal_states(learner.average, average)
    assert not targets_are_critics(learner.loss)
    assert progress.iterations == progress.updates == 0
    assert progress.skipped_maps == tiny.ITERATIONS  # it goes on with maps that the run has not had
    assert {state["step"].item() for state in learner.optimizer.state.values()} == {tiny.UPDATES * tiny.ITERATIONS}
    driven = tiny.AGENTS * tiny.ITERATIONS
    assert learner.replay.episodes_added == driven
    assert learner.replay.capacity_episodes == driven + tiny.AGENTS
    told = f"go on from {tiny_run} after its 2 iterations, with 4 episodes in the replay; not copied: random streams, "
    assert f"{told}schedule\n" in (tmp_path / "run" / "train.log").read_text()


def test_random_numbers_follow_from_the_new_runs_seed(tiny_run: Path, tmp_path: Path) -> None:
    states = [
        begun(tiny_run, tmp_path / str(number), f"seed={seed}").learner.loss.rng_state
        for number, seed in enumerate((5, 6, 5))
    ]
    assert torch.equal(states[0], states[2])
    assert not torch.equal(states[0], states[1])
    assert not torch.equal(states[0], named_agent(tiny_run, "last").load()[0].rng_state)


@pytest.mark.parametrize(
    ("group", "changed"), [("varied", {}), ("file", {"path": '/plans/b\u00fcro "west"\\new.json'})]
)
def test_a_run_on_maps_with_other_keys_goes_on_there(tmp_path: Path, group: str, changed: dict[str, str]) -> None:
    cfg = compose("train", ["+algo=sac", f"map={group}", *(f"map.{key}=x" for key in changed)])
    for key, value in changed.items():
        cfg.map[key] = value
    ended = tmp_path / "ended"
    (ended / "checkpoints").mkdir(parents=True)
    OmegaConf.save(cfg, ended / "config.yaml")
    assert settings(f"init={ended}").map == training_settings(cfg).map


def test_a_run_that_goes_on_is_the_runs_in_every_key_and_is_continued_bit_for_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MALLOC_MMAP_MAX_", "0")
    ended = tmp_path / "ended"
    tiny.tiny_trainer(ended, "rcdsac_cvar", "learner.kappa=0.4", "map.num_movers=3").run()
    then = settings_of_run(ended)
    cfg = compose("train", [f"init={ended}", "collector.num_processes=0", "threads=1", "logger=none"])
    now = training_settings(cfg)
    for name in ("algo", "map", "task", "world", "learner", "replay", "validation", "network"):
        assert getattr(now, name) == getattr(then, name), name
    assert now.schedule == replace(then.schedule, pursuit_iterations=0, neutral_iterations=0, ramp_iterations=0)
    make_trainer(cfg, tmp_path / "whole").run()

    def stop(trainer: Trainer, record: Mapping[str, float]) -> None:
        raise StopTraining

    make_trainer(cfg, tmp_path / "halves", on_iteration_end=stop).run()
    shutil.rmtree(ended)
    again = resume_training(tmp_path / "halves")
    assert again is not None
    # The replay is as large as before: four episodes of the ended run, four of this one.
    assert again.learner.replay.capacity_episodes == 8
    again.run()
    whole, halves = (load_states(tmp_path / name / "checkpoints", "last")[1] for name in ("whole", "halves"))
    assert whole["loss"].keys() == halves["loss"].keys()
    assert all(torch.equal(value, halves["loss"][name]) for name, value in whole["loss"].items())


def test_a_run_that_trains_on_is_taken_as_it_was_when_it_was_checked(
    tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[Saved] = []

    def first_only(folder: Path, name: CheckpointName) -> tuple[Saved, list[str]]:
        # Its first checkpoint was the last one at the first look; by the second there is another.
        looks.append(find(folder, name if looks else 1)[0])
        return looks[-1], []

    monkeypatch.setattr("rcdsac_trl.training.warm_start.find", first_only)
    trainer = begun(tiny_run, tmp_path / "run")
    assert len(looks) == 1
    assert_equal_states(trainer.learner.loss, named_agent(tiny_run, 1).load()[0])
    assert {state["step"].item() for state in trainer.learner.optimizer.state.values()} == {tiny.UPDATES}
    assert trainer.learner.replay.episodes_added == tiny.AGENTS
    assert trainer.learner.replay.capacity_episodes == tiny.AGENTS * (1 + tiny.ITERATIONS)
    assert trainer.progress.skipped_maps == 1
    again = resume_training(tmp_path / "run")
    assert again is not None
    closed(again)
    assert [look.progress.iterations for look in looks] == [1, 2]


def test_in_another_world_or_without_its_replay_a_run_begins_with_less(tiny_run: Path, tmp_path: Path) -> None:
    elsewhere = begun(tiny_run, tmp_path / "elsewhere", "map.num_movers=1")
    assert elsewhere.learner.replay.episodes_added == elsewhere.progress.skipped_maps == 0
    assert not elsewhere.learner.optimizer.state
    told = f"begin with {tiny_run}; not copied: optimiser state, replay, random streams, schedule\n"
    assert told in (tmp_path / "elsewhere" / "train.log").read_text()
    ended = shutil.copytree(tiny_run, tmp_path / "ended")
    shutil.rmtree(ended / "replay")
    without = begun(ended, tmp_path / "without")
    assert without.learner.replay.episodes_added == 0
    assert without.learner.optimizer.state
    assert ".safetensors is missing), random streams, schedule\n" in (tmp_path / "without" / "train.log").read_text()


def test_it_trains_and_is_continued_also_where_the_agent_is_gone(
    tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    agent = tiny.exported(tiny_run, tmp_path / "agent")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MALLOC_MMAP_MAX_", "0")
    call = [f"init={agent}", *TINY, "hydra.run.dir=run"]
    monkeypatch.setattr(sys, "argv", ["train", *call])
    train.main()
    told = capsys.readouterr().out
    assert f"next: {program()} evaluate run=run\n" in told
    assert f"{program()} plot_training run=run\n" in told
    assert load_progress(Path("run/checkpoints"), "last").updates == tiny.UPDATES * tiny.ITERATIONS
    assert json.loads(Path("run/manifest.json").read_text())["overrides"][0].startswith("++algo.name=")
    shutil.rmtree(agent)
    monkeypatch.setattr(sys, "argv", ["train", *call[1:-1], "resume=run"])
    train.main()
    assert capsys.readouterr().out.startswith("run is finished")


def test_a_run_that_saved_nothing_begins_with_the_agent_again(tiny_run: Path, tmp_path: Path) -> None:
    begun(tiny_run, tmp_path / "run")
    trainer = resume_training(tmp_path / "run")
    assert trainer is not None
    assert_equal_states(closed(trainer).learner.loss, named_agent(tiny_run, "last").load()[0])


def test_an_exported_agents_average_stands_for_what_it_lacks(tiny_run: Path, tmp_path: Path) -> None:
    agent = tiny.exported(tiny_run, tmp_path / "agent")
    trainer = begun(agent, tmp_path / "run")
    loss, average = named_agent(tiny_run).load()
    assert_equal_states(trainer.learner.average.module, average.module)
    state = trainer.learner.loss.state_dict()
    assert targets_are_critics(trainer.learner.loss)
    for name, value in average.module.state_dict().items():
        assert torch.equal(state[f"actor_network_params.{name}"], value)
    assert trainer.learner.loss.alpha.item() == pytest.approx(loss.alpha.item(), rel=1e-6)
    told = (tmp_path / "run" / "train.log").read_text()
    stand_in = "learning actor and target critics (the averaged actor and the critics stand for them)"
    assert f"not copied: {stand_in}, optimiser state, replay, random streams, schedule\n" in told


def test_a_shipped_agent_on_another_map_robot_and_measure(tmp_path: Path) -> None:
    trainer = begun(
        "rcdsac_pow-narrow",
        tmp_path / "run",
        "+algo=rcdsac_cvar",
        "robot=turtlebot3_burger",
        "sensor=full",
        "sensor.memory_s=12",
        "algo.collision_weight=[2,2]",
    )
    told = (tmp_path / "run" / "train.log").read_text()
    assert "not copied: learning actor and target critics (the averaged actor and the critics stand for them), " in told
    changed = "robot paper becomes turtlebot3_burger; what a collision counts 1 becomes 2"
    assert f"; measure pow becomes cvar; sensor narrow becomes full; {changed}\n" in told
    assert_equal_states(trainer.learner.average.module, named_agent("rcdsac_pow-narrow").load()[1].module)


def test_a_temperature_that_nobody_knows_is_said(tmp_path: Path) -> None:
    begun(agent_of_before(tmp_path / "before"), tmp_path / "run")
    assert "not copied: temperature (unknown: learner.alpha_init=" in (tmp_path / "run" / "train.log").read_text()


def test_other_networks_are_refused_before_anything_is_written(tiny_run: Path, tmp_path: Path) -> None:
    for override in ("network.memory=64", "sensor.memory_s=5.0", "+algo=sac", "learner.num_critics=1"):
        with pytest.raises(UserInputError, match=rf"^init={tiny_run} has other networks than this run .* leave out"):
            begun(tiny_run, tmp_path / "run", override)
    assert list(tmp_path.iterdir()) == []
