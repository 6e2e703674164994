"""The command line: a mistake ends in one sentence and code 2, with nothing written; Ctrl-C ends in a checkpoint."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path

import pandas as pd
import pytest
from omegaconf import DictConfig

import tiny
from forked import Forked
from rcdsac_trl import evaluate, train
from rcdsac_trl.cli import Command, precheck
from rcdsac_trl.config.compose import choices, compose
from rcdsac_trl.config.experiment_settings import SearchSettings
from rcdsac_trl.config.typed import read
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.measured_run import MeasuredRun
from rcdsac_trl.report.card import measured_values
from rcdsac_trl.system.invocation import program
from tiny import ROWS, TINY, load_progress

POW = "+algo=rcdsac_pow"
ALL_ROWS = ", ".join(ROWS)
# keep_pages() would otherwise start this process, and with it the tests, again.
NO_RESTART = {"MALLOC_MMAP_MAX_": "0"}


@pytest.fixture
def refusal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Callable[[Callable[[], None], list[str]], str]:
    """Call an entry point that must refuse; return the sentence, without the program's name."""
    monkeypatch.chdir(tmp_path)
    for name, value in NO_RESTART.items():
        monkeypatch.setenv(name, value)

    def started(*_: object) -> None:
        raise AssertionError("it was not refused")

    monkeypatch.setattr("rcdsac_trl.training.setup.make_trainer", started)
    monkeypatch.setattr(MeasuredRun, "run", started)
    monkeypatch.setattr("rcdsac_trl.cli.never_silent", nullcontext)  # however long it takes

    def call(main: Callable[[], None], arguments: list[str]) -> str:
        monkeypatch.setattr(sys, "argv", ["prog", *arguments])
        capfd.readouterr()
        with pytest.raises(SystemExit) as left:
            main()
        assert left.value.code == 2
        out, err = capfd.readouterr()
        assert out == ""
        assert err.count("\n") == 1
        assert err.startswith("rcdsac_trl: ")
        assert list(tmp_path.iterdir()) == []
        return err.removeprefix("rcdsac_trl: ").strip()

    return call


# ------------------------------------------------------------------------------------------------ train
@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        # what names the choices
        ([], f"no algorithm chosen: add +algo=<name>, one of {ALL_ROWS}"),
        (["algo=sac"], f"write +algo=<name> (with a plus): one of {ALL_ROWS}"),
        (["+algo=ppo"], f"algo=ppo does not exist: choose one of {ALL_ROWS}"),
        ([POW, "sensor=wide"], "sensor=wide does not exist: choose one of full, narrow, sparse"),
        ([POW, "map=moon"], "map=moon does not exist: choose one of "),
        ([POW, "preset=tiny"], "preset=tiny does not exist: choose one of "),
        ([POW, "algo/distortion=mean"], "algo/distortion=mean does not exist: choose one of cpw, cvar, "),
        ([POW, "map=null"], "map=null chooses nothing: choose one of "),
        ([POW, "+map=easy"], "map is chosen twice: write map=<name> once, without a plus"),
        ([POW, "+preset=laptop"], "preset is chosen twice: write preset=<name> once, without a plus"),
        (
            ["hydra.searchpath=[robotz]", "robot=cart"],
            "hydra.searchpath=[robotz]: robotz is no folder: name those that",
        ),
        ([POW, "sensor.name=wide"], "sensor.name=wide is unknown: choose one of full, narrow, sparse"),
        # misspelt, unknown and missing keys
        ([POW, "learner.batchsize=3"], "there is no key learner.batchsize: did you mean learner.batch_size?"),
        ([POW, "sede=3"], "there is no key sede: did you mean seed?"),
        ([POW, "schedul.iterations=3"], "there is no key schedul.iterations: did you mean schedule.iterations?"),
        ([POW, "+batch_size=3"], "there is no key batch_size"),
        ([POW, "+learner.seqence_length=3"], "there is no key learner.seqence_length: did you mean learner.sequence"),
        ([POW, "+algo.distortion.hihg=0"], "there is no key algo.distortion.hihg: did you mean algo.distortion.high?"),
        ([POW, "~learner.gamma"], "learner.gamma is missing: give it a value"),
        (["algo.beta=-1"], "algo.beta needs a choice of algo: add +algo=<name>, one of "),
        # beta
        (["+algo=dsac_pow", "algo.beta=-3"], "beta = -3 is outside the domain [-2, 0] of measure 'pow'"),
        (["+algo=dsac_cvar", "algo.beta=0"], "beta = 0 is outside the domain (0, 1] of measure 'cvar'"),
        (["+algo=dsac_pow", "algo.beta=low"], "algo.beta=low must be a number or null"),
        ([POW, "algo.beta=-1"], "algo.beta=-1 does not go with algo.conditioning=per_episode"),
        (["+algo=sac", "algo.beta=-1"], "algo.beta=-1 does not go with algo.conditioning=none"),
        ([POW, "algo.distortion.low=-5"], "beta = -5 is outside the domain [-2, 0] of measure 'pow'"),
        (
            [POW, "algo.distortion.evaluation_betas=[]"],
            "algo.distortion.evaluation_betas=[] leaves nothing to validate",
        ),
        ([POW, "algo/distortion=var", "schedule.neutral_iterations=1"], "measure 'var' has no neutral beta"),
        # types and limits
        ([POW, "learner.batch_size=abc"], "learner.batch_size=abc must be a whole number"),
        ([POW, "learner.batch_size=2.0"], "learner.batch_size=2.0 must be a whole number"),
        ([POW, "learner.batch_size=-1"], "learner.batch_size=-1 is not a number of at least 1"),
        ([POW, "learner.actor_lr=inf"], "learner.actor_lr=inf must be a number"),
        ([POW, "learner.actor_lr=0"], "learner.actor_lr=0 is not a positive number"),
        ([POW, "learner.kappa=0"], "learner.kappa=0 is not a positive number"),
        ([POW, "learner.burn_in=-1"], "learner.burn_in=-1 is not a number of at least 0"),
        ([POW, "learner.gamma=1"], "learner.gamma=1 is outside [0, 1)"),
        ([POW, "learner.target_coefficient=0"], "learner.target_coefficient=0 is outside (0, 1]"),
        ([POW, "learner.num_critics=3"], "learner.num_critics=3 is neither 1 nor 2"),
        (
            [POW, "learner.resample_per=transition", "learner.n_steps=3"],
            "learner.n_steps=3 sums rewards over transitions of one beta",
        ),
        ([POW, "learner.resample_per=step"], "learner.resample_per=step must be one of transition, sequence"),
        ([POW, "learner=5"], "learner=5 must be a section with keys of its own"),
        ([POW, "seed=1.5"], "seed=1.5 must be a whole number"),
        ([POW, "seed=true"], "seed=True must be a whole number"),
        ([POW, "seed=-1"], "seed=-1 must be at least 0"),
        ([POW, "seed='\n\x1b[2J'"], r"seed=\n\x1b[2J must be a whole number"),
        ([POW, "seed=???"], "seed=??? must be a whole number"),
        ([POW, "schedule.iterations=0"], "schedule.iterations=0 is not a number of at least 1"),
        ([POW, "schedule.pursuit_noise=-1"], "schedule.pursuit_noise=-1 is not a number of at least 0"),
        ([POW, "validation.num_maps=0"], "validation.num_maps=0 must be at least 1"),
        ([POW, "validation.every_iterations=0"], "validation.every_iterations=0 must be at least 1"),
        ([POW, "validation.processes=-1"], "validation.processes=-1 must be at least 0"),
        ([POW, "checkpoint.every_iterations=-5"], "checkpoint.every_iterations=-5 must be at least 1"),
        ([POW, "network.memory=0"], "memory = 0 is below 1"),
        ([POW, "network.restart_steps=0"], "network.restart_steps=0 is below 1: give a number of steps or null"),
        ([POW, "map.size_m=big"], "map.size_m=big must be a number"),
        ([POW, "map.num_movers=-1"], "num_movers is -1 but must be"),
        ([POW, "map.layouts=rooms"], "map.layouts=rooms must be a list of words in brackets"),
        ([POW, "task.motor_steps=[6,a]"], "task.motor_steps=[6, 'a'] must be a whole number or a list of whole"),
        (
            [POW, "task.collision_penalty_mode=never"],
            "task.collision_penalty_mode=never must be one of onset, per_step",
        ),
        ([POW, "threads=all"], "threads=all must be a whole number or auto"),
        ([POW, "threads=0"], "threads=0 is not a whole number of at least 1"),
        ([POW, "device=tpu"], "device=tpu is not supported: use auto, cpu, cuda or cuda:<number>"),
        ([POW, "device=cuda:99"], "device=cuda:99, but torch does not see it here"),
        (
            [POW, "logger.backends=[paper]"],
            "logger.backends holds 'paper': choose among csv, tensorboard, wandb, mlflow",
        ),
        ([POW, "logger.backends=csv"], "logger.backends=csv must be a list of words in brackets"),
        # what does not go together
        ([POW, "sensor.memory_s=0"], "network.look_ahead=true reads what is remembered: set sensor.memory_s above 0"),
        (
            [POW, "init=rcdsac_pow-narrow", "sensor=sparse", "preset=smoke"],
            "above 0, or leave sensor out, which init=rcdsac_pow-narrow brings along",
        ),
        (
            [POW, "collector=parallel_env", "world.num_agents=10", "world.num_workers=3"],
            "num_workers=3 cannot share 10 agents evenly",
        ),
        ([POW, "world.num_workers=2"], "world.num_workers=2 does nothing with collector=multi: give collector.num_pro"),
        (
            [POW, "collector=single", "+collector.num_processes=2"],
            "collector.num_processes=2 does nothing with collector=single: give world.num_workers",
        ),
        (
            [POW, "collector=parallel_env", "world.num_workers=0"],
            "world.num_workers=0 leaves collector=parallel_env without workers: give 1 or more, or auto",
        ),
        (
            [POW, "+collector.address=auto"],
            "collector.address=auto does nothing with collector=multi: take",
        ),
        (
            [POW, "collector=ray", "collector.num_processes=0"],
            "collector.num_processes=0 leaves collector=ray nothin",
        ),
        (
            [POW, "collector=ray", "collector.num_processes=3"],
            "collector.num_processes=3 cannot share world.num_agents=10 evenly: give a divisor",
        ),
        (
            [POW, "collector=distributed"],
            "collector=distributed does not exist: choose one of multi, parallel_env, ray",
        ),
        ([POW, "collector.num_processes=-1"], "collector.num_processes=-1 is not a number of processes"),
        ([POW, "world.num_agents=0"], "world.num_agents=0 is below 1"),
        ([POW, "task.episode_steps=5", "learner.sequence_length=6"], "learner.sequence_length=6 is longer than an epi"),
        (
            [POW, "replay.capacity_steps=100"],
            "replay.capacity_steps=100 does not hold the 10000 steps of one iteration",
        ),
        # what Hydra itself refuses
        ([POW, "learner.batch_size=["], "learner.batch_size=[ cannot be read: write it as <key>=<value>"),
        ([POW, "+="], "+= names no key: write it as <key>=<value>"),
        (["+algo="], "algo= does not exist: choose one of dsac_cvar, "),
        ([POW, "preset="], "preset= does not exist: choose one of laptop, "),
        ([POW, "hydra/launcher=far"], "hydra/launcher=far does not exist: leave it out"),
        ([POW, "fast"], "fast cannot be read: write it as <key>=<value>"),
        ([POW, "seed=${foo}"], "Interpolation key 'foo' not found"),
        ([POW, "seed=0,1"], "seed=0,1 holds several values: write a list in brackets, or add -m"),
        ([POW, "--fast"], "there is no option --fast"),
        ([POW, "--config-dir=/nowhere"], "--config-dir cannot be used: choose with overrides"),
        ([POW, "--config-name=evaluate"], "--config-name cannot be used: choose with overrides"),
        ([POW, "--run", "-m"], "--run and --multirun do not go together: leave all but one out"),
        ([POW, "hydra.run.dir=''"], "hydra.run.dir names no folder: give it one, or leave it out"),
        ([POW, "hydra.run.dir=/proc/x/y"], "nothing can be written into /proc ("),
        ([POW, "resume="], "resume names no folder: give it one, or auto, or leave it out"),
        ([POW, "threads=1000000"], "threads=1000000 is above 1024: "),
        # a multirun is checked whole, before its first job
        (["-m", POW, "seed=0,abc"], "seed=abc must be a whole number"),
        (["-m", "+algo=sac,ppo"], "algo=ppo does not exist"),
        (["-m", "seed=0,1"], "no algorithm chosen"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_train_refuses(refusal: Callable, arguments: list[str], sentence: str) -> None:
    assert sentence in refusal(train.main, arguments)


@pytest.mark.parametrize("backend", ["wandb", "mlflow"])
def test_train_refuses_a_logger_that_is_not_installed(
    refusal: Callable, monkeypatch: pytest.MonkeyPatch, backend: str
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    told = refusal(train.main, [POW, f"logger={backend}"])
    assert told == f"logger {backend} is not installed: pip install 'rcdsac-trl[{backend}]', or use logger=default"


def test_train_refuses_a_folder_that_holds_a_run(refusal: Callable, tiny_run: Path) -> None:
    before = sorted((path, path.stat().st_mtime_ns) for path in tiny_run.rglob("*"))
    told = refusal(train.main, [POW, f"hydra.run.dir={tiny_run}"])
    assert told == f"{tiny_run} already holds a run: choose another hydra.run.dir"
    assert sorted((path, path.stat().st_mtime_ns) for path in tiny_run.rglob("*")) == before


@pytest.mark.parametrize(
    ("verb", "given", "key"),
    [
        *(
            (verb, "run=", "run")
            for verb in ("evaluate", "calibrate", "course", "export", "play", "plot_training", "replay")
        ),
        *(
            (verb, "out=", "out")
            for verb in ("evaluate", "calibrate", "course", "export", "report", "draw_maps", "replay")
        ),
        ("plot_training", "out='  '", "out"),
        ("play", "films=", "films"),
        ("play", "maps=[a.yaml,'']", "maps"),
        ("course", "run=[sac-narrow,'']", "run"),
        ("report", "runs=['']", "runs"),
        ("publish", "runs=['']", "runs"),
        ("agents", "agents=['']", "agents"),
        ("verify", "agents=[sac-narrow,'']", "agents"),
        ("verify", "out=", "out"),
    ],
)
def test_an_empty_name_is_not_the_folder_one_is_in(verb: str, given: str, key: str) -> None:
    with pytest.raises(UserInputError, match=f"^{key} names no folder: give it one, or leave it out$"):
        compose(verb, [given])


@pytest.mark.parametrize("name", ["", "' '", ".", "..", "../mine", "mine/"])
def test_a_search_is_named_by_a_word(name: str) -> None:
    with pytest.raises(UserInputError, match=r"^search\.name=.* names no folder in multirun/"):
        read(SearchSettings, dict(compose("search", [f"search.name={name}"]).search), "search")


# ------------------------------------------------------------------------------------------------ evaluate
RUN = "run=<the tiny run>"
EITHER = "name what to evaluate: either run=<folder or shipped agent>"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], f"{EITHER} or baseline=<name>, such as mppi"),
        ([RUN, "baseline=pursuit"], f"{EITHER} or baseline=<name>, such as mppi"),
        (["run=nowhere"], "there is no agent 'nowhere': "),
        (["run=123"], "run=123 must be text or null"),
        ([RUN, "beta=[]"], "beta=[] names none: leave it out for beta=[-2,-1.5,-1,-0.5], or give one"),
        ([RUN, "beta=[-1,-3]"], "beta = -3 is outside the domain [-2, 0] of measure 'pow'"),
        ([RUN, "beta=low"], "beta=low must be a number or a list of numbers in brackets or null"),
        ([RUN, "beta=[low]"], "beta=['low'] must be a number or a list of numbers in brackets or null"),
        ([RUN, "beta=-3"], "beta = -3 is outside the domain [-2, 0] of measure 'pow'"),
        ([RUN, "beta=[-1,-1.0]"], "beta=-1 is given more than once"),
        ([RUN, "beta=[-1,-1.0000000001]"], "beta=-1 is given more than once"),
        (["baseline=dwa", "sampled=true"], "baseline=dwa has no actions to be drawn: leave sampled out"),
        (
            [RUN, "beta=[-1]", "collision_weight=[1]"],
            "rcdsac_pow is told no collision weight: leave collision_weight out",
        ),
        ([RUN, "beta=[-1]", "sensor=sparse"], "sensor=sparse is not what "),
        ([RUN, "beta=[-1]", "checkpoint=first"], "checkpoint=first must be one of best, last"),
        ([RUN, "beta=[-1]", "split=train"], "split=train must be one of evaluation, validation"),
        ([RUN, "beta=[-1]", "sampled=often"], "sampled=often must be true or false"),
        ([RUN, "beta=[-1]", "num_maps=0"], "num_maps=0 must be at least 1"),
        ([RUN, "beta=[-1]", "num_episodes=1.5"], "num_episodes=1.5 must be a whole number"),
        ([RUN, "beta=[-1]", "out="], "out names no folder: give it one, or leave it out"),
        ([RUN, "beta=[-1]", "seed=-1"], "seed=-1 must be at least 0"),
        ([RUN, "beta=[-1]", "num_workers=-3"], "num_workers=-3 is not a number of processes"),
        ([RUN, "beta=[-1]", "threads=all"], "threads=all must be a whole number or auto"),
        ([RUN, "beta=[-1]", "device=tpu"], "device=tpu is not supported"),
        ([RUN, "beta=[-1]", "map=moon"], "map=moon does not exist: choose one of "),
        ([RUN, "beta=[-1]", "task.episode_step=3"], "there is no key task.episode_step: did you mean task.episode_st"),
        ([RUN, "beta=[-1]", "task.episode_steps=0"], "task.episode_steps=0 must be at least 1"),
        ([RUN, "beta=[-1]", "task.episode_steps=few"], "task.episode_steps=few must be a whole number"),
        ([RUN, "beta=[-1]", "map.num_movers=-1"], "num_movers is -1 but must be"),
        (["baseline=pursuit", "+sensor.name=wide"], "sensor.name=wide is unknown: choose one of full, narrow, sparse"),
        (["baseline=pursuit", "sensor.max_range_m=10"], "there is no key sensor.max_range_m: sensor has name"),
        (["baseline=pursuit", "algo.beta=-1"], "there is no key algo.beta"),
        (
            [RUN, "beta=[-1]", "num_maps=2", "record=true", "video.map=2"],
            "video.map=2 is not among the 2 evaluated: lower it, or raise num_maps",
        ),
        ([RUN, "beta=[-1]", "video.episode=-1"], "video.episode=-1 must be at least 0"),
        ([RUN, "beta=[-1]", "video.fps=0"], "video.fps=0 must be above 0 and at most 120"),
        ([RUN, "beta=[-1]", "algo=sac"], "there is no key algo"),
        ([RUN, "beta=[-1]", "+algo=sac"], "there is no key algo"),
        ([RUN, "bta=[-1]"], "there is no key bta: did you mean beta?"),
        (
            [RUN, "beta=[-1]", "beta_controller=[clearance]"],
            "beta_controller=[clearance] turns beta between the values of beta: give two or more of them",
        ),
        (
            [RUN, "beta=[-2,-1]", "beta_controller=[clearance,clearance]"],
            "beta_controller=clearance is given more than once",
        ),
        (
            [RUN, "beta=[-2,-1]", "beta_controller=[bandit]"],
            "beta_controller=['bandit'] must be a list of some of clearance, tail_variance in brackets or null",
        ),
        (
            [RUN, "beta=[-2,-1]", "controller.near_m=2"],
            "controller.near_m=2 must be above 0 and below controller.far_m=1.2",
        ),
        (
            [RUN, "beta=[-2,-1]", "beta_controller=[clearance]", "controller.near_m=3.5", "controller.far_m=4"],
            "controller.near_m=3.5 is beyond the 3 m that agents see: lower it",
        ),
        (
            [RUN, "beta=[-2,-1]", "beta_controller=[tail_variance]", "navigation.watchdog=true"],
            "beta_controller=[tail_variance] reads what critics expect of what is seen and of the action wanted",
        ),
        ([RUN, "beta=[-2,-1]", "controller.window_steps=1"], "controller.window_steps=1 must be at least 2"),
        (["baseline=random"], "baseline=random is unknown: choose one of pursuit, dwa, mppi, or <module>:<class>"),
        (["baseline=3"], "baseline=3 must be text or null"),
        (
            ["baseline=pursuit", "beta_controller=[clearance]"],
            "baseline=pursuit has no beta to turn: leave",
        ),
        (["baseline=pursuit", "checkpoint=last"], "baseline=pursuit has no checkpoints: leave checkpoint out"),
        (
            [RUN, "acting.num_candidates=1", "acting.spread=0.5"],
            "acting.spread=0.5 says how critics choose, and with acting.num_candidates=1 they do not: leave it out",
        ),
        (["baseline=pursuit", "beta=[-1]"], "baseline=pursuit has neither beta nor collision weight: leave them out"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_evaluate_refuses(refusal: Callable, tiny_run: Path, arguments: list[str], sentence: str) -> None:
    given = [f"run={tiny_run}" if argument == RUN else argument for argument in arguments]
    assert refusal(evaluate.main, given).startswith(sentence)


def test_evaluate_refuses_an_out_that_is_a_file(refusal: Callable, tiny_run: Path) -> None:
    told = refusal(evaluate.main, [f"run={tiny_run}", "beta=[-1]", f"out={tiny_run / 'config.yaml'}"])
    assert told.endswith("is not a folder: give another with out=<folder>")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a: [1", "while parsing a flow sequence"),
        ("- 1\n- 2", "it holds no keys"),
        ("seed: 0", "no algorithm chosen"),
        ("algo: {name: x}\nsede: 0", "there is no key sede"),
    ],
)
def test_evaluate_refuses_a_run_it_cannot_read(
    refusal: Callable, tmp_path_factory: pytest.TempPathFactory, text: str, reason: str
) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    (folder / "config.yaml").write_text(text)
    told = refusal(evaluate.main, [f"run={folder}", "beta=[-1]"])
    assert told.startswith(f"{folder / 'config.yaml'} cannot be read ({reason}")


# ------------------------------------------------------------------------------------------------ composing
def test_compose_is_what_the_command_line_makes() -> None:
    cfg = compose("train", [POW, "seed=3", "learner.gamma=0.5"])
    assert (cfg.algo.name, cfg.seed, cfg.learner.gamma) == ("rcdsac_pow", 3, 0.5)
    with pytest.raises(UserInputError, match=r"did you mean learner\.gamma"):
        compose("train", [POW, "learner.gama=0.5"])


def test_choices_are_the_files_of_a_group() -> None:
    assert choices("sensor") == ["full", "narrow", "sparse"]
    assert choices("no such group") == []


def test_a_multirun_checks_every_combination() -> None:
    seen = []
    precheck("train", ["-m", "+algo=sac,rcwr", "seed=0,1"], lambda cfg: seen.append((cfg.algo.name, cfg.seed)))
    assert seen == [("sac", 0), ("sac", 1), ("rcwr", 0), ("rcwr", 1)]


@pytest.mark.parametrize("flag", ["--help", "--hydra-help", "--cfg=job", "--info=all"])
def test_what_only_shows_something_is_left_to_hydra(flag: str) -> None:
    def never(cfg: object) -> None:
        raise AssertionError("checked")

    precheck("train", [flag], never)


# ------------------------------------------------------------------------------------------------ verbs
def test_a_command_makes_its_object_of_the_config_and_runs_it_with_what_describes_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MALLOC_MMAP_MAX_", "0")
    monkeypatch.setattr(sys, "argv", ["calibrate", "num_maps=7"])
    done: list[object] = []

    class Made:
        def run(self, *given: object) -> None:
            done.extend(given)

    def make(cfg: DictConfig) -> Made:
        done.append(cfg.num_maps)
        return Made()

    Command("calibrate", make, describe="rcdsac_trl.report.card:measured_values")()
    assert done == [7, 7, measured_values]  # checked before Hydra begins, and made then
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("verb", ["calibrate", "course", "evaluate", "export", "publish", "search"])
def test_what_a_verb_names_exists(verb: str) -> None:
    command = import_module(f"rcdsac_trl.{verb}").main
    assert command.name == verb
    for named in filter(None, (command.make, getattr(command, "describe", None))):
        module, _, function = named.partition(":")
        assert callable(getattr(import_module(module), function))


# ------------------------------------------------------------------------------------------------ whole processes
def start(cwd: Path, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", *arguments],
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        start_new_session=True,
    )


def test_a_refusal_of_the_real_program(tmp_path: Path) -> None:
    process = start(tmp_path, "rcdsac_trl.evaluate", "bta=[-1]")  # told before torch is imported
    out, err = process.communicate(timeout=300)
    assert (process.returncode, out) == (2, "")
    assert err == "rcdsac_trl: there is no key bta: did you mean beta?\n"
    assert list(tmp_path.iterdir()) == []


def test_the_real_program_evaluates_as_this_process_does_and_writes_nothing_else(
    tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = [f"run={tiny_run}", "beta=[-2,-1]"]
    here = tiny.evaluate(*given, f"out={tmp_path / 'here'}")
    cwd = tmp_path / "cwd"
    cwd.mkdir()
    sizes = ["num_maps=1", "num_episodes=2", "num_workers=0", "threads=1"]
    process = start(cwd, "rcdsac_trl.evaluate", *given, *sizes, "out=there")
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert "Traceback" not in err
    heading, _, averse, bolder, hit, written, following = out.splitlines()
    assert heading.startswith("rcdsac_pow, evaluation maps 1 × 2 episodes of 20 steps")
    assert (averse.split()[0], bolder.split()[0], written) == ("beta=-2", "beta=-1", "written to there")
    assert hit.startswith(("hit: ", "nothing was hit"))
    monkeypatch.chdir(cwd)
    assert following == f"next: {program()} report runs=there"
    assert [path.name for path in cwd.iterdir()] == ["there"]
    assert {"collisions_mean", "collisions_std"} <= set(pd.read_csv(cwd / "there" / "summary.csv"))  # all numbers
    for name in ("episodes.csv", "summary.csv", "collisions.csv", "evaluation.json"):
        assert (cwd / "there" / name).read_bytes() == (here / name).read_bytes()


def endless(folder: Path, *arguments: str) -> list[str]:
    """Return the arguments of a training without end."""
    without_end = ["schedule.iterations=100000", "validation.every_iterations=100000"]
    return [POW, *TINY, *without_end, *arguments, f"hydra.run.dir={folder / 'run'}"]


def interrupt(folder: Path, pid: int, has_ended: Callable[[], bool], by: signal.Signals) -> None:
    """Send a signal to an endless training and all its processes, as a terminal does, after the second iteration."""
    log = folder / "run" / "train.log"
    deadline = time.monotonic() + 300
    while not has_ended() and time.monotonic() < deadline:
        if log.exists() and "   2/100000" in log.read_text():  # the first one is saved then
            break
        time.sleep(0.02)
    os.killpg(pid, by)


def ctrl_c(folder: Path, *arguments: str) -> tuple[int, str]:
    """Train in the real program until Ctrl-C; return the exit code and stderr."""
    process = start(folder, "rcdsac_trl.train", *endless(folder, *arguments))
    interrupt(folder, process.pid, lambda: process.poll() is not None, signal.SIGINT)
    _, err = process.communicate(timeout=300)
    return process.returncode, err


def sigterm(folder: Path) -> tuple[int, str]:
    """Train in a child of this process until SIGTERM; likewise."""

    def program() -> None:
        os.environ |= NO_RESTART
        sys.argv = ["train", *endless(folder)]
        train.main()

    training = Forked(program, folder / "said")
    interrupt(folder, training.pid, lambda: training.code(wait=False) is not None, signal.SIGTERM)
    return training.code() or 0, training.said


@pytest.mark.parametrize(("end", "code", "told"), [(ctrl_c, 130, "interrupted"), (sigterm, 143, "ended by SIGTERM")])
def test_ctrl_c_and_sigterm_end_with_a_checkpoint_and_without_a_traceback(
    tmp_path: Path, end: Callable[[Path], tuple[int, str]], code: int, told: str
) -> None:
    ended, err = end(tmp_path)
    assert ended == code
    assert "Traceback" not in err
    assert "leaked" not in err
    assert err.splitlines()[-1] == f"rcdsac_trl: {told}"
    run = tmp_path / "run"
    assert load_progress(run / "checkpoints", "last").updates >= 2
    said = (run / "train.log").read_text()  # how the program is called depends on where from
    assert re.search(rf" are saved, continue: \S*(rcdsac-trl|python -m rcdsac_trl) train resume={run}\n", said)
    assert (run / "training_episodes.csv").exists()


def test_sigterm_ends_an_evaluation_and_its_processes_and_keeps_the_maps_that_have_ended(
    tiny_run: Path, tmp_path: Path
) -> None:
    given = [f"run={tiny_run}", "beta=[-1]", "num_maps=100000", "num_episodes=1", "num_workers=2", "out=there"]
    process = start(tmp_path, "rcdsac_trl.evaluate", *given)
    kept = tmp_path / "there" / "unfinished" / "evaluation.json"
    deadline = time.monotonic() + 300
    while process.poll() is None and not kept.exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGTERM)  # as clusters do: to the whole group, workers included
    _, err = process.communicate(timeout=300)
    assert process.returncode == 143
    told = [line for line in err.splitlines() if "at work for" not in line]  # which a busy machine says first
    assert told[0] == "rcdsac_trl: 100000 maps in 2 processes, for there"
    assert re.fullmatch(r"rcdsac_trl: \d+ of 100000 maps are in there/unfinished", told[-2])
    assert told[-1] == "rcdsac_trl: ended by SIGTERM"
    assert "leaked" not in err
    names = ["collisions.csv", "episodes.csv", "evaluation.json", "summary.csv"]
    assert sorted(path.name for path in kept.parent.iterdir()) == names


@pytest.mark.slow
@pytest.mark.parametrize(
    "processes",
    [
        ["collector=parallel_env", "world.num_workers=2"],
        ["collector.num_processes=2"],
        ["validation.processes=1", "validation.every_iterations=2", "task.episode_steps=1000"],
        ["collector=ray", "collector.num_processes=2"],
    ],
    ids=["workers", "multi", "validation", "ray"],
)
def test_ctrl_c_with_processes(tmp_path: Path, processes: list[str]) -> None:
    code, err = ctrl_c(tmp_path, *processes)
    assert code == 130
    assert "Traceback" not in err
    assert load_progress(tmp_path / "run" / "checkpoints", "last").updates >= 2
