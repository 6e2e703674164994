"""Whatever is wrong with what is read, it ends in one sentence: properties, tried on values nobody thought of.

A few examples of each by default, many more under the marker ``slow``; always the same ones.
"""

import copy
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.run_config import CHECKPOINTS, settings_of_run
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.evaluation import make_evaluation
from rcdsac_trl.rollout.make_agent import make_average, make_loss
from rcdsac_trl.storage.checkpoint import load_weights
from rcdsac_trl.storage.checkpoint_record import find, folders
from rcdsac_trl.training.resume import run_to_continue
from rcdsac_trl.training.setup import check_training
from rcdsac_trl.world.maps.generator import MapSettings, generate_map
from rcdsac_trl.world.maps.shapes import Map
from tiny import tiny_cfg

MANY = pytest.mark.slow


def tries(few: int) -> Any:
    """Run few examples, always the same."""
    return settings(
        derandomize=True,
        deadline=None,
        max_examples=few,
        database=None,
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    )


NUMBERS = st.one_of(
    st.sampled_from([0, 1, -1, 2, 0.5, -0.5, 10**6, 10**12, -(10**12), 10**400, 1e300, 1e-300, 1e9]),
    st.integers(),
    st.floats(allow_nan=True, allow_infinity=True),
)
# Interpolations are resolved, and refused, before settings are read.
TEXTS = st.sampled_from(["", " ", "auto", "none", "nan", "null", "../x", "\0", "é" * 300, "cpu", "cuda:99"]) | st.text(
    max_size=5
).filter(lambda text: "$" not in text and "?" not in text)
SCALARS = st.one_of(st.none(), st.booleans(), NUMBERS, TEXTS)
VALUES = st.one_of(
    SCALARS,
    st.lists(SCALARS, max_size=3),
    st.dictionaries(st.sampled_from(["a", "name", "low", ""]), SCALARS, max_size=2),
    st.just([[[]]]),
)


def leaves(node: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of everything in a document, sections and lists too."""
    if at:
        yield at
    pairs = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in pairs:
        yield from leaves(value, (*at, key))


def changed(document: Any, at: tuple[Any, ...], value: Any) -> Any:
    """Return a copy with another value in one place."""
    document = copy.deepcopy(document)
    node = document
    for key in at[:-1]:
        node = node[key]
    node[at[-1]] = value
    return document


def refused_or_read(read: Callable[[], Any]) -> Any:
    """Return what was read, or None if it was refused in one sentence; nothing else may happen."""
    told = "a sentence"
    try:
        return read()
    except UserInputError as error:
        told = str(error)
    assert told.strip()
    assert "\n" not in told
    return None


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not ask git for the commit in every example."""
    monkeypatch.setattr("rcdsac_trl.training.run_folder.commit", lambda: "none")


# ------------------------------------------------------------------------------------------------ configs
TRAINING = OmegaConf.to_container(tiny_cfg(), resolve=True)
PLACES = list(leaves(TRAINING))


@pytest.mark.parametrize("few", [100, pytest.param(5000, marks=MANY)])
def test_a_training_reads_or_refuses_any_value_of_any_key(few: int) -> None:
    @tries(few)
    @given(st.sampled_from(PLACES), VALUES)
    @example(("seed",), "\n")
    def holds(at: tuple[Any, ...], value: Any) -> None:
        refused_or_read(lambda: check_training(OmegaConf.create(changed(TRAINING, at, value))))

    holds()


NOT_FINITE = [float("nan"), float("inf")]


def test_every_key_of_a_training_refuses_what_it_cannot_be() -> None:
    """Each leaf by itself: what is neither its type nor finite never gets through."""
    wrong_text_allowed = {"resume", "init", "device", "name"}
    cfg = OmegaConf.create(TRAINING)  # changed in place: to make one takes five times as long as to refuse it
    for at in PLACES:
        section = _at(cfg, at[:-1])
        kept = section[at[-1]]
        if OmegaConf.is_config(kept):
            continue
        for value in [*NOT_FINITE, {"a": 1}, *([] if at[-1] in wrong_text_allowed else ["some text"])]:
            section[at[-1]] = value
            with pytest.raises(UserInputError):
                check_training(cfg)
        section[at[-1]] = kept
    assert cfg == TRAINING


@pytest.mark.parametrize("few", [60, pytest.param(1500, marks=MANY)])
def test_a_training_refuses_unknown_keys_in_every_section(few: int) -> None:
    sections = [()] + [at for at in PLACES if isinstance(_at(TRAINING, at), dict)]

    @tries(few)
    @given(st.sampled_from(sections), st.text("abcdefg_", min_size=1, max_size=8), SCALARS)
    def holds(at: tuple[Any, ...], key: str, value: Any) -> None:
        document = changed(TRAINING, (*at, f"{key}_x"), value)
        with pytest.raises(UserInputError, match="there is no key"):
            check_training(OmegaConf.create(document))

    holds()


def _at(document: Any, at: tuple[Any, ...]) -> Any:
    for key in at:
        document = document[key]
    return document


@pytest.mark.parametrize("few", [12, pytest.param(300, marks=MANY)])
def test_the_command_line_reads_or_refuses_any_override(few: int) -> None:
    keys = [".".join(at) for at in PLACES if all(isinstance(key, str) for key in at)]
    words = st.text("0123456789abc.-+[]{},:'\"=$ ~?", max_size=8)

    @tries(few)
    @given(st.sampled_from([*keys, "nokey", "+new", "~seed", "", "+", "a.b.c"]), words)
    @example("seed", "1e999")
    @example("+", "")
    @example("task", "{")
    def holds(key: str, word: str) -> None:
        refused_or_read(lambda: check_training(compose("train", ["+algo=rcdsac_pow", f"{key}={word}"])))

    holds()


@pytest.mark.parametrize("few", [60, pytest.param(1500, marks=MANY)])
def test_an_evaluation_reads_or_refuses_any_value_of_any_key_and_writes_nothing(
    few: int, tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    cfg = OmegaConf.to_container(
        compose("evaluate", [f"run={tiny_run}", "beta=[-1]", "map=easy", "sensor=narrow", "task=default"]), resolve=True
    )
    before = sorted(tiny_run.rglob("*"))

    @tries(few)
    @given(st.sampled_from(list(leaves(cfg))), VALUES)
    def holds(at: tuple[Any, ...], value: Any) -> None:
        refused_or_read(lambda: make_evaluation(OmegaConf.create(changed(cfg, at, value))))

    holds()
    assert list(tmp_path.iterdir()) == []
    assert sorted(tiny_run.rglob("*")) == before


# ------------------------------------------------------------------------------------------------ maps
MAP = json.loads(generate_map(MapSettings(size_m=10.0, num_movers=2), "train", 0, 0).to_json())


@pytest.mark.parametrize("few", [100, pytest.param(5000, marks=MANY)])
def test_a_map_is_read_or_refused(few: int) -> None:
    @tries(few)
    @given(st.sampled_from(list(leaves(MAP))), VALUES)
    @example(("size_m",), "10")
    @example(("boxes", 0, "x"), float("nan"))
    @example(("boxes", 0, "mapped"), 1)
    def holds(at: tuple[Any, ...], value: Any) -> None:
        read = refused_or_read(lambda: Map.from_json(json.dumps(changed(MAP, at, value))))
        if read is not None:  # what is read can be worked with
            assert torch.isfinite(torch.from_numpy(read.segments())).all()
            assert torch.isfinite(torch.from_numpy(read.circles())).all()
            assert Map.from_json(read.to_json()) == read

    holds()


@pytest.mark.parametrize("few", [60, pytest.param(2000, marks=MANY)])
def test_text_that_is_no_map_is_refused(few: int) -> None:
    text = json.dumps(MAP)

    @tries(few)
    @given(st.one_of(st.text(max_size=20), st.integers(0, len(text) - 1).map(lambda end: text[:end])))
    @example("[" * 100_000)
    def holds(given_text: str) -> None:
        with pytest.raises(UserInputError):
            Map.from_json(given_text)

    holds()


def test_generated_maps_of_every_layout_are_read_again() -> None:
    for index in range(12):
        made = generate_map(MapSettings(), "train", 0, index)
        assert Map.from_json(made.to_json()) == made


# ------------------------------------------------------------------------------------------------ run folders
@pytest.fixture
def run(tiny_run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(tiny_run, tmp_path / "run"))


def damaged_copy(path: Path, way: str, at: float, bit: int) -> None:
    content = bytearray(path.read_bytes())
    if way == "delete" or not content:
        path.unlink()
    elif way == "truncate":
        path.write_bytes(content[: int(at * len(content))])
    elif way == "append":
        path.write_bytes(bytes(content) + b"x")
    else:
        content[int(at * len(content))] ^= 1 << bit
        path.write_bytes(bytes(content))


WAYS = st.tuples(
    st.sampled_from(["flip", "truncate", "delete", "append"]),
    st.floats(0, 1, exclude_max=True),
    st.integers(0, 7),
)


@pytest.mark.parametrize("few", [25, pytest.param(600, marks=MANY)])
def test_damage_to_a_checkpoint_never_changes_weights_in_silence(few: int, run: Path) -> None:
    trained = settings_of_run(run)
    checkpoints = run / CHECKPOINTS
    average = make_average(make_loss(trained, "cpu"), trained.learner)

    def load() -> dict[str, torch.Tensor]:
        load_weights(checkpoints, "last", average=average)
        return {key: value.clone() for key, value in average.state_dict().items()}

    whole = [load()]
    newest_folder = folders(checkpoints)[-1]
    kept = run / "kept"
    shutil.move(newest_folder, kept)
    whole.append(load())
    shutil.move(kept, newest_folder)
    files = sorted(path.relative_to(newest_folder) for path in newest_folder.rglob("*") if path.is_file())

    @tries(few)
    @given(st.sampled_from(files), WAYS)
    def holds(name: Path, way: tuple[str, float, int]) -> None:
        path = newest_folder / name
        content = path.read_bytes()
        damaged_copy(path, *way)
        try:
            loaded = load()
            # What is not told of did no harm, as a space at the end of the record; else it is the one before.
            expected = whole[1] if find(checkpoints, "last")[1] else whole[0]
            assert all(torch.equal(value, expected[key]) for key, value in loaded.items())
        finally:
            path.write_bytes(content)

    holds()


@pytest.mark.parametrize("few", [10, pytest.param(150, marks=MANY)])
@pytest.mark.parametrize("name", ["config.yaml", "manifest.json"])
def test_a_damaged_run_folder_is_read_or_refused(few: int, name: str, run: Path) -> None:
    path = run / name
    content = path.read_bytes()
    before = sorted(run.rglob("*"))

    @tries(few)
    @given(WAYS)
    def holds(way: tuple[str, float, int]) -> None:
        damaged_copy(path, *way)
        try:
            refused_or_read(lambda: make_evaluation(compose("evaluate", [f"run={run}", "beta=[-1]"])))
            refused_or_read(lambda: run_to_continue([f"resume={run}"]))
            refused_or_read(lambda: settings_of_run(run))
        finally:
            path.write_bytes(content)

    holds()
    assert sorted(run.rglob("*")) == before


@pytest.mark.parametrize("few", [40, pytest.param(1500, marks=MANY)])
def test_a_config_of_a_run_with_any_value_is_read_or_refused(few: int, run: Path) -> None:
    path = run / "config.yaml"
    document = yaml.safe_load(path.read_text())

    @tries(few)
    @given(st.sampled_from(list(leaves(document))), VALUES)
    def holds(at: tuple[Any, ...], value: Any) -> None:
        path.write_text(yaml.safe_dump(changed(document, at, value)))
        refused_or_read(lambda: settings_of_run(run))

    holds()


@pytest.mark.parametrize("few", [25, pytest.param(800, marks=MANY)])
def test_a_damaged_evaluation_folder_is_read_or_refused(few: int, run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    path = out / "evaluation.json"
    cfg = compose("evaluate", [f"run={run}", "beta=[-1]", f"out={out}"])
    content = make_evaluation(cfg).results.described.encode()

    @tries(few)
    @given(WAYS)
    def holds(way: tuple[str, float, int]) -> None:
        path.write_bytes(content)
        damaged_copy(path, *way)
        refused_or_read(lambda: make_evaluation(cfg))

    holds()
