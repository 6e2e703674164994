"""Shipped agents: half precision, what was measured, a card made from it, tables a report reads, and refusals."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import rcdsac_trl
from rcdsac_trl.config.compose import compose
from rcdsac_trl.deploy import find_weights
from rcdsac_trl.deploy.policy.registry import HANDFUL
from rcdsac_trl.deploy.policy.weights import Weights, halved, packed, read_weights
from rcdsac_trl.errors import FaultError, UserInputError
from rcdsac_trl.evaluation.calibration import make_calibration
from rcdsac_trl.release.publication import make_publication
from rcdsac_trl.release.rounding import LIMITS, check_rounding, largest_differences
from rcdsac_trl.report.card import measured_values
from rcdsac_trl.report.learning import validation_of_runs
from rcdsac_trl.report.read import read_episodes
from rcdsac_trl.verify import main as verify
from robots import AHEAD, OPEN, RCWR, STANDING, agent
from tiny import evaluate, untrained_run


@pytest.fixture(scope="module")
def evaluated(tiny_run: Path) -> Path:
    evaluate(f"run={tiny_run}", "beta=[-2,-1]", "checkpoint=last")
    return tiny_run


def publish(evaluated: Path, folder: Path, *overrides: str) -> None:
    given = [f"runs=[{evaluated}]", *overrides, f"weights={folder / 'weights'}", f"results={folder / 'results'}"]
    make_publication(compose("publish", given)).run(measured_values)


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
    written = {"README.md", "config.json", "measured.json", "training.yaml", "weights.safetensors"}
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
    line = next(line for line in card.splitlines() if "β = -2" in line)
    assert f"| {mean:.2f} [" in line
    assert "\n\n## Limits\n\n" in card
    assert "\n\n\n" not in card
    assert not pd.read_csv(results / "training_episodes.csv").empty


def test_what_was_measured_is_there_for_programs(evaluated: Path, tmp_path: Path) -> None:
    publish(evaluated, tmp_path)
    folder = tmp_path / "weights" / "rcdsac_pow-narrow"
    measured = read_weights(folder).measured
    assert measured is not None
    assert json.loads((folder / "measured.json").read_text())["format_version"] == 2
    episodes = read_episodes([tmp_path / "results" / "rcdsac_pow-narrow"])
    assert [condition.beta for condition in measured.conditions] == [-2.0, -1.0]
    for condition in measured.conditions:
        driven = episodes.table[episodes.table["beta"] == condition.beta]
        for metric in ("collisions", "reward", "goals", "collision_free"):
            estimate = condition.metrics[metric]
            assert estimate.mean == pytest.approx(driven[metric].mean())
            assert estimate.low <= estimate.mean <= estimate.high
        hit = condition.collisions_by_thing["all"]["per_episode"]
        assert hit == pytest.approx(driven["collisions"].mean())
    assert (measured.rules_version, measured.map_version, measured.train_seed) == (2, 1, 0)
    assert (measured.num_episodes, measured.protocol["task"]["episode_steps"]) == (2, 20)
    assert not measured.as_shipped
    assert "It was measured in single precision and ships in half." in (folder / "README.md").read_text()
    assert measured.command == "python -m rcdsac_trl.verify rcdsac_pow-narrow seed=0 num_maps=1 num_episodes=2"
    assert set(measured.precision) == set(LIMITS)
    assert measured.calibration == ()
    assert any("no real robot" in sentence for sentence in measured.limits)


# ------------------------------------------------------------------------------------------------ as it ships
def test_an_agent_that_was_measured_as_it_ships_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And keeps its promise: on the card's own maps it does exactly what the card says."""
    run, _, _ = untrained_run(tmp_path / "run", "sac")
    evaluate(f"run={run}", "checkpoint=last", "num_episodes=3")
    shipped = evaluate(f"run={run}", "checkpoint=last", "half_precision=true", "num_maps=5", "num_episodes=1")
    assert shipped.name == "last-half-evaluation-seed0-5x1-all"
    publish(run, tmp_path)
    folder = tmp_path / "weights" / "sac-narrow"
    measured = read_weights(folder).measured
    assert measured is not None
    assert (measured.as_shipped, measured.num_episodes) == (True, 5)
    driven = json.loads((shipped / "evaluation.json").read_text())["weights_sha256"]
    assert driven == measured.weights_sha256 == json.loads((folder / "config.json").read_text())["weights_sha256"]
    assert "It was measured as it ships, in half precision." in (folder / "README.md").read_text()

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RCDSAC_TRL_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.setenv("MALLOC_MMAP_MAX_", "0")  # else it starts this process again
    own_maps = ["seed=0", "num_maps=5", "num_episodes=1", "num_workers=0"]
    monkeypatch.setattr("sys.argv", ["verify", "sac-narrow", *own_maps])
    verify()
    table = pd.read_csv("verification/verification.csv")
    assert table["claimed"].tolist() == pytest.approx(table["measured"].tolist())
    assert table["holds"].all()

    # A card that says something else does not hold, and a shell hears of it.
    values = json.loads((folder / "measured.json").read_text())
    values["conditions"][0]["metrics"]["reward"] = {"mean": 400.0, "low": 390.0, "high": 410.0}
    (folder / "measured.json").write_text(json.dumps(values))
    monkeypatch.setattr("sys.argv", ["verify", "sac-narrow", *own_maps])
    with pytest.raises(SystemExit) as left:
        verify()
    assert left.value.code == 1
    assert pd.read_csv("verification/verification.csv")["holds"].tolist() == [True, False]


def test_an_evaluation_of_other_weights_is_not_quoted(tmp_path: Path) -> None:
    run, _, _ = untrained_run(tmp_path / "run", "sac")
    shipped = evaluate(f"run={run}", "checkpoint=last", "half_precision=true")
    described = json.loads((shipped / "evaluation.json").read_text())
    (shipped / "evaluation.json").write_text(json.dumps(described | {"weights_sha256": "0" * 64}))
    with pytest.raises(UserInputError, match=r"\(1 are of other weights: it was trained on\): .* half_precision=true$"):
        publish(run, tmp_path)
    for number, helped in enumerate(("sampled=true", "navigation.replan=true")):
        evaluate(f"run={run}", "checkpoint=last", helped, f"out={run}/evaluation/{number}")
    with pytest.raises(UserInputError, match="no evaluation of its checkpoint last"):
        publish(run, tmp_path)
    assert not (tmp_path / "weights").exists()


def test_half_precision_is_for_runs(evaluated: Path) -> None:
    with pytest.raises(UserInputError, match="half_precision=true rounds the agent of a run, and run=sac-narrow is"):
        evaluate("run=sac-narrow", "half_precision=true")
    with pytest.raises(UserInputError, match="baseline=pursuit has no weights to be rounded"):
        evaluate("baseline=pursuit", "half_precision=true")


def test_calibration_and_collisions_are_on_the_card(evaluated: Path, tmp_path: Path) -> None:
    small = ["num_maps=1", "num_states=2", "num_rollouts=2", "num_workers=0", "threads=1"]
    make_calibration(compose("calibrate", [f"run={evaluated}", "checkpoint=last", "beta=[-2,-1]", *small])).run()
    publish(evaluated, tmp_path)
    folder = tmp_path / "weights" / "rcdsac_pow-narrow"
    measured = read_weights(folder).measured
    assert measured is not None
    assert [entry["beta"] for entry in measured.calibration] == [-2.0, -1.0]
    entry = measured.calibration[0]
    card = (folder / "README.md").read_text()
    assert f"| -2 | {entry['predicted_tail_depth']:.2f} | {entry['tail_depth']:.2f} | " in card
    assert set(entry["coverage"]) == {"0.05", "0.1", "0.25", "0.5", "0.75", "0.9", "0.95"}
    assert all(0.0 <= share <= 1.0 for share in entry["coverage"].values())
    assert "| condition | all | outer walls | inner walls |" in card


def before_rounding(weights: Weights, seed: int) -> Weights:
    """Return an agent of which these weights may be what half precision leaves."""
    rng = np.random.default_rng(seed)
    tensors = {
        name: (value * (1.0 + rng.uniform(-(2.0**-11), 2.0**-11, value.shape))).astype(np.float32)
        for name, value in weights.tensors.items()
    }
    return Weights(weights.config, tensors)


@pytest.mark.parametrize("name", HANDFUL)
def test_half_precision_keeps_actions_and_quantiles_within_bounds(name: str) -> None:
    trained = before_rounding(read_weights(find_weights(name)), seed=0)
    differences = largest_differences(trained, halved(trained), steps=60)
    assert set(differences) == set(LIMITS) - (set() if trained.config.critic == "quantile" else {"quantile"})
    assert all(by > 0.0 for by in differences.values())
    check_rounding(name, differences)


def test_an_agent_that_rounding_changes_is_not_published(
    evaluated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as stricter:
        stricter.setitem(LIMITS, "linear_speed_m_per_s", 0.0)
        with pytest.raises(FaultError, match=r"of rcdsac_pow-narrow by .*, more than 0: nothing was published"):
            publish(evaluated, tmp_path)
    assert list(tmp_path.iterdir()) == []
    one = agent(**RCWR)
    louder = replace(one, tensors={n: v * (1.5 if n.startswith("actor") else 1.0) for n, v in one.tensors.items()})
    differences = largest_differences(one, louder, steps=5)
    assert set(differences) == {"linear_speed_m_per_s", "angular_speed_rad_per_s"}
    with pytest.raises(FaultError, match=r"^half precision changes linear_speed_m_per_s of loud by 0\.\d+, more"):
        check_rounding("loud", differences)
    with pytest.raises(FaultError, match="by nan"):
        check_rounding("odd", {"quantile": float("nan")})


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
