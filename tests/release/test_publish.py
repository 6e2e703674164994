"""Shipped agents: half precision, a card that quotes the evaluation, tables a report reads, and refusals."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import rcdsac_trl
from rcdsac_trl.config.compose import compose
from rcdsac_trl.deploy.policy.weights import halved, packed, read_weights
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.release.publication import make_publication
from rcdsac_trl.report.card import driving_section
from rcdsac_trl.report.learning import validation_of_runs
from rcdsac_trl.report.read import read_episodes
from robots import AHEAD, OPEN, STANDING, agent
from tiny import evaluate


@pytest.fixture(scope="module")
def evaluated(tiny_run: Path) -> Path:
    evaluate(f"run={tiny_run}", "beta=[-2,-1]", "checkpoint=last")
    return tiny_run


def publish(evaluated: Path, folder: Path) -> None:
    given = [f"runs=[{evaluated}]", f"weights={folder / 'weights'}", f"results={folder / 'results'}"]
    make_publication(compose("publish", given)).run(driving_section)


def test_half_precision_is_read_as_single(tmp_path: Path) -> None:
    weights = agent()
    for name, content in packed(weights, half=True).items():
        (tmp_path / name).write_bytes(content)
    read = read_weights(tmp_path)
    small = halved(weights)
    for name, tensor in weights.tensors.items():
        assert read.tensors[name].dtype == np.float32
        assert np.array_equal(read.tensors[name], tensor.astype(np.float16).astype(np.float32))
        assert np.array_equal(read.tensors[name], small.tensors[name])
    big = dict(weights.tensors)
    big["actor.head.output.bias"] = np.full_like(big["actor.head.output.bias"], 1e6)
    with pytest.raises(UserInputError, match="not finite"):
        halved(type(weights)(weights.config, big))


def test_what_is_published_drives_and_is_reported_on(
    evaluated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    publish(evaluated, tmp_path)
    assert capsys.readouterr().out.startswith("rcdsac_pow-narrow: ")
    folder = tmp_path / "weights" / "rcdsac_pow-narrow"
    written = {"README.md", "config.json", "training.yaml", "weights.safetensors"}
    assert {path.name for path in folder.iterdir()} == written
    command = rcdsac_trl.load(folder, guard=None).act(OPEN, AHEAD, STANDING, -1.0)
    full = rcdsac_trl.load(evaluated, guard=None).act(OPEN, AHEAD, STANDING, -1.0)
    assert command.wanted == pytest.approx(full.wanted, abs=0.01)
    results = tmp_path / "results" / "rcdsac_pow-narrow"
    episodes = read_episodes([results])
    assert len(episodes.table) == 4
    assert list(validation_of_runs([results])) == ["rcdsac_pow-narrow"]
    # The card's numbers are the evaluation's.
    card = (folder / "README.md").read_text()
    mean = episodes.table.loc[episodes.table["beta"] == -2.0, "collisions"].mean()
    (line,) = [line for line in card.splitlines() if "β = -2" in line]
    assert f"| {mean:.2f} [" in line
    assert "\n\n## Limits\n\n" in card
    assert "\n\n\n" not in card
    assert not pd.read_csv(results / "training_episodes.csv").empty


def test_nothing_is_published_twice_or_without_its_evaluation(evaluated: Path, tmp_path: Path) -> None:
    publish(evaluated, tmp_path)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    with pytest.raises(UserInputError, match="rcdsac_pow-narrow exists: remove it"):
        publish(evaluated, tmp_path)
    with pytest.raises(UserInputError, match="are both rcdsac_pow-narrow"):
        make_publication(compose("publish", [f"runs=[{evaluated},{evaluated}]"]))
    with pytest.raises(UserInputError, match=r"acts by the best of 6 .* acting.num_candidates=6 acting.spread=1"):
        make_publication(compose("publish", [f"runs=[{evaluated}]", "acting.num_candidates=6"]))
    with pytest.raises(UserInputError, match="no evaluation of its checkpoint best that acts by tanh"):
        make_publication(compose("publish", [f"runs=[{evaluated}]", "checkpoint=best"]))
    with pytest.raises(UserInputError, match=r"sac-narrow is an agent that was exported, .* name the run folder"):
        make_publication(compose("publish", ["runs=[sac-narrow]"]))
    with pytest.raises(UserInputError, match="name what to publish"):
        make_publication(compose("publish", []))
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
