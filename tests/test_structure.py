"""What holds the rooms apart, and the documents true: imports, the table of keys, the configuration."""

import ast
import importlib.util
import re
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

import rcdsac_trl
from rcdsac_trl.agent.loss.loss_settings import LossSettings
from rcdsac_trl.agent.networks import NetworkSettings
from rcdsac_trl.agent.risk import MEASURES
from rcdsac_trl.config.algo_settings import AlgoSettings, DistortionSettings
from rcdsac_trl.config.learner_settings import LearnerSettings
from rcdsac_trl.config.paths import CONF_DIR
from rcdsac_trl.deploy.policy.distortion import NUM_REPORTED_QUANTILES
from rcdsac_trl.robot.range_sensor import SENSORS
from rcdsac_trl.rollout.environments import environment
from rcdsac_trl.world.maps.files.barn import BarnMapSettings
from rcdsac_trl.world.maps.files.file_map import FileMapSettings
from rcdsac_trl.world.maps.generator import MapSettings
from rcdsac_trl.world.task.rules import TaskSettings
from rcdsac_trl.world.task.world_settings import WorldSettings

SOURCE = Path(rcdsac_trl.__file__).parent


# ------------------------------------------------------------------------------------------------ imports
def imported_modules(path: Path) -> Iterator[str]:
    """Yield every module a file imports, wherever in the file."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute, so that they can be read"
            assert node.module is not None
            yield node.module
            # `from rcdsac_trl import pipeline` names a room as well.
            yield from (f"{node.module}.{alias.name}" for alias in node.names if node.module == "rcdsac_trl")


MODULES = sorted(path.relative_to(SOURCE).as_posix() for path in SOURCE.rglob("*.py"))


def room_of(module: str) -> str:
    """Name the room of a file or an import; what lies beside the rooms stands for itself."""
    parts = module.removesuffix(".py").replace("/", ".").removeprefix("rcdsac_trl.").split(".")
    return parts[0]


def is_entry_point(module: str) -> bool:
    """Tell whether a file is a command: it lies beside the rooms, or is what running a room runs."""
    return "/" not in module or module.endswith("/__main__.py")


# From above to below: a room imports what stands below it. World, agent and deploy stand side by side; of them only
# deploy may use another, the agent's layers, which it exports.
FLOORS = (
    {"experiments", "playground"},
    {"evaluation"},
    {"training"},
    {"release"},
    {"rollout"},
    {"storage"},
    {"config"},
    {"world", "agent", "deploy"},
    {"robot"},
    {"system"},
)
SIDEWAYS = {("deploy", "agent")}
# Files beside the rooms that serve all of them.
SHARED = {"colors", "errors", "seeding", "tables"}
# A room that reads files alone.
APART = "report"
ROOMS = set().union(*FLOORS, {APART})


def floor(room: str) -> int:
    return next(number for number, rooms in enumerate(FLOORS) if room in rooms)


def may_import(room: str, other: str) -> bool:
    """Tell whether an arrow from a room to another is one of those that go down."""
    if other in SHARED or other == room or (room, other) in SIDEWAYS:
        return True
    return APART not in (room, other) and other in ROOMS and floor(other) > floor(room)


def mentioned_modules(path: Path) -> Iterator[str]:
    """Yield every module that a file names in a string: arrows hide there, too, such as what processes preload."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield from re.findall(r"^rcdsac_trl(?:\.\w+)+$", node.value)


@pytest.mark.parametrize("module", MODULES)
def test_arrows_go_down(module: str) -> None:
    room = room_of(module)
    others = {room_of(name) for name in imported_modules(SOURCE / module) if name.startswith("rcdsac_trl.")}
    if room in ROOMS and not is_entry_point(module):
        assert not {other for other in others if not may_import(room, other)}
        others = {room_of(name) for name in mentioned_modules(SOURCE / module)}
        # A sweep starts programs: `python -m rcdsac_trl.train`.
        assert not {other for other in others if other in ROOMS and not may_import(room, other)}
    else:  # a command, or what all commands share: nothing in a room imports it
        assert others <= ROOMS | SHARED | {"cli", room}


def test_modules_named_in_strings_exist() -> None:
    for module in MODULES:
        for name in mentioned_modules(SOURCE / module):
            assert importlib.util.find_spec(name) is not None, f"{module} names {name}"


def test_no_file_name_stands_twice() -> None:
    names = [Path(module).name for module in MODULES if not module.endswith(("__init__.py", "__main__.py"))]
    assert sorted(names) == sorted(set(names))
    # Test tools pass over folders of this name.
    assert not [module for module in MODULES if "build" in Path(module).parts]


@pytest.mark.parametrize("module", [module for module in MODULES if module.startswith("report/")])
def test_reports_are_written_without_torch(module: str) -> None:
    libraries = {name.split(".")[0] for name in imported_modules(SOURCE / module)}
    assert not libraries & {"torch", "torchrl", "tensordict", "pybullet"}


# Beside config/, these write a run's config down or are given a composed one to make something of.
READ_THE_CONFIG = ("config", "training", "evaluation", "release", "experiments", "playground")


@pytest.mark.parametrize("module", MODULES)
def test_below_the_config_nobody_knows_that_there_is_one(module: str) -> None:
    config_libraries = {name.split(".")[0] for name in imported_modules(SOURCE / module)} & {"hydra", "omegaconf"}
    assert is_entry_point(module) or room_of(module) in READ_THE_CONFIG or not config_libraries


def test_the_rooms_are_there() -> None:
    assert {module.split("/")[0] for module in MODULES if "/" in module} == ROOMS


# ------------------------------------------------------------------------------------------------ the table of keys
TYPES = {"f32": torch.float32, "i64": torch.int64, "bool": torch.bool}


def key_table() -> dict[str, tuple[int, torch.dtype]]:
    """Read key, size and type from the table in the package's docstring."""
    assert rcdsac_trl.__doc__ is not None
    table: dict[str, tuple[int, torch.dtype]] = {}
    for line in rcdsac_trl.__doc__.splitlines():
        if line.startswith("| `"):
            keys, shape = (cell.strip() for cell in line.strip("|").split("|")[:2])
            size, dtype = shape.split()
            for key in re.findall(r"`(\w+)`", keys):
                assert key not in table, f"{key} stands in the table twice"
                table[key] = (int(size), TYPES[dtype])
    return table


def all_specs(env: EnvBase) -> dict[str, TensorSpec]:
    composites = (env.full_observation_spec, env.full_reward_spec, env.full_done_spec, env.full_action_spec)
    return {key: spec for composite in composites for key, spec in composite.items(True, True)}


def row(name: str) -> AlgoSettings:
    """Two rows that are told all there is to tell."""
    weighted = name == "rcwr"
    return AlgoSettings(
        name=name,
        critic="scalar" if weighted else "quantile",
        conditioning="none" if weighted else "per_episode",
        relabel="stored",
        beta=None,
        collision_weight=(0.1, 2.0) if weighted else None,
        evaluation_collision_weights=(1.0,) if weighted else (),
        distortion=DistortionSettings("neutral", 0.0, 0.0, ())
        if weighted
        else DistortionSettings("pow", -2.0, 0.0, ()),
    )


def test_the_table_of_keys_is_what_the_environment_has() -> None:
    world = WorldSettings(
        MapSettings(size_m=10.0), TaskSettings(), sensor="narrow", memory_s=9.0, num_agents=2, num_workers=0
    )
    found: dict[str, tuple[int, torch.dtype]] = {}
    for name in ("rcdsac_pow", "rcwr"):
        env = environment(
            world, row(name), split="train", seed=0, agent_ids=range(2), state_size=NetworkSettings().state_size
        )
        specs = all_specs(env)
        assert {spec.shape[:-1] for spec in specs.values()} == {env.batch_size}
        found |= {key: (spec.shape[-1], spec.dtype) for key, spec in specs.items()}
        env.close()
    assert key_table() == found


# ------------------------------------------------------------------------------------------------ the configuration
def conf(path: str) -> dict[str, Any]:
    """Read one file of conf/ without Hydra's parts."""
    values = yaml.safe_load((CONF_DIR / path).read_text()) or {}
    return {key: value for key, value in values.items() if key not in ("defaults", "hydra")}


def leaf_lines(node: yaml.Node, prefix: str) -> Iterator[tuple[str, int]]:
    """Yield the full key and the line (from 0) of every value that is not a section."""
    assert isinstance(node, yaml.MappingNode)
    for key, value in node.value:
        name = f"{prefix}.{key.value}".removeprefix(".")
        if isinstance(value, yaml.MappingNode):
            yield from leaf_lines(value, name)
        else:
            yield name, key.start_mark.line


def keys_with_comments() -> Iterator[tuple[str, str, bool]]:
    """Yield file, full key, and whether a comment stands right above the key."""
    for path in sorted(CONF_DIR.rglob("*.yaml")):
        text = path.read_text()
        root = yaml.compose(text)
        if root is None:
            continue
        name = path.relative_to(CONF_DIR).as_posix()
        folder = path.parent.relative_to(CONF_DIR).as_posix().replace("/", ".").strip(".")
        prefix = "" if "@package _global_" in text else folder
        lines = text.splitlines()
        for key, line in leaf_lines(root, prefix):
            below_prefix = key.removeprefix(prefix).strip(".")
            if below_prefix.split(".")[0] not in ("defaults", "hydra"):
                yield name, key, line > 0 and lines[line - 1].strip().startswith("#")


def test_every_key_of_the_configuration_is_explained() -> None:
    entries = list(keys_with_comments())
    explained = {key for _, key, commented in entries if commented}
    # A preset or a row may change a value without repeating what the key means.
    missing = [f"{name}: {key}" for name, key, commented in entries if not commented and key not in explained]
    assert not missing
    for root in (
        "train.yaml",
        "evaluate.yaml",
        "export.yaml",
        "calibrate.yaml",
        "course.yaml",
        "replay.yaml",
        "play.yaml",
        "report.yaml",
        "draw_maps.yaml",
        "plot_training.yaml",
        "search.yaml",
        "map/mixed.yaml",
        "map/file.yaml",
        "map/barn.yaml",
        "robot/paper.yaml",
        "experiment/grid.yaml",
        "publish.yaml",
        "agents.yaml",
        "verify.yaml",
    ):
        assert all(commented for name, _, commented in entries if name == root), root


def test_presets_change_only_what_the_root_explains() -> None:
    entries = list(keys_with_comments())
    groups = {"map", "robot", "sensor", "task", "logger", "collector", "algo"}
    known = {key for name, key, _ in entries if name == "train.yaml" or name.split("/")[0] in groups}
    for name, key, _ in entries:
        if name.startswith("preset/"):
            assert key in known, f"{name}: {key}"


def as_lists(values: dict[str, Any]) -> dict[str, Any]:
    return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}


def test_the_code_has_the_defaults_of_the_configuration() -> None:
    assert conf("map/mixed.yaml") == as_lists(asdict(MapSettings()))
    assert conf("task/default.yaml") == as_lists(asdict(TaskSettings()))
    assert conf("train.yaml")["network"] == asdict(NetworkSettings())
    learner = conf("train.yaml")["learner"]
    assert {name: learner[name] for name in asdict(LossSettings())} == asdict(LossSettings())
    assert learner["mirror"] == LearnerSettings.mirror
    assert conf("export.yaml")["num_quantiles"] == NUM_REPORTED_QUANTILES


def test_every_map_set_gives_every_setting() -> None:
    of_files = {"file.yaml": FileMapSettings(path="a.yaml"), "barn.yaml": BarnMapSettings("barn", path="worlds")}
    for path in sorted((CONF_DIR / "map").glob("*.yaml")):
        values = conf(f"map/{path.name}")
        if path.name in of_files:
            assert values == as_lists(asdict(of_files[path.name])) | {"path": None}, path.name
        elif path.name == "varied.yaml":
            assert not values  # it is made of others
        else:
            assert list(values) == list(asdict(MapSettings())), path.name
            MapSettings(**values)


def test_every_measure_has_its_file_with_the_range_of_the_code() -> None:
    files = {path.stem: conf(f"algo/distortion/{path.name}") for path in (CONF_DIR / "algo/distortion").glob("*.yaml")}
    assert {values["name"] for values in files.values()} == set(MEASURES)
    for values in files.values():
        measure = MEASURES[values["name"]]()  # type: ignore[call-arg]
        assert (values["low"], values["high"]) == (measure.low, measure.high)
        assert all(beta in measure.domain for beta in values["evaluation_betas"])


def test_every_sensor_has_its_file() -> None:
    assert {conf(f"sensor/{path.name}")["name"] for path in (CONF_DIR / "sensor").glob("*.yaml")} == SENSORS
    assert {path.stem for path in (CONF_DIR / "sensor").glob("*.yaml")} == SENSORS
