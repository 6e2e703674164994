"""The documents are true: their Python runs, their commands are accepted, what they name exists."""

import itertools
import json
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import pandas as pd
import pytest
from omegaconf import OmegaConf

from rcdsac_trl import draw_maps
from rcdsac_trl.agent.risk import MEASURES
from rcdsac_trl.config.command_line import with_names
from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.evaluation_settings import EvaluationSettings
from rcdsac_trl.config.named_folder import default_training
from rcdsac_trl.config.paths import CONF_DIR
from rcdsac_trl.config.run_config import read_config
from rcdsac_trl.config.verbs import VERBS
from rcdsac_trl.experiments.optuna_search import make_search
from rcdsac_trl.experiments.sweep_jobs import make_sweep
from rcdsac_trl.report.read import Episodes
from rcdsac_trl.training.setup import check_training
from tiny import SMALL, first_combinations_only

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
# Those of docs/reference are made by `make docs`.
PAGES = (path for path in DOCS.rglob("*.md") if DOCS / "reference" not in path.parents)
DOCUMENTS = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES])
# How a command begins, its verb first.
COMMAND = r"(?:python -m rcdsac_trl\.|rcdsac-trl )"
# The files that pages have their reader write, with their text: their commands name them.
WRITTEN = r"^Save this as `([^`]+)`:\n\n```\w+\n(.*?)^```"
# The file that CONTRIBUTING.md has its reader write.
NEW_ROW = "rcdsac_wang"


def texts(pattern: str) -> list[tuple[str, Any]]:
    """Return document and text, or texts, of everything the pattern finds."""
    return [
        (path.relative_to(ROOT).as_posix(), found)
        for path in DOCUMENTS
        for found in re.findall(pattern, path.read_text(), re.M | re.S)
    ]


def write_files(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the folder the current one, with the files in it that a reader has by then."""
    monkeypatch.chdir(folder)
    for _, (path, text) in texts(WRITTEN):
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_text(text)


@pytest.mark.parametrize(("name", "code"), texts(r"^```python\n(.*?)^```"))
def test_python_runs(name: str, code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_files(tmp_path, monkeypatch)
    monkeypatch.syspath_prepend(tmp_path)
    # What a page trains for a rehearsal is here as small as a training gets.
    code = code.replace('"preset=smoke"', ", ".join(map(repr, SMALL)))
    with mock.patch.dict(MEASURES):  # a measure that an example registers is its own
        exec(compile(code, name, "exec"), {"__name__": "__main__"})


def test_the_reward_term_of_contributing_needs_one_file(tmp_path: Path) -> None:
    """Write what the example says into a copy of the package, and drive: number of parts and sum follow."""
    section = re.search(r"^## Add a reward term$(.*?)^## ", (ROOT / "CONTRIBUTING.md").read_text("utf-8"), re.M | re.S)
    assert section is not None
    added, names, part, parts, total = re.findall(r"^    (\S.*)$", section[1], re.M)
    copy = tmp_path / "rcdsac_trl"
    # With what numba has compiled of the same files: the rules are not compiled, nor is what calls them.
    shutil.copytree(ROOT / "src" / "rcdsac_trl", copy, ignore=shutil.ignore_patterns("weights"))
    (copy / "conf").symlink_to(CONF_DIR)
    rules = copy / "world" / "task" / "rules.py"
    text = rules.read_text("utf-8")
    for start, new in (
        ("REWARD_COMPONENTS = ", f"{added}\n{names}"),
        ("    return BASE_REWARD, ", f"    {part}\n    {parts}"),
        ("    return r[", f"    {total}"),
    ):
        text, number = re.subn(rf"^{re.escape(start)}.*$", lambda _, new=new: new, text, flags=re.M)
        assert number == 1, start
    rules.write_text(text, "utf-8")
    program = (
        "import torch\n"
        "from rcdsac_trl.world.task.env import make_env\n"
        "env = make_env(num_workers=0)\n"
        "after = env.rollout(3, lambda td: td.set('action', torch.tensor([1.0, 0.5]).expand(10, 2)))['next']\n"
        "parts = after['reward_components']\n"
        "base, goal, waypoint, angular, collision, calm = parts.unbind(-1)\n"
        "assert torch.allclose(calm, torch.tensor(0.025))\n"
        "assert torch.allclose(after['reward'][..., 0], base + goal + waypoint * angular + collision + calm)\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_tables_of_agents_are_what_was_measured() -> None:
    """`make tables` would change nothing; and there is something that it could change."""
    tables = runpy.run_path(str(ROOT / "docs" / "tables.py"))
    readme = (ROOT / "README.md").read_text("utf-8")
    assert "<!-- agents: " in readme
    for document in tables["DOCUMENTS"]:
        text = document.read_text("utf-8")
        assert tables["renewed"](text) == text, f"{document.name}: make tables"
    first = json.loads((ROOT / "weights" / "sac-narrow" / "measured.json").read_text())["conditions"][0]["metrics"]
    collisions = first["collisions"]
    assert f"| SAC | {collisions['mean']:.2f} [{collisions['low']:.2f}, {collisions['high']:.2f}] | " in readme
    assert tables["renewed"](readme.replace("| SAC | ", "| SAC | 9")) == readme
    rows = tables["table_of"](["rcdsac_cvar-narrow:1,0.1", "mppi-narrow"]).splitlines()[2:]
    assert [row.split(" | ")[0] for row in rows] == [
        *(f"| RC-DSAC (resample) CVaR β = {beta}" for beta in ("1", "0.1")),
        "| MPPI",
    ]
    measured = tables["accelerator_table"]({"device": "cuda", "laptop": {"plain_updates_per_second": 123.456}})
    assert measured.splitlines()[-1] == "| laptop | plain updates per second | 123.5 |"


def test_the_table_of_seeds_is_what_all_trainings_drove() -> None:
    table = runpy.run_path(str(ROOT / "docs" / "tables.py"))["table_of_seeds"]
    # Two trainings differ by 0.2 collisions and 20 of reward, two others not: variances 0.02 and 200, halved.
    driven = [("rcwr", 0, 0.1, 500), ("rcwr", 1, 0.3, 520), ("sac", 0, 0.5, 530), ("sac", 1, 0.5, 530)]
    rows = [(*driven[0][:2], 2.0, *driven[0][2:]), *((agent, seed, 1.0, *of) for agent, seed, *of in driven)]
    columns = ["agent", "train_seed", "collision_weight", "collisions", "reward"]
    told = {"sensor": "narrow", "beta": None, "beta_controller": None, "measure": None, "helped": "", "map": 0}
    told |= {"trained": True, "weights": None}
    episodes = pd.DataFrame(rows, columns=columns).assign(**told, episode=0)
    protocol = {"num_maps": 1, "num_episodes": 1}
    agents = [Episodes(rows, protocol, pd.DataFrame()) for _, rows in episodes.groupby("agent")]
    assert table(agents).splitlines() == [  # of w_coll = 2, which one training drove alone, nothing is shown
        "| agent | seed 0 | seed 1 | mean |",
        "|---|---|---|---|",
        "| RCWR w_coll = 1 | 0.10 / 500 | 0.30 / 520 | 0.20 / 510 |",
        "| SAC w_coll = 1 | 0.50 / 530 | 0.50 / 530 | 0.50 / 530 |",
        "| standard deviation, one training to another |  |  | 0.10 / 10 |",
    ]


def test_tables_beside_the_paper_are_over_all_trainings() -> None:
    """SAC's two trainings have 0.1 and 0.3 on every map, MPPI 0.5: t of one degree of freedom is 12.7."""
    tables = runpy.run_path(str(ROOT / "docs" / "tables.py"))
    driven = [("sac", 0, 0.1), ("sac", 1, 0.3), ("mppi", 0, 0.5)]
    rows = [(agent, seed, map_, collisions, 500.0) for agent, seed, collisions in driven for map_ in (0, 1)]
    told = {"sensor": "narrow", "beta": None, "collision_weight": None, "beta_controller": None, "measure": None}
    table = pd.DataFrame(rows, columns=["agent", "train_seed", "map", "collisions", "reward"]).assign(
        **told, helped="", weights=None, episode=0
    )
    table = table.assign(trained=table["agent"] == "sac").astype({"beta": float, "collision_weight": float})
    episodes = Episodes(table, {"num_maps": 2, "num_episodes": 1}, pd.DataFrame())
    assert tables["table_of_differences"](episodes, ["narrow", "sac", "from", "mppi"]).splitlines() == [
        "| agent | collisions, from MPPI | reward, from MPPI |",
        "|---|---|---|",
        "| SAC | -0.30 [-1.56, 0.96] | 0 [0, 0] |",
    ]
    beside = tables["table_beside_the_paper"](episodes, "narrow").splitlines()
    assert beside[0].startswith(
        "| agent | risk measure | β or weight | collisions | collisions, 95 % | collisions, paper |"
    )
    assert beside[2].startswith("| SAC |  |  | 0.20 ± 0.10 | [0.00, 1.46] | 1.76 ± 2.02 |")


def test_averages_are_over_what_the_paper_averages_and_all_trainings() -> None:
    """CVaR at 0.25 and 0.75 has 0.1 and 0.3 collisions, the power law 0.2, all 0.1 more in a second training; MPPI 0.5.

    At 0.5 CVaR has 9, which does not count. A measure's two trainings have a variance of 0.005, their mean half of it,
    the mean of both measures a quarter: 0.035 squared, and t of two degrees of freedom is 4.30.
    """
    table_of = runpy.run_path(str(ROOT / "docs" / "tables.py"))["table_of_averages"]
    betas = {0.25: 0.1, 0.5: 9.0, 0.75: 0.3}
    rows = [("rcdsac_cvar", seed, beta, value + 0.1 * seed) for seed in (0, 1) for beta, value in betas.items()]
    rows += [("rcdsac_pow", seed, beta, 0.2 + 0.1 * seed) for seed in (0, 1) for beta in (-2.0, -1.0)]
    rows.append(("mppi", 0, float("nan"), 0.5))
    driven = [(agent, seed, beta, map_, value, 500.0) for agent, seed, beta, value in rows for map_ in (0, 1)]
    table = pd.DataFrame(driven, columns=["agent", "train_seed", "beta", "map", "collisions", "reward"])
    told = {"sensor": "narrow", "collision_weight": None, "beta_controller": None, "measure": None}
    table = table.assign(**told, helped="", weights=None, episode=0, trained=table["agent"] != "mppi")
    episodes = Episodes(table.astype({"collision_weight": float}), {"num_maps": 2, "num_episodes": 1}, pd.DataFrame())
    lines = table_of(episodes, ["narrow"]).splitlines()
    assert lines[2] == "| RC-DSAC (resample) | 0.25 / 500 (2) |  |"
    name, means, more = (cell.strip() for cell in lines[3].strip("|").split("|"))
    assert (name, means) == ("MPPI", "0.50 / 500")
    assert more == "-0.25 [-0.40, -0.10], 0 [0, 0]"


def test_the_table_of_the_course_is_what_was_driven(tmp_path: Path) -> None:
    table = runpy.run_path(str(ROOT / "docs" / "tables.py"))["table_of_course"]
    assert table(tmp_path) == "Not driven yet.\n"
    columns = "run,agent,beta,direction,repetition,finished,time_s,collisions"
    driven = ["forward,0,True,110.0,1", "forward,1,False,300.0,4", "reverse,0,True,97.0,0", "reverse,1,True,99.0,0"]
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "runs.csv").write_text("\n".join([columns, *(f"a,rcdsac_pow,-2,{run}" for run in driven)]))
    # The paper's single runs: 0 collisions in 110 and 116 s.
    cells = "RC-DSAC pow | -2 | 1 of 2 | 2.5 ± 1.5 (0) | 110 ± 0 (110) | 2 of 2 | 0.0 ± 0.0 (0) | 98 ± 1 (116)"
    assert table(tmp_path).splitlines()[2] == f"| {cells} |"


def test_the_table_of_disturbances_is_what_was_driven() -> None:
    table = runpy.run_path(str(ROOT / "docs" / "tables.py"))["table_of_disturbances"]
    columns = ["disturbance", "map", "episode", "collisions", "reward"]
    # One more on either map: so it is in every resample.
    driven = [("none", 0, 0, 1, 500), ("none", 1, 0, 2, 400), ("delay", 0, 0, 2, 300), ("delay", 1, 0, 3, 400)]
    fewer = [("none", 0, 0, 3, 500), ("delay", 0, 0, 1, 500)]
    lines = table({"a": pd.DataFrame(driven, columns=columns), "b": pd.DataFrame(fewer, columns=columns)}).splitlines()
    assert lines[2:] == [
        "| none | 1.50 / 450 |  | 3.00 / 500 |  |",
        "| delay | 2.50 / 350 | +1.00 [+1.00, +1.00] | 1.00 / 500 | -2.00 [-2.00, -2.00] |",
    ]


def test_disturbances_change_the_world() -> None:
    disturbances = runpy.run_path(str(ROOT / "docs" / "disturbances.py"))["DISTURBANCES"]

    def world(changes: Sequence[str]) -> object:
        settings = read_config(compose("evaluate", ["baseline=mppi", *changes]), EvaluationSettings)
        return settings.world_of(default_training())

    worlds = {name: world(changes) for name, changes in disturbances.items()}
    assert worlds["none"] == world([])
    assert all(first != second for first, second in itertools.combinations(worlds.values(), 2))


def commands() -> list[tuple[str, str]]:
    """Return verb and overrides of every command that names no folder of the reader's."""
    found = {text.split("#")[0].strip() for _, text in texts(rf"{COMMAND}(\w[^\n`]+)") if "<" not in text}
    return sorted((verb, rest) for verb, _, rest in (text.partition(" ") for text in found) if rest)


@pytest.mark.parametrize(("verb", "arguments"), commands())
def test_commands_are_accepted(verb: str, arguments: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_files(tmp_path, monkeypatch)
    overrides = shlex.split(arguments)
    if verb == "search":
        make_search(overrides)
        return
    if "-m" in overrides:  # of each named run its first combination stands for the others
        first_combinations_only(monkeypatch)
        make_sweep([override for override in overrides if override != "-m"])
        return
    if verb in ("agents", "verify"):
        overrides = with_names("agents", overrides)
    overrides = [override.replace(NEW_ROW, "rcdsac_pow") for override in overrides]
    cfg = compose(verb, overrides)
    if verb == "train":
        check_training(cfg)
    elif verb == "draw_maps":
        draw_maps.main.check(cfg)


def test_there_are_commands_of_every_verb() -> None:
    verbs = {text.split()[0] for _, text in texts(rf"{COMMAND}(\w+ [^\n`]+)")}
    assert verbs == set(VERBS)


def anchors(page: Path) -> set[str]:
    """Return the names that GitHub gives a page's headings."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.M)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize(("name", "link"), texts(r"\]\((?!https?:)([^)]+)\)"))
def test_links_lead_somewhere(name: str, link: str) -> None:
    target, _, anchor = link.partition("#")
    page = (ROOT / name).parent / target if target else ROOT / name
    assert page.is_file()
    assert not anchor or anchor in anchors(page)


def test_named_files_exist() -> None:
    for name, path in texts(
        r"`((?:system|robot|world|agent|deploy|config|storage|rollout|release|training|evaluation|experiments|playground|report|tests|conf|docs)/[\w/.*-]+)`"
    ):
        places = (ROOT, ROOT / "src" / "rcdsac_trl")
        exists = any(list(place.glob(path.rstrip("/"))) for place in places)
        assert exists or path == f"conf/algo/{NEW_ROW}.yaml", f"{name} names {path}"


def test_named_keys_exist() -> None:
    cfg = compose("train", ["+algo=rcdsac_pow"])
    of_files = OmegaConf.load(CONF_DIR / "map" / "file.yaml")
    sections = "|".join(section for section in cfg if OmegaConf.is_dict(cfg[section]))
    named = texts(rf"`((?:{sections})\.[a-z_.]+)`")
    assert len(named) > 20
    for name, key in named:
        section, _, last = key.rpartition(".")
        known = [*OmegaConf.select(cfg, section), *(of_files if section == "map" else ())]
        assert last in known, f"{name} names {key}"


def test_every_row_and_choice_is_named() -> None:
    running = (DOCS / "running.md").read_text()
    for group in (
        "algo",
        "algo/distortion",
        "preset",
        "robot",
        "sensor",
        "map",
        "task",
        "logger",
        "experiment",
        "launcher",
    ):
        for path in (CONF_DIR / group).glob("*.yaml"):
            assert f"`{path.stem}`" in running, f"{group}={path.stem}"
