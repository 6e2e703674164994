"""One command: verbs, their help, what is completed; all of it made from one table and from conf/."""

import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest

import rcdsac_trl
import rcdsac_trl.__main__ as program
from rcdsac_trl import cli, replay
from rcdsac_trl.config.command_line import with_names
from rcdsac_trl.config.completion import bash_completion
from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.paths import CONF_DIR
from rcdsac_trl.config.verb_help import explained_keys, list_of_verbs, verb_help
from rcdsac_trl.config.verbs import VERBS, module_of, verb_named
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.experiments.optuna_search import make_search
from rcdsac_trl.training.setup import check_training

ROOT = Path(__file__).resolve().parents[2]
SOURCE = Path(rcdsac_trl.__file__).parent


def called(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.setenv("MALLOC_MMAP_MAX_", "0")  # else it starts this process again
    monkeypatch.setattr(sys, "argv", ["rcdsac-trl", *arguments])
    program.main()


# ------------------------------------------------------------------------------------------------ the table
def test_the_table_has_every_verb() -> None:
    """A verb is a file beside the rooms, or a room that runs, with a root config of its name."""
    files = {path.stem for path in SOURCE.glob("*.py")} | {path.parent.name for path in SOURCE.glob("*/__main__.py")}
    assert set(VERBS) == {path.stem for path in CONF_DIR.glob("*.yaml")} & files
    for verb in VERBS:
        assert callable(import_module(module_of(verb)).main)


def test_every_verb_has_three_examples() -> None:
    assert {len(verb.examples) for verb in VERBS.values()} == {3}


EXAMPLES = [(verb, example) for verb, described in VERBS.items() for example in described.examples]


@pytest.mark.parametrize(("verb", "example"), EXAMPLES)
def test_examples_are_accepted(verb: str, example: str) -> None:
    overrides = shlex.split(re.sub(r"<[\w.]+>", "x", example))
    if verb == "search":
        make_search(overrides)
        return
    if verb == "replay":
        overrides = replay.with_key(overrides)
    if verb in ("agents", "verify"):
        overrides = with_names("agents", overrides)
    cfg = compose(verb, overrides)
    if verb == "train" and cfg.resume is None:
        check_training(cfg)


@pytest.mark.parametrize(
    ("typed", "sentence"),
    [
        ("trian", "there is no verb trian: did you mean train?"),
        ("plot-trainin", "there is no verb plot-trainin: did you mean plot_training?"),
        ("sing", f"there is no verb sing: one of {', '.join(VERBS)}"),
        ("+algo=sac", "+algo=sac is no verb: begin with one, as in `rcdsac-trl train +algo=rcdsac_pow`"),
        ("--fast", "--fast is no verb: begin with one, as in `rcdsac-trl train +algo=rcdsac_pow`"),
    ],
)
def test_a_mistyped_verb_gets_the_nearest(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], typed: str, sentence: str
) -> None:
    with pytest.raises(SystemExit) as left:
        called(monkeypatch, typed)
    assert left.value.code == 2
    assert capsys.readouterr() == ("", f"rcdsac_trl: {sentence}\n")


# ------------------------------------------------------------------------------------------------ the program
def test_the_console_script_is_the_program() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    module, _, function = project["scripts"]["rcdsac-trl"].partition(":")
    assert getattr(import_module(module), function) is program.main


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"], ["help"]])
def test_without_a_verb_it_lists_them(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    called(monkeypatch, *arguments)
    told = capsys.readouterr().out
    assert told == list_of_verbs() + "\n"
    for verb, described in VERBS.items():
        assert re.search(rf"^  {verb} +{re.escape(described.does)}$", told, re.M)


def test_it_tells_its_version(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    called(monkeypatch, "--version")
    assert capsys.readouterr().out == f"rcdsac_trl {rcdsac_trl.__version__}\n"
    assert re.fullmatch(r"\d+\.\d+\.\d+", rcdsac_trl.__version__)


def test_a_verb_gets_what_stands_behind_it(tmp_path: Path) -> None:
    """The whole program, without torch: a mistake behind the verb is refused as the verb alone refuses it."""
    told = [
        subprocess.run(
            [sys.executable, "-m", *words, "bta=[-1]"], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        for words in (["rcdsac_trl", "evaluate"], ["rcdsac_trl.evaluate"])
    ]
    assert {(done.returncode, done.stdout, done.stderr) for done in told} == {
        (2, "", "rcdsac_trl: there is no key bta: did you mean beta?\n")
    }


def test_listing_verbs_imports_nothing_heavy() -> None:
    code = "import sys, rcdsac_trl.__main__; print(sorted({'torch', 'pybullet', 'pandas'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_a_reader_that_leaves_is_no_fault() -> None:
    """As ``rcdsac-trl --help | head -1`` may leave before all is written."""
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = subprocess.run([sys.executable, "-m", "rcdsac_trl"], stdout=writer, stderr=subprocess.PIPE, text=True)
    finally:
        os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")


# ------------------------------------------------------------------------------------------------ help
@pytest.mark.parametrize("verb", VERBS)
def test_help_explains_keys_with_the_comments_of_conf(verb: str) -> None:
    told = " ".join(verb_help(verb).split())
    assert told.startswith(f"rcdsac-trl {verb}: {VERBS[verb].does}.")
    for example in VERBS[verb].examples:
        assert f"rcdsac-trl {verb} {example} " in told
    shown = 0
    for explained in explained_keys(CONF_DIR / f"{verb}.yaml"):
        name, is_section = explained.name, isinstance(explained.value, dict)
        if is_section or name.startswith("hydra."):
            continue
        if "." not in name or name in VERBS[verb].keys or name.split(".")[0] in VERBS[verb].keys:
            assert f" {name}=" in told
            assert explained.comment
            assert explained.comment in told
            shown += 1
        else:
            assert f" {name}=" not in told
    assert shown
    assert len(verb_help(verb).splitlines()) < 120  # not all of Hydra


def test_keys_of_the_table_exist() -> None:
    for verb, described in VERBS.items():
        names = {explained.name for explained in explained_keys(CONF_DIR / f"{verb}.yaml")}
        assert set(described.keys) <= names


def test_help_shows_values_with_what_was_chosen() -> None:
    assert "  schedule.iterations=150\n" in verb_help("train")
    assert "  schedule.iterations=500\n" in verb_help("train", ["preset=paper"])
    assert "  robot: jackal, paper (default), turtlebot3_burger, turtlebot4\n" in verb_help("train")
    assert "barn, " in verb_help("evaluate")
    assert not any("barn, " in verb_help(verb) for verb in ("train", "search"))  # which nothing trains on
    with pytest.raises(UserInputError, match=r"^preset=tiny does not exist"):
        verb_help("train", ["preset=tiny"])


@pytest.mark.parametrize("verb", ["search", "draw_maps"])
def test_asked_for_help_a_verb_does_nothing_else(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, verb: str
) -> None:
    monkeypatch.chdir(tmp_path)
    called(monkeypatch, verb, "--help")
    assert capsys.readouterr().out == verb_help(verb) + "\n"
    assert list(tmp_path.iterdir()) == []


def test_hydras_own_help_is_kept(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert not cli.shows_help("train", ["--hydra-help"])
    with pytest.raises(SystemExit) as left:
        called(monkeypatch, "draw_maps", "--hydra-help")
    assert left.value.code == 0
    assert "Hydra (1.3" in capsys.readouterr().out


# ------------------------------------------------------------------------------------------------ completion
@pytest.fixture(scope="module")
def completed(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], list[str]]:
    """Complete a line as bash does."""
    folder = tmp_path_factory.mktemp("completion")
    (folder / "runs").mkdir()
    script = folder / "rcdsac-trl"
    script.write_text(bash_completion())
    code = (
        f'source {script}; COMP_LINE=$1; COMP_POINT=${{#1}}; read -ra COMP_WORDS <<<"$1"; '
        '_rcdsac_trl; printf "%s\\n" "${COMPREPLY[@]}"'
    )

    def complete(line: str) -> list[str]:
        done = subprocess.run(
            ["bash", "-c", code, "bash", line], cwd=folder, capture_output=True, text=True, check=True
        )
        assert done.stderr == ""
        return done.stdout.splitlines()

    return complete


@pytest.mark.skipif(not os.access("/bin/bash", os.X_OK), reason="there is no bash here")
@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("rcdsac-trl ev", ["evaluate "]),
        ("rcdsac-trl plo", ["plot_training "]),
        ("rcdsac-trl train sensor=", ["full", "narrow", "sparse"]),
        ("rcdsac-trl train +algo=s", ["sac "]),
        ("rcdsac-trl evaluate map=b", ["barn "]),
        ("rcdsac-trl train map=b", [""]),  # which nothing trains on
        ("rcdsac-trl search map=b", [""]),
        ("rcdsac-trl train seed=1 learner.ga", ["learner.gamma="]),
        ("rcdsac-trl evaluate run=rcdsac_pow-n", ["rcdsac_pow-narrow "]),
        ("rcdsac-trl train init=sac-n", ["sac-narrow "]),
        ("rcdsac-trl evaluate run=ru", ["runs/"]),
        ("rcdsac-trl evaluate out=ru", [""]),  # left to bash, which knows files
        ("rcdsac-trl nothing x", [""]),
    ],
)
def test_bash_completes(completed: Callable[[str], list[str]], line: str, words: list[str]) -> None:
    assert completed(line) == words


# ------------------------------------------------------------------------------------------------ make
def test_make_alone_lists_its_targets() -> None:
    done = subprocess.run(["make", "-s"], cwd=ROOT, capture_output=True, text=True, check=True)
    listed = dict(re.findall(r"^make ([a-z-]+) +(\S.*)$", done.stdout, re.M))
    phony = re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.M)
    assert phony is not None
    assert set(listed) == set(phony[1].split())


def test_a_verb_may_be_written_with_dashes() -> None:
    assert [verb_named(name) for name in ("draw-maps", "plot_training")] == ["draw_maps", "plot_training"]
