"""What is typed: in any order, with paths as people write them; and mistakes, told before torch is imported."""

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from rcdsac_trl import draw_maps
from rcdsac_trl.cli import read_arguments
from rcdsac_trl.config.calibration_settings import CalibrationSettings
from rcdsac_trl.config.command_line import expanded
from rcdsac_trl.config.compose import choices, compose, output_folder, parse
from rcdsac_trl.config.course_settings import CourseSettings
from rcdsac_trl.config.evaluation_settings import EvaluationSettings
from rcdsac_trl.config.named_folder import default_training
from rcdsac_trl.config.run_config import read_config, training_settings
from rcdsac_trl.errors import UserInputError

POW = "+algo=rcdsac_pow"


def refusal(config_name: str, *overrides: str) -> str:
    """Return the sentence that refuses a call before any setting is read."""
    with pytest.raises(UserInputError) as caught:
        compose(config_name, read_arguments(list(overrides)).overrides)  # type: ignore[union-attr]
    return str(caught.value)


# ------------------------------------------------------------------------------------------------ order
def test_overrides_may_stand_before_and_behind_options() -> None:
    for argv in ([POW, "-m", "seed=0,1"], ["-m", POW, "seed=0,1"], [POW, "seed=0,1", "--multirun"]):
        read = read_arguments(argv)
        assert read is not None
        assert (read.overrides, read.multirun) == ([POW, "seed=0,1"], True)
    assert read_arguments([POW, "--cfg", "job", "seed=1"]) is None  # it only shows something
    with pytest.raises(UserInputError, match="there is no option --fast"):
        read_arguments([POW, "--fast", "seed=1"])
    with pytest.raises(UserInputError, match=r"there is no option -1\]: .* put a value with spaces in quotes"):
        read_arguments(["beta=[-2,", "-1]"])
    with pytest.raises(UserInputError, match="invalid choice: 'all of it'"):
        read_arguments(["--cfg", "all of it"])


def test_hydra_gets_overrides_first_and_paths_in_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, value in {"HOME": str(tmp_path), "MALLOC_MMAP_MAX_": "0"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "argv", ["prog", "count=3", "--cfg", "job", "out=~/maps.png"])
    draw_maps.main()
    shown = capsys.readouterr().out
    assert "count: 3\n" in shown
    assert f"out: {tmp_path}/maps.png\n" in shown


@pytest.mark.parametrize(
    "override", ["hydra.mode=MULTIRUN", "+hydra.mode=multirun", "++hydra.mode=RUN", "hydra={mode: MULTIRUN}"]
)
def test_there_is_one_way_to_several_jobs(override: str) -> None:
    with pytest.raises(UserInputError, match=r"leave it out; `train -m` runs several trainings"):
        read_arguments([POW, override, "seed=0,1"])


# ------------------------------------------------------------------------------------------------ paths
def test_home_folders_and_variables_are_what_a_shell_makes_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/anna lee")
    monkeypatch.setenv("DISK", "/mnt/a,b")
    for written, path in {
        "out=~/x": "/home/anna lee/x",
        "out=~": "/home/anna lee",
        "out='~/x'": "/home/anna lee/x",
        "out=$HOME/x": "/home/anna lee/x",
        "out=$DISK/x": "/mnt/a,b/x",
        'out="$DISK/x"': "/mnt/a,b/x",
        "out=runs/$DISK": "runs//mnt/a,b",
        "out=a~b": None,
        "out=x/~/y": None,
    }.items():
        if path is None:
            assert expanded(written) == written
        else:
            assert parse([expanded(written)])[0].value() == path
    assert parse([expanded("runs=[~/a,'~/b']")])[0].value() == ["/home/anna lee/a", "/home/anna lee/b"]
    for untouched in ("~learner.gamma", "seed=${other}", "search.storage=postgresql://me:a$b@host/x"):
        assert expanded(untouched) == untouched
    assert "there is no home folder ~nobody-here" in refusal("evaluate", "run=~nobody-here/x")
    assert "there is no environment variable NOWHERE_AT_ALL" in refusal("evaluate", "run=$NOWHERE_AT_ALL/x")
    with pytest.raises(UserInputError, match=r"write \$HOME, without braces"):
        output_folder("train", [POW, "hydra.run.dir=${HOME}/x"])
    assert refusal("evaluate", "out=${HOME}/x").endswith(
        ": write $HOME, without braces, for the variable of the environment"
    )


@pytest.mark.parametrize("path", ["a,b", "lr=1", "a[1]", "a(b)", "a{b}", "größe", "a b,c", "a#b", 'a"b', "a&b"])
def test_what_a_refused_path_should_be_written_as_works(path: str) -> None:
    told = refusal("evaluate", f"out={path}")
    typed = shlex.split(told[told.index("as 'out=") + 3 :])[0]
    assert compose("evaluate", [typed]).out == path


def test_a_value_that_a_shell_split_at_its_space_is_put_together() -> None:
    told = refusal("evaluate", "run=my", "runs/x")
    assert told.startswith(
        "runs/x cannot be read: write it as <key>=<value>, or, if it belongs to what stands before it"
    )
    assert compose("evaluate", [shlex.split(told.rpartition("it, ")[2])[0]]).run == "my runs/x"
    assert refusal("evaluate", "run", "=", "x").endswith("write it as <key>=<value>, without spaces around =")


@pytest.mark.parametrize(
    ("config_name", "words", "told"),
    [
        ("evaluate", ["rcdsac_pow-narrow"], "rcdsac_pow-narrow cannot be read: did you mean run=rcdsac_pow-narrow?"),
        ("report", ["sac-narrow"], "sac-narrow cannot be read: did you mean runs=[sac-narrow]?"),
        ("train", ["rcdsac_pow"], "rcdsac_pow cannot be read: did you mean +algo=rcdsac_pow?"),
        ("train", [POW, "sparse"], "sparse cannot be read: did you mean sensor=sparse?"),
        ("train", ["default"], "default cannot be read: write it as <key>=<value>"),  # of several groups
        ("evaluate", ["--num_maps", "3"], "there is no option --num_maps: did you mean num_maps=3?"),
        ("evaluate", ["run=x", "--num_maps=3"], "there is no option --num_maps: did you mean num_maps=3?"),
        (
            "evaluate",
            ["--record", "run=x"],
            "there is no option --record: --help lists them; a key takes no dashes, record=<value>",
        ),
    ],
)
def test_a_value_without_its_key_is_answered_by_both(config_name: str, words: list[str], told: str) -> None:
    assert refusal(config_name, *words) == told


def test_several_values_are_jobs_for_train_alone() -> None:
    assert ", or add -m to run one job for each, or" in refusal("train", POW, "seed=0,1")
    assert "-m" not in refusal("evaluate", "seed=0,1")


@pytest.mark.parametrize(
    ("verb", "root"),
    [("evaluate", EvaluationSettings), ("calibrate", CalibrationSettings), ("course", CourseSettings)],
)
def test_one_number_is_a_list_of_one(verb: str, root: type[Any]) -> None:
    assert read_config(compose(verb, ["run=x", "beta=-0.5"]), root).beta == (-0.5,)


@pytest.mark.parametrize(("typed", "text"), [("123", "123"), ("1e3", "1000.0"), ("true", "True")])
def test_a_folder_called_like_a_number_must_be_quoted(typed: str, text: str) -> None:
    with pytest.raises(UserInputError) as caught:
        read_config(compose("evaluate", [f"run={typed}"]), EvaluationSettings)
    assert str(caught.value) == f"run={text} must be text or null; as a text: 'run=\"{text}\"'"


# ------------------------------------------------------------------------------------------------ groups
def test_an_evaluation_changes_single_keys_of_what_was_trained() -> None:
    trained = training_settings(compose("train", [POW, "map=hard", "task.range_dropout=0.1", "sensor=full"]))
    for plus in ("", "+"):
        overrides = ["run=x", f"{plus}task.episode_steps=200", f"{plus}map.num_movers=0"]
        settings = read_config(compose("evaluate", overrides), EvaluationSettings)
        maps, sensor, task, *_ = settings.world_of(trained)
        assert (task.episode_steps, task.range_dropout) == (200, 0.1)
        assert (maps.num_movers, maps.clutter_per_m2) == (0, trained.map.clutter_per_m2)
        assert sensor == trained.sensor
    # A choice is a whole section.
    settings = read_config(
        compose("evaluate", ["run=x", "map=easy", "map.num_movers=1", "task=default"]), EvaluationSettings
    )
    maps, _, task, *_ = settings.world_of(trained)
    easy = training_settings(compose("train", [POW, "map=easy", "map.num_movers=1"]))
    assert (maps, task.range_dropout) == (easy.map, 0.0)
    assert default_training().map.num_movers == 4


@pytest.mark.parametrize(
    ("config_name", "overrides", "sentence"),
    [
        ("train", ["algo.beta=-1"], "algo.beta needs a choice of algo: add +algo=<name>, one of dsac_cvar, "),
        (
            "train",
            [POW, "sensor.max_range_m=10"],
            "there is no key sensor.max_range_m: did you mean robot.lidar.max_range_m?",
        ),
        ("train", [POW, "learner.num_agents=2"], "there is no key learner.num_agents: did you mean world.num_agents?"),
        (
            "train",
            [POW, "collector=single", "collector.num_processes=2"],
            "collector.num_processes goes with collector=multi or collector=ray alone: add that, or leave it out",
        ),
        ("train", [POW, "preset.iterations=3"], "there is no key preset.iterations: did you mean schedule.iterations?"),
        (
            "sweep",
            ["launcher.requeues=2"],
            "launcher.requeues goes with launcher=slurm alone: add that, or leave it out",
        ),
        ("sweep", ["launcher.partion=a"], "there is no key launcher.partion: launcher has name"),
        ("calibrate", ["task.episode_steps=3"], "there is no key task.episode_steps"),
        ("course", ["sensor.name=full"], "there is no key sensor.name"),
        ("draw_maps", ["task.episode_steps=3"], "there is no key task.episode_steps"),
        ("draw_maps", ["map.num_mover=3"], "there is no key map.num_mover: did you mean map.num_movers?"),
        ("evaluate", ["collector.num_processes=0"], "there is no key collector.num_processes"),
    ],
)
def test_a_key_that_is_not_there_is_answered_by_what_to_type(
    config_name: str, overrides: list[str], sentence: str
) -> None:
    assert refusal(config_name, *overrides).startswith(sentence)


def test_a_key_of_an_algorithm_chooses_none() -> None:
    with pytest.raises(UserInputError, match=rf"no algorithm chosen: .* one of {', '.join(choices('algo'))}"):
        training_settings(compose("train", ["+algo.beta=-1"]))


# ------------------------------------------------------------------------------------------------ without torch
# A mistake of each verb, of each kind that can be told before there is anything to work with.
MISTAKES = [
    # first, as those after them import pandas
    ("report.__main__", ""),
    ("report.__main__", "runs=nowhere"),
    ("report.__main__", "runs=[run]"),
    ("report.__main__", "out=file"),
    ("draw_maps", "count=0"),
    ("draw_maps", "out=maps.jpg"),
    ("train", ""),
    ("train", "algo=sac"),
    ("train", f"{POW} learner.batchsize=3"),
    ("train", f"{POW} learner.batch_size=-1"),
    ("train", f"{POW} algo.beta=-1"),
    ("train", f"{POW} network.memory=0"),
    ("train", f"{POW} sensor.name=wide"),
    ("train", f"{POW} device=tpu"),
    ("train", f"{POW} logger.backends=[paper]"),
    ("train", f"{POW} collector=ray collector.num_processes=3"),
    ("train", f"{POW} hydra.run.dir=taken"),
    ("train", f"{POW} hydra.run.dir=file"),
    ("train", f"{POW} launcher=joblib"),
    ("train", "resume=nowhere"),
    ("train", "init=nobody"),
    ("train", f"-m {POW} seed=0,abc"),
    ("train", f"{POW} -m sensor=narrow,wide"),
    ("train", f"-m {POW} launcher=joblib launcher.cores_per_run=0"),
    ("search", f"{POW} search.trails=3"),
    ("search", f"{POW} search.trials=0"),
    ("search", f"{POW} space=none"),
    ("search", f"{POW} learner.batch_size=-1"),
    ("evaluate", ""),
    ("evaluate", "run=nowhere"),
    ("evaluate", "run=run beta=[3]"),
    ("evaluate", "run=run beta=[-3]"),
    ("evaluate", "baseline=pursuit task.episode_step=3"),
    ("evaluate", "baseline=pursuit sensor.name=wide"),
    ("evaluate", "baseline=pursuit num_maps=0"),
    ("evaluate", "baseline=pursuit device=tpu"),
    ("evaluate", "baseline=pursuit out=file"),
    ("evaluate", "baseline=pursuit half_precision=true"),
    ("evaluate", "baseline=dwaa"),
    ("evaluate", "run=sac-narrow beta=[-1]"),
    ("evaluate", "run=sac-narrow sensor=sparse"),
    ("evaluate", "run=sac-narrow +sensor.memory_s=3"),
    ("evaluate", "run=sac-narrow checkpoint=best"),
    ("evaluate", "run=sac-narrow half_precision=true"),
    ("calibrate", "run=nowhere"),
    ("calibrate", "run=sac-narrow"),
    ("calibrate", "run=rcdsac_pow-narrow beta=-3"),
    ("calibrate", "num_maps=0"),
    ("course", "run=nowhere"),
    ("course", "repetitions=0"),
    ("course", "out=file"),
    ("export", ""),
    ("export", "run=nowhere"),
    ("export", "run=run out=file"),
    ("export", "run=sac-narrow out=taken"),
    ("publish", ""),
    ("publish", "runs=[nowhere]"),
    ("publish", "runs=[run] weights=file"),
    ("agents", "nobody"),
    ("agents", "format=xml"),
    ("verify", "nobody"),
    ("verify", "sac-narrow sac-narrow"),
    ("verify", "num_maps=4"),
    ("verify", "out=file"),
    ("play", "port=99999999"),
    ("play", "port=0 run=nobody"),
    ("play", "port=0 maps=[nowhere.json]"),
    ("replay", ""),
    ("replay", "nowhere.bag"),
    ("replay", "recording=file"),
    ("replay", "recording=file run=nowhere"),
    ("plot_training", ""),
    ("plot_training", "run=nowhere"),
]
TELL = """
import importlib, json, sys
from composed_once import remember_compositions
remember_compositions()
told = []
for verb, words in json.loads(sys.argv[1]):
    sys.argv[1:] = words
    try:
        importlib.import_module(f"rcdsac_trl.{verb}").main()
    except SystemExit as left:
        late = {"torch", "torchrl", "tensordict"}
        if verb in ("report.__main__", "draw_maps"):
            late |= {"pandas", "matplotlib"}
        told.append((left.code, sorted(late & set(sys.modules))))
    if told[-1] != (2, []):
        sys.exit(f"{verb} {words}: {told[-1]}")
print(len(told))
"""


def test_mistakes_are_told_without_torch(tmp_path: Path) -> None:
    for folder in ("taken", "run"):
        (tmp_path / folder).mkdir()
    (tmp_path / "taken" / "config.yaml").touch()
    (tmp_path / "file").touch()
    (tmp_path / "run" / "config.yaml").write_text(OmegaConf.to_yaml(compose("train", [POW]), resolve=True))
    calls = [(verb, words.split()) for verb, words in MISTAKES]
    done = subprocess.run(
        [sys.executable, "-c", TELL, json.dumps(calls)],
        cwd=tmp_path,
        env=os.environ | {"MALLOC_MMAP_MAX_": "0", "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    sentences = done.stderr.splitlines()
    assert done.stdout == f"{len(MISTAKES)}\n"
    assert len(sentences) == len(MISTAKES)
    assert all(sentence.startswith("rcdsac_trl: ") for sentence in sentences)
