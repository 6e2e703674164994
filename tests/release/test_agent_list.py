"""The list of agents: what is said of each, one that is damaged, and what the table lacks; without torch."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from rcdsac_trl.config.compose import compose
from rcdsac_trl.deploy.policy import registry
from rcdsac_trl.deploy.policy.measured import Estimate, Measured, MeasuredCondition
from rcdsac_trl.deploy.policy.weights import packed, read_weights
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.release.agent_list import AgentList, make_agent_list
from robots import DSAC, RCWR, agent


def measured(digest: str, **betas: tuple[float, float]) -> Measured:
    """Return what is known of an agent: by a beta its mean collisions and reward."""
    conditions = tuple(
        MeasuredCondition(
            label=f"RC-DSAC (resample) pow β = {beta}",
            beta=float(beta),
            collision_weight=None,
            metrics={
                "collisions": Estimate(collisions, collisions - 0.1, collisions + 0.1),
                "reward": Estimate(reward, reward - 10.0, reward + 10.0),
            },
        )
        for beta, (collisions, reward) in betas.items()
    )
    task = {"version": 2, "episode_steps": 1000}
    protocol = {"split": "evaluation", "seed": 0, "num_maps": 50, "num_episodes": 10, "sampled": False, "map": {}}
    return Measured(
        "RC-DSAC (resample) pow", conditions, protocol | {"task": task}, 2, 1, 0.95, 0, digest, True, "c", "again"
    )


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package with three agents, of which one was measured."""
    monkeypatch.setattr(registry, "_OWN_PLACES", (tmp_path,))
    monkeypatch.chdir(tmp_path.parent)
    digest = json.loads(packed(agent())["config.json"])["weights_sha256"]
    known = measured(digest, **{"-2": (0.4, 520.0), "-1": (0.5, 530.0), "-0.5": (0.61, 541.0)})
    for name, files in {
        "rcdsac_pow-narrow": packed(agent(), measured=known),
        "dsac_pow_-1-narrow": packed(agent(**DSAC)),
        "rcwr-sparse": packed(agent(**RCWR | {"sensor": "sparse"})),
    }.items():
        (tmp_path / name).mkdir()
        for file, content in files.items():
            (tmp_path / name / file).write_bytes(content)
    return tmp_path


def listed(*overrides: str) -> AgentList:
    return make_agent_list(compose("agents", list(overrides)))


def test_a_line_says_what_an_agent_is_and_does(place: Path) -> None:
    first, *lines = listed().in_words().splitlines()
    assert first.split() == ["agent", "row", "told", "sensor", "maps/rules", "collisions", "reward", "in"]
    columns = [first.index(name) for name in ("row", "told", "sensor", "in")]
    rows = [[line[column:].split("  ")[0].strip() for column in (0, *columns)] for line in lines[:3]]
    assert rows == [
        ["dsac_pow_-1-narrow", "dsac_pow", "for beta -1", "narrow", place.name],
        ["rcdsac_pow-narrow", "RC-DSAC (resample) pow", "beta -2 to 0", "narrow", place.name],
        ["rcwr-sparse", "rcwr", "w_coll 0.1 to 2", "sparse", place.name],
    ]
    assert "1/2  0.40 / 0.61  520 / 541" in lines[1]
    told = " ".join(listed().in_words().split())
    assert "not here, of the paper's table: rcdsac_cvar-narrow, rcdsac_cvar-sparse, rcdsac_pow-sparse, " in told
    assert not any(f" {name}, " in told for name in ("rcdsac_pow-narrow", "rcwr-sparse"))


def test_one_that_is_damaged_hides_no_other(place: Path) -> None:
    weights = place / "rcwr-sparse" / "weights.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1])
    (place / "dsac_pow_-1-narrow" / "measured.json").write_text("{")
    told = listed().in_words()
    assert "\nrcdsac_pow-narrow " in told
    assert "\nrcwr-sparse cannot be read: " in told
    assert "weights.safetensors is not what config.json says it is" in told
    assert "\ndsac_pow_-1-narrow cannot be read: " in told
    values = json.loads(listed("format=json").in_json())
    assert [entry["name"] for entry in values if "error" in entry] == ["dsac_pow_-1-narrow", "rcwr-sparse"]


def test_numbers_of_other_weights_are_refused(place: Path) -> None:
    folder = place / "rcwr-sparse"
    (folder / "measured.json").write_text((place / "rcdsac_pow-narrow" / "measured.json").read_text())
    with pytest.raises(UserInputError, match=r"measured\.json is of other weights than weights\.safetensors: "):
        read_weights(folder)


def test_programs_get_all_that_is_known(place: Path) -> None:
    (entry,) = json.loads(listed("agents=[rcdsac_pow-narrow]", "format=json").in_json())
    assert entry["folder"] == str(place / "rcdsac_pow-narrow")
    assert entry["config"]["context_range"] == [-2.0, 0.0]
    assert [c["metrics"]["collisions"]["mean"] for c in entry["measured"]["conditions"]] == [0.4, 0.5, 0.61]
    with pytest.raises(UserInputError, match="there is no agent 'rcdsac_pov-narrow': did you mean rcdsac_pow-narrow"):
        listed("agents=[rcdsac_pov-narrow]")


def test_the_list_is_there_without_torch() -> None:
    code = (
        "import sys; sys.argv = ['agents', 'sac-narrow']\n"
        "from rcdsac_trl.agents import main; main()\n"
        "print(sorted({'torch', 'pybullet', 'pandas', 'numba', 'scipy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    assert lines[1].startswith("sac-narrow  SAC ")
    assert lines[-1] == "[]"
