"""Agents by name: where they are looked for, which comes first, and what is said where one is missing."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

import rcdsac_trl
from rcdsac_trl.config.paths import CONF_DIR
from rcdsac_trl.deploy import find_weights, shipped_names
from rcdsac_trl.deploy.policy import registry
from rcdsac_trl.deploy.policy.registry import (
    HANDFUL,
    TABLE_ROWS,
    agent_name,
    is_shipped,
    places,
    rebuilding_command,
    table_names,
)
from rcdsac_trl.deploy.policy.weights import packed
from rcdsac_trl.errors import UserInputError
from robots import AHEAD, OPEN, STANDING, agent

ROOT = Path(__file__).resolve().parents[2]


def written(folder: Path, seed: int = 0) -> Path:
    folder.mkdir(parents=True)
    for name, content in packed(agent(seed)).items():
        (folder / name).write_bytes(content)
    return folder


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package without any agents but those of this folder."""
    place = tmp_path / "own"
    place.mkdir()
    monkeypatch.setattr(registry, "_OWN_PLACES", (place, tmp_path / "nowhere"))
    return place


def test_a_folder_of_the_user_comes_before_the_package_s(
    own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert (places(), shipped_names()) == ((own,), [])
    mild = written(own / "mild")
    written(own / "bold")
    assert shipped_names() == ["bold", "mild"]
    assert find_weights("mild") == mild
    mine = tmp_path / "mine"
    bold = written(mine / "bold", seed=1)
    monkeypatch.setenv("RCDSAC_TRL_WEIGHTS", str(mine))
    assert shipped_names() == ["bold", "mild"]
    assert (find_weights("bold"), find_weights("mild")) == (bold, mild)
    assert is_shipped(bold)
    assert not is_shipped(tmp_path)
    drives = [rcdsac_trl.load(which, guard=None).act(OPEN, AHEAD, STANDING).wanted for which in ("bold", bold, mild)]
    assert drives[0] == drives[1] != drives[2]
    monkeypatch.setenv("RCDSAC_TRL_WEIGHTS", str(mine / "bold" / "config.json"))
    with pytest.raises(UserInputError, match=r"^RCDSAC_TRL_WEIGHTS=.*config\.json is no folder: .* or unset it$"):
        find_weights("bold")
    monkeypatch.setenv("RCDSAC_TRL_WEIGHTS", "")
    assert find_weights("bold") == own / "bold"


def test_a_folder_is_one_whatever_it_is_called(own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written(own / "bold")
    monkeypatch.chdir(tmp_path)
    here = written(tmp_path / "bold", seed=1)
    assert find_weights("bold").resolve() == here
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserInputError, match=r"^empty holds neither checkpoints nor config\.json: .* agents` lists"):
        find_weights("empty")


def test_what_is_missing_is_named_with_the_nearest_or_the_way_to_it(own: Path) -> None:
    written(own / "bold")
    with pytest.raises(UserInputError, match=r"^there is no agent 'bald': did you mean bold\? .* lists what there is"):
        find_weights("bald")
    with pytest.raises(UserInputError, match=r"^there is no agent 'dsac_pow-narrow': did you mean rcdsac_pow-narrow\?"):
        find_weights("dsac_pow-narrow")
    with pytest.raises(UserInputError, match=r"^there is no agent 'quick': `.*agents` lists"):
        find_weights("quick")
    written(own / "rcdsac_pow-narrow")  # of two that are as near the one that is there
    with pytest.raises(UserInputError, match=r"^there is no agent 'rcdsac_pow': did you mean rcdsac_pow-narrow\?"):
        find_weights("rcdsac_pow")
    for name in ("sac-sparse", "sac-narrow", "rcdsac_pow-sparse", "rcdsac_pow_wide-narrow"):
        written(own / name)
    for typed, meant in {
        "rcdsac_pow": "rcdsac_pow-narrow",
        "sac": "sac-narrow",
        "rcdsac_cv": "rcdsac_cvar-narrow",
    }.items():
        with pytest.raises(UserInputError, match=rf"^there is no agent '{typed}': did you mean {meant}\?"):
            find_weights(typed)
    # Who takes no run folder offers none.
    with pytest.raises(UserInputError, match=r"^there is no agent 'quick': .*; or name a folder that `export` wrote$"):
        find_weights("quick", takes_runs=False)
    with pytest.raises(UserInputError, match=r"own holds no config\.json: .*; or name a folder that `export` wrote$"):
        find_weights(own, takes_runs=False)
    with pytest.raises(UserInputError) as raised:
        find_weights("dsac_pow_-2-sparse")
    assert f"agent dsac_pow_-2-sparse is not here (looked into {own})" in str(raised.value)
    assert "let RCDSAC_TRL_WEIGHTS name the folder weights/ of a checkout" in str(raised.value)
    trained = "-m +experiment=table preset=laptop sensor=sparse seed=0 experiment.only=[dsac_pow_-2]"
    assert str(raised.value).endswith(f"or train it, python -m rcdsac_trl.train {trained}")


@pytest.mark.parametrize(("given", "kind"), [(None, "NoneType"), (3, "int"), (["sac-narrow"], "list")])
def test_what_names_nothing_is_no_agent(given: object, kind: str) -> None:
    with pytest.raises(UserInputError, match=f"^an agent is no {kind}: give its name, such as 'rcdsac_pow-narrow', or"):
        rcdsac_trl.load(given)  # type: ignore[arg-type]


@pytest.mark.parametrize("package", ["safetensors", "numba"])
def test_a_package_that_a_robot_lacks_is_named_with_how_to_get_it(package: str) -> None:
    code = f"import sys; sys.modules[{package!r}] = None; import rcdsac_trl; rcdsac_trl.load('rcdsac_pow-narrow')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr.splitlines()[-1] == (
        f"rcdsac_trl.errors.UserInputError: {package} is not installed: shipped and exported agents need `pip install "
        "numpy safetensors numba`, a run folder all that rcdsac-trl depends on"
    )


def test_the_table_and_the_wheel_have_the_agents_that_are_named() -> None:
    assert list(yaml.safe_load((CONF_DIR / "experiment" / "table.yaml").read_text())["runs"]) == list(TABLE_ROWS)
    assert len(table_names()) == len(set(table_names())) == 20
    assert set(HANDFUL) <= set(table_names())
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]
    carried = {source: target for source, target in wheel["wheel"]["force-include"].items() if source != "conf"}
    assert carried == {f"weights/{name}": f"rcdsac_trl/weights/{name}" for name in HANDFUL}
    assert set(carried) <= set(wheel["sdist"]["include"])


def test_an_agent_of_the_table_is_called_as_its_run_is() -> None:
    """So that the name says how to train it."""
    for row in TABLE_ROWS:
        overrides = yaml.safe_load((CONF_DIR / "experiment" / "table.yaml").read_text())["runs"][row]
        values = dict(override.lstrip("+").split("=") for override in overrides)
        beta = float(values["algo.beta"]) if "algo.beta" in values else None
        assert agent_name(values["algo"], beta, "narrow") == f"{row}-narrow"
        assert f"only=[{row}]" in rebuilding_command(f"{row}-narrow")
