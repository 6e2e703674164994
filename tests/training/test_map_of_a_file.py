"""Training in a building of one's own: the run says which files it was, and goes on in no other."""

import json
import shutil
from pathlib import Path

import pytest
from omegaconf import DictConfig
from world_files import OCCUPIED, room, write_map_server

from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.evaluation_settings import EvaluationSettings
from rcdsac_trl.config.run_config import read_config, settings_of_new_run, settings_of_run
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.training.resume import differing_keys
from rcdsac_trl.training.setup import make_trainer, resume_training
from rcdsac_trl.world.maps.files.file_map import FileMapSettings, read_building
from rcdsac_trl.world.maps.files.map_files import digests
from rcdsac_trl.world.maps.generator import MapSettings
from tiny import SMALL, evaluate, load_progress

# A map set's keys are not a file's.
GIVEN = [override for override in SMALL if not override.startswith("map")]


@pytest.fixture
def buildings(tmp_path: Path) -> Path:
    """A folder of two buildings."""
    folder = tmp_path / "buildings"
    folder.mkdir()
    for name, width in (("a", 120), ("b", 140)):
        write_map_server(folder / f"{name}.yaml", room(100, width))
    return folder


def config(buildings: Path, *given: str) -> DictConfig:
    chosen = ["map=file", f"map.path={buildings}", "map.unmapped_clutter_per_m2=0.05", "map.num_movers=1"]
    return compose("train", ["+algo=rcdsac_pow", *GIVEN, *chosen, *given])


def test_a_run_trains_in_several_buildings_and_goes_on_only_in_the_same(buildings: Path, tmp_path: Path) -> None:
    run, cfg = tmp_path / "run", config(buildings, "schedule.iterations=2")
    trainer = make_trainer(cfg, run, on_iteration_end=lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    noted = settings_of_run(run).map
    assert isinstance(noted, FileMapSettings)
    assert noted.sha256 == digests([buildings / "a.yaml", buildings / "b.yaml"])
    assert len(noted.sha256) == 4
    assert differing_keys(run, cfg) == []
    copied = tmp_path / "copied"
    shutil.copytree(run, copied)
    resumed = resume_training(run)
    assert resumed is not None
    resumed.run()
    assert load_progress(run / "checkpoints", "last").iterations == 2
    # The run drove in both, and is evaluated where it was trained.
    evaluated = json.loads(
        (evaluate(f"run={run}", "beta=[-1]", f"out={tmp_path / 'out'}") / "evaluation.json").read_text()
    )
    assert evaluated["map"]["path"] == str(buildings)
    assert tuple(evaluated["map"]["sha256"]) == noted.sha256

    changed = room(100, 140)
    changed[50, 50] = OCCUPIED
    write_map_server(buildings / "b.yaml", changed)
    read_building.cache_clear()
    for refused in (
        lambda: resume_training(copied),
        lambda: evaluate(f"run={run}", "beta=[-1]", f"out={tmp_path / 'another'}"),
    ):
        with pytest.raises(UserInputError, match=r"b\.pgm had sha256 .*, and now has .*: bring the old file back"):
            refused()


def test_what_cannot_serve_is_refused_before_a_folder_is_made(buildings: Path, tmp_path: Path) -> None:
    write_map_server(buildings / "a.yaml", room(30, 30))
    with pytest.raises(UserInputError, match=r"a\.yaml: the connected floor .* task\.min_path_m=4"):
        make_trainer(config(buildings), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_settings_of_files_are_told_from_those_of_the_generator(buildings: Path) -> None:
    trained = settings_of_new_run(config(buildings))

    def chosen(*given: str) -> object:
        return read_config(compose("evaluate", ["run=a", *given]), EvaluationSettings).world_of(trained).maps

    assert chosen() == trained.map
    assert chosen("map=static") == MapSettings(num_movers=0)
    assert chosen("map.num_movers=0") == FileMapSettings(path=str(buildings), unmapped_clutter_per_m2=0.05)
    other = buildings / "b.yaml"
    assert chosen(f"map.path={other}") == FileMapSettings(path=str(other), unmapped_clutter_per_m2=0.05, num_movers=1)
    with pytest.raises(UserInputError, match=r"there is no key map\.size_m"):
        chosen("map.size_m=10.0", f"map.path={other}")
