"""No key without effect: every field of every section of the config is read by something that uses it.

It trains and evaluates, so it has a file of its own: those that only compose configs need not wait for it.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from types import FrameType
from typing import Any, get_args, get_type_hints

import pytest
from world_files import room, write_map_server

from rcdsac_trl.config.evaluation_settings import EvaluationSettings
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.rollout.make_agent import make_actor
from rcdsac_trl.rollout.make_collector import make_episodes
from rcdsac_trl.world.task.world_settings import WorldSettings
from tiny import evaluate, tiny_settings, tiny_trainer

# Read by __post_init__ alone, because all it is for is to be refused; and decided upon before settings are made.
ONLY_CHECKED = {("MapSettings", "version"), ("TaskSettings", "version"), ("TrainingSettings", "resume")}
PLUMBING = {"__post_init__", "__eq__", "__hash__", "__repr__", "_asdict_inner"}
# What checks work out first, and everybody else then takes as it was kept.
KEPT = {"outline", "circumradius_m", "inradius_m", "mask"}


@dataclass(frozen=True)
class Reads:
    """Which fields of which settings were read, other than to check, compare or show them."""

    seen: set[tuple[str, str]]

    def watch(self, cls: type, patch: pytest.MonkeyPatch) -> None:
        names = {field.name for field in fields(cls)}
        original = cls.__getattribute__

        def getattribute(instance: Any, name: str) -> Any:
            if name in names and (cls.__name__, name) not in self.seen and not plumbing(sys._getframe(1)):
                self.seen.add((cls.__name__, name))
            return original(instance, name)

        patch.setattr(cls, "__getattribute__", getattribute)


def plumbing(frame: FrameType | None) -> bool:
    """Tell whether a read is a part of a dataclass's own doing, however deep below."""
    while frame is not None:
        if frame.f_code.co_name in PLUMBING | KEPT:
            return frame.f_code.co_name in PLUMBING
        frame = frame.f_back
    return False


def sections_of(cls: type) -> Iterator[type]:
    """Yield a settings class and all below it."""
    yield cls
    for hint in get_type_hints(cls).values():
        for option in (hint, *get_args(hint)):
            if is_dataclass(option) and isinstance(option, type):
                yield from sections_of(option)


def test_no_key_that_nothing_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every field of every section is read by something that is not its own check.

    That every key is a field, and every field a key, is what composing and reading all choices shows.
    """
    classes = {*sections_of(TrainingSettings), *sections_of(EvaluationSettings), WorldSettings}
    reads = Reads(set())
    for cls in classes:
        reads.watch(cls, monkeypatch)
    monkeypatch.chdir(tmp_path)
    # Together these rows, and a world with one of everything, use every part there is.
    world = ["map.clutter_per_m2=0.05", "map.mapped_fraction=0.5", "map.layouts=[mixed]", "map.num_movers=1"]
    for row, collector in (("rcdsac_pow", "multi"), ("dsac_cvar", "single"), ("rcwr", "multi")):
        tiny_trainer(
            tmp_path / row,
            row,
            f"collector={collector}",
            *world,
            "schedule.iterations=1",
            "schedule.neutral_iterations=0",
            "learner.max_grad_norm=1.0",
        ).run()
    # What would start processes on other machines is told all that is chosen of them.
    monkeypatch.setattr("rcdsac_trl.rollout.ray_workers.RayWorkers", lambda *_, **__: None)
    settings = tiny_settings("sac", "collector=ray", "collector.num_processes=2", "collector.address=auto")
    make_episodes(settings, make_actor(settings), "cpu")
    evaluate(f"run={tmp_path / 'rcdsac_pow'}", "beta=[-1]")
    turned = "beta_controller=[clearance,tail_variance]"
    evaluate(f"run={tmp_path / 'rcdsac_pow'}", "beta=[-2,-1]", turned, "record=true", "out=turned")
    evaluate(f"run={tmp_path / 'rcwr'}", "collision_weight=[1]", "acting.num_candidates=4", "out=out")
    evaluate("baseline=pursuit", "map=easy", "sensor=full", "task=default", "task.episode_steps=5", "robot=jackal")
    write_map_server(tmp_path / "a.yaml", room(80, 80))
    (tmp_path / "b.map").write_text("type octile\nheight 9\nwidth 9\nmap\n" + 9 * (9 * "." + "\n"))
    more = ["map.unmapped_clutter_per_m2=0.02", "map.num_movers=1", "task.episode_steps=5"]
    evaluate("baseline=pursuit", "map=file", "map.path=[a.yaml,b.map]", *more, "out=file")
    guarded = ["task.stop_zone_share=1", "task.episode_steps=5"]
    evaluate("baseline=pursuit", "map=varied", *guarded, "out=varied")
    every = {(cls.__name__, field.name) for cls in classes for field in fields(cls)}
    assert every - reads.seen == ONLY_CHECKED
