"""What is said of the package as a whole: versions, citation, and what a loaded agent says it is."""

import re
import tomllib
from importlib.metadata import requires
from pathlib import Path

import pytest
import yaml

import rcdsac_trl
from rcdsac_trl.deploy import Policy, find_weights, shipped_names
from rcdsac_trl.deploy.policy.registry import HANDFUL
from rcdsac_trl.deploy.policy.weights import FORMAT_VERSION, card_of, read_weights
from rcdsac_trl.world.maps.generator import GENERATOR_VERSION
from rcdsac_trl.world.task.rules import RULES_VERSION
from robots import ROWS, agent

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def changelog_section(begins: str) -> str:
    """Return what the changelog says of one of the versions."""
    found = re.search(rf"^\*\*{begins}\*\*.*?(?=^\*\*|^## )", (ROOT / "CHANGELOG.md").read_text(), re.M | re.S)
    assert found is not None
    return found[0]


def test_the_changelog_names_every_version() -> None:
    assert f"writes {FORMAT_VERSION}" in changelog_section("Weights")
    formats = re.findall(r"^\| (\d) \|", changelog_section("Weights"), re.M)
    assert formats == [str(number + 1) for number in range(FORMAT_VERSION)]
    assert f"(`map.version`): {GENERATOR_VERSION}." in changelog_section("Maps")
    rules = re.findall(r"^\| (\d) \|", changelog_section("Rules"), re.M)
    assert rules == [str(number + 1) for number in range(RULES_VERSION)]
    assert rcdsac_trl.__version__ in (ROOT / "CHANGELOG.md").read_text()


def test_the_citation_is_of_this_version_and_of_the_paper() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors", "type"} <= set(cited)
    assert (cited["version"], cited["license"]) == (rcdsac_trl.__version__, PROJECT["license"])
    assert cited["authors"] == PROJECT["authors"]
    (paper,) = cited["references"]
    assert [author["family-names"] for author in paper["authors"]] == ["Choi", "Dance", "Kim", "Hwang", "Park"]


def test_extras_that_are_named_exist() -> None:
    """Installed from the checkout or the wheel, `pip install 'rcdsac-trl[x]'` takes the extra of what is there."""
    files = [
        *(ROOT / "src").rglob("*.py"),
        *(ROOT / "conf").rglob("*.yaml"),
        *ROOT.glob("*.md"),
        *ROOT.glob("docs/**/*.md"),
    ]
    named = {name for path in files for name in re.findall(r"rcdsac-trl\[(\w+)\]", path.read_text())}
    assert named
    assert named <= set(PROJECT["optional-dependencies"])
    assert requires("rcdsac-trl")


# ------------------------------------------------------------------------------------------------ what an agent says
@pytest.mark.parametrize("name", shipped_names())
def test_a_shipped_agent_says_how_it_drives(name: str) -> None:
    weights = read_weights(find_weights(name))
    measured = weights.measured
    assert measured is not None
    card = (find_weights(name) / "README.md").read_text()
    assert card == card_of(weights, measured), "make tables writes it anew"
    for condition in measured.conditions:
        (line,) = [line for line in card.splitlines() if line.startswith(f"| {condition.label} | ")][:1]
        assert f"| {condition.metrics['collisions'].mean:.2f} [" in line
        assert f"| {condition.metrics['reward'].mean:.0f} [" in line


def test_what_a_newcomer_needs_is_there() -> None:
    assert set(HANDFUL) <= set(shipped_names())


def test_what_a_policy_is_in_a_line() -> None:
    assert repr(rcdsac_trl.load("rcdsac_pow-narrow")) == (
        "Policy(rcdsac_pow, sensor narrow, remembers 12 s, beta in [-2, 0], robot paper, chooses among 32 actions, "
        "an episode: collisions 0.24 to 0.31, reward 545 to 556)"
    )
    assert repr(rcdsac_trl.load("sac-narrow")) == (
        "Policy(sac, sensor narrow, remembers 12 s, robot paper, chooses among 32 actions, "
        "an episode: collisions 0.25, reward 569)"
    )
    said = {name: repr(Policy(agent(**changes))) for name, changes in ROWS.items()}
    assert said["dsac_pow"] == "Policy(dsac_pow, sensor narrow, for beta=-1 alone, robot paper)"
    assert said["rcwr"] == "Policy(rcwr, sensor narrow, collision_weight in [0.1, 2], robot paper)"
    remembering = repr(Policy(agent(memory_s=12.0, sensor="full")))
    assert remembering == "Policy(rcdsac_pow, sensor full, remembers 12 s, beta in [-2, 0], robot paper)"
