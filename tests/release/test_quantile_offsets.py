"""Offsets: fitted by hand and on real drives of validation maps, published, loaded, told, and on the card."""

import json
import math
import runpy
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import rcdsac_trl
import tiny
from rcdsac_trl.config.compose import compose
from rcdsac_trl.deploy import Policy
from rcdsac_trl.deploy.policy.distortion import fractions_of
from rcdsac_trl.deploy.policy.weights import read_weights
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.calibration import make_calibration
from rcdsac_trl.evaluation.film import filming
from rcdsac_trl.evaluation.film.recording import Moment
from rcdsac_trl.release.agent_export import make_export
from rcdsac_trl.release.named_agent import named_agent
from rcdsac_trl.release.publication import make_publication
from rcdsac_trl.release.quantile_offsets import fit_recalibration, fitted_offsets, with_offsets
from rcdsac_trl.report.calibration_report import write_calibration
from rcdsac_trl.report.card import measured_values
from robots import AHEAD, OPEN, STANDING

SMALL = ["num_workers=0", "threads=1", "half_precision=true", "beta=[-2,-1]", "checkpoint=last"]
DRIVEN = [*SMALL, "as_driven=true", "num_maps=2", "num_episodes=3", "every_steps=2"]


def calibrate(run: Path, *overrides: str) -> Path:
    calibration = make_calibration(compose("calibrate", [f"run={run}", *overrides]))
    calibration.run(write_calibration)
    return calibration.results.path


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An evaluated run that was calibrated as it drives, on validation and on evaluation maps."""
    folder = tmp_path_factory.mktemp("offsets") / "run"
    tiny.untrained_run(folder, "rcdsac_pow", "learner.gamma=0.6")
    tiny.evaluate(f"run={folder}", "beta=[-2,-1]", "checkpoint=last", "half_precision=true")
    for split in ("validation", "evaluation"):
        calibrate(folder, *DRIVEN, f"split={split}")
    return folder


def folder_of(run: Path, split: str) -> Path:
    (folder,) = (run / "calibration").glob(f"*-{split}-*-driven-*")
    return folder


@pytest.fixture(scope="module")
def published(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return publish(run, tmp_path_factory.mktemp("published"))


def publish(run: Path, folder: Path) -> Path:
    given = [f"runs=[{run}]", f"weights={folder / 'weights'}", f"results={folder / 'results'}"]
    make_publication(compose("publish", given)).run(measured_values)
    return folder / "weights" / "rcdsac_pow-narrow"


# ------------------------------------------------------------------------------------------------ the fit
def test_offsets_by_hand() -> None:
    # What is earned beyond the first quantile: 1, 2, 3, 4, 5; beyond the second: -1, 0, 1, 2, 3.
    quantiles = np.tile([0.0, 2.0], (5, 1)) + np.arange(5.0)[:, None]
    returns = np.array([5.0, 5.0, 5.0, 5.0, 5.0])
    assert fitted_offsets(quantiles, returns, np.array([0.2, 0.7])).tolist() == [1.0, 2.0]
    assert fitted_offsets(quantiles, returns, np.array([0.21, 0.01])).tolist() == [2.0, -1.0]


def test_a_fit_covers_its_own_sample_exactly() -> None:
    rng = np.random.default_rng(0)
    middle = rng.normal(30.0, 8.0, (333, 1))
    tau = fractions_of(16).astype(np.float64)
    said = np.sort(middle + rng.normal(0.0, 1.0, (333, 16)), axis=1)
    returns = middle[:, 0] + rng.gamma(2.0, 4.0, 333)
    told = said + fitted_offsets(said, returns, tau)
    covered = (returns[:, None] <= told + 1e-9).sum(axis=0)
    assert covered.tolist() == [math.ceil(fraction * 333) for fraction in tau]


def test_each_beta_is_fitted_on_its_own_states(run: Path) -> None:
    folder = folder_of(run, "validation")
    recalibration = fit_recalibration(folder, "mine")
    predictions, returns = pd.read_csv(folder / "predictions.csv"), pd.read_csv(folder / "returns.csv")
    assert recalibration.betas == (-2.0, -1.0)
    assert recalibration.num_states == len(predictions) == 2 * 2 * 3 * 5
    for beta, offsets in zip(recalibration.betas, recalibration.offsets, strict=True):
        said = predictions[predictions["beta"] == beta].filter(regex=r"^q\d+$").to_numpy()
        earned = returns[returns["beta"] == beta]["discounted_reward"].to_numpy()
        for number, (offset, fraction) in enumerate(zip(offsets, recalibration.fractions, strict=True)):
            short = np.sort(earned - said[:, number])
            assert offset == pytest.approx(short[math.ceil(fraction * len(short)) - 1], abs=1e-3)
    assert recalibration.offsets[0] != recalibration.offsets[1]
    assert recalibration.command == (
        "python -m rcdsac_trl.calibrate run=mine as_driven=true split=validation seed=0 num_maps=2 num_episodes=3 "
        "every_steps=2 horizon_steps=10 beta=[-2,-1]"
    )


def test_offsets_are_not_fitted_on_what_they_are_judged_by(run: Path, tmp_path: Path) -> None:
    with pytest.raises(UserInputError, match=r"was driven on evaluation maps, .* split=validation to fit them$"):
        fit_recalibration(folder_of(run, "evaluation"), "mine")
    few = ["num_maps=1", "num_states=1", "num_rollouts=1", "split=validation", f"out={tmp_path}"]
    drawn = calibrate(run, *SMALL, *few)
    with pytest.raises(UserInputError, match=r"holds returns of drawn actions: .* as_driven=true split=validation$"):
        fit_recalibration(drawn, "mine")


# ------------------------------------------------------------------------------------------------ what ships
def test_what_is_published_tells_recalibrated_quantiles_and_drives_as_before(run: Path, published: Path) -> None:
    told, raw = rcdsac_trl.load(published, guard=None), Policy(named_agent(run, "last").weights(), guard=None)
    assert (told.recalibrated, raw.recalibrated) == (True, False)
    expected = fit_recalibration(folder_of(run, "validation"), "rcdsac_pow-narrow")
    assert told.config.recalibration == expected
    agent = named_agent(published)  # as films and calibrations take it
    assert agent.recalibration(told.acting) == expected
    assert agent.recalibration(replace(told.acting, num_candidates=told.acting.num_candidates + 1)) is None
    command = told.act(OPEN, AHEAD, STANDING, -1.5)
    between = np.mean(expected.offsets, axis=0)
    assert command.quantiles == pytest.approx(np.sort(command.raw_quantiles + between), abs=1e-4)
    full = raw.act(OPEN, AHEAD, STANDING, -1.5)
    assert command.raw_quantiles == pytest.approx(full.quantiles, abs=0.01)
    assert command.wanted == pytest.approx(full.wanted, abs=0.01)


def test_the_card_says_what_is_told_and_what_was_earned(run: Path, published: Path) -> None:
    measured = read_weights(published).measured
    assert measured is not None
    entries = measured.told_calibration
    assert [(entry["beta"], entry["told"]) for entry in entries] == [
        (-2.0, "raw"),
        (-1.0, "raw"),
        (-2.0, "recalibrated"),
        (-1.0, "recalibrated"),
    ]
    folder = folder_of(run, "evaluation")
    table = pd.read_csv(folder / "calibration.csv")
    for entry, (_, row) in zip(entries, table.iterrows(), strict=False):
        assert entry["predicted"] == pytest.approx(row["predicted"], rel=1e-4)
        assert entry["earned"] == pytest.approx(row["discounted_reward"], rel=1e-4)
        for fraction in ("0.05", "0.5", "0.95"):
            assert entry["coverage"][fraction] == pytest.approx(row[f"coverage_{fraction}"], abs=1e-5)
    # The mean moves by the mean offset: shifted quantiles are the same numbers in another order.
    offsets = fit_recalibration(folder_of(run, "validation"), "a").offsets
    for number in (0, 1):
        moved = entries[2 + number]["predicted"] - entries[number]["predicted"]
        assert moved == pytest.approx(np.mean(offsets[number]), abs=1e-3)
    card = (published / "README.md").read_text()
    assert "| reports | quantiles of the return, recalibrated on 2 validation maps x 3 episodes (seed 0, beta" in card
    assert "on 2 evaluation maps x 3 episodes (seed 0); raw: as its critics predict" in card
    rows = [line for line in card.splitlines() if line.startswith(("| -2 |", "| -1 |"))]
    assert [line.split(" | ")[:2] for line in rows] == [
        ["| -2", "raw"],
        ["| -2", "recalibrated"],
        ["| -1", "raw"],
        ["| -1", "recalibrated"],
    ]
    assert "\n\n\n" not in card


def test_a_published_agent_is_calibrated_as_it_tells(published: Path, tmp_path: Path) -> None:
    given = ["as_driven=true", "num_maps=1", "num_workers=0", "threads=1", "beta=[-2,-1.5]", f"out={tmp_path / 'out'}"]
    folder = calibrate(published, *given)
    predictions = pd.read_csv(folder / "predictions.csv")
    recalibration = read_weights(published).config.recalibration
    assert recalibration is not None
    for beta, states in predictions.groupby("beta"):
        said, told = (states.filter(regex=rf"^{name}\d+$").to_numpy() for name in ("q", "told"))
        assert told == pytest.approx(np.sort(said + recalibration.offsets_of(float(str(beta)))), abs=1e-3)
    raw, shifted = (pd.read_csv(folder / f"{name}.csv") for name in ("calibration", "calibration-told"))
    assert shifted["predicted"].tolist() != raw["predicted"].tolist()
    assert shifted["discounted_reward"].tolist() == raw["discounted_reward"].tolist()


def test_what_is_exported_of_a_run_has_its_offsets_too(run: Path, published: Path) -> None:
    export = make_export(compose("export", [f"run={run}", "checkpoint=last"]))
    assert export.weights.config.recalibration == read_weights(published).config.recalibration
    again = make_export(compose("export", [f"run={published}"]))
    assert again.weights.config.recalibration == read_weights(published).config.recalibration


def test_an_agent_without_a_run_is_recalibrated(published: Path, tmp_path: Path) -> None:
    shipped = read_weights(published).config.recalibration
    given = ["as_driven=true", "num_maps=1", "num_workers=0", "threads=1", "every_steps=2", "seed=1"]
    folder = calibrate(published, *given, "split=validation", "beta=[-2]", f"out={tmp_path / 'fit'}")
    export = make_export(compose("export", [f"run={published}", f"calibration={folder}"]))
    fitted = export.weights.config.recalibration
    assert fitted == fit_recalibration(folder, "rcdsac_pow-narrow")
    assert fitted is not None
    assert fitted.betas == (-2.0,)
    assert fitted != shipped
    checked = calibrate(published, *given, "split=evaluation", "beta=[-2]", f"out={tmp_path / 'check'}")
    with pytest.raises(UserInputError, match=r"check was driven on evaluation maps, which offsets are checked on"):
        make_export(compose("export", [f"run={published}", f"calibration={checked}"]))
    with pytest.raises(UserInputError, match=r"fit holds no calibration of rcdsac_pow-narrow as it drives now \("):
        make_export(compose("export", [f"run={published}", f"calibration={folder}", "acting.num_candidates=3"]))
    with pytest.raises(UserInputError, match=r"nothing holds no calibration: name a folder that calibrate wrote$"):
        make_export(compose("export", [f"run={published}", f"calibration={tmp_path / 'nothing'}"]))


def test_a_shipped_agent_whose_run_is_gone_is_recalibrated_with_its_card(published: Path, tmp_path: Path) -> None:
    recalibrate = runpy.run_path(str(Path(__file__).resolve().parents[2] / "docs" / "recalibrate.py"))["recalibrate"]
    folder = shutil.copytree(published, tmp_path / "weights" / "rcdsac_pow-narrow")
    given = ["as_driven=true", "num_maps=1", "num_workers=0", "threads=1", "every_steps=2", "beta=[-2]"]
    fit, check = (
        calibrate(folder, *given, f"split={split}", f"out={tmp_path / split}") for split in ("validation", "evaluation")
    )
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(UserInputError, match=r"was driven on evaluation maps"):
        recalibrate(folder, check, fit)
    with pytest.raises(UserInputError, match=r"was driven on validation maps, .* split=evaluation to check them$"):
        recalibrate(folder, fit, fit)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    recalibrate(folder, fit, check)
    after = read_weights(folder)
    assert after.config.recalibration == fit_recalibration(fit, "rcdsac_pow-narrow")
    assert after.measured is not None
    told = after.measured.told_calibration
    assert [(entry["beta"], entry["told"], entry["num_maps"]) for entry in told] == [
        (-2.0, "raw", 1),
        (-2.0, "recalibrated", 1),
    ]
    changed = {path.name for path in folder.iterdir() if path.read_bytes() != before[path.name]}
    assert changed == {"config.json", "measured.json", "README.md"}


def test_offsets_of_another_agent_are_not_taken(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Neither of other weights, nor of one that acts otherwise; it is published as before then, and says so."""
    other = shutil.copytree(run, tmp_path / "run")
    weights = named_agent(other, "last").weights()
    assert with_offsets(weights, other, "last").config.recalibration is not None
    described = {path: path.read_text() for path in other.glob("calibration/*/calibration.json")}
    for change in ({"checkpoint": "best"}, {"acting": {"num_candidates": 4}}, {"weights_sha256": "0" * 64}):
        for path, text in described.items():
            path.write_text(json.dumps(json.loads(text) | change))
        assert with_offsets(weights, other, "last").config.recalibration is None
    folder = publish(other, tmp_path)
    assert not rcdsac_trl.load(folder).recalibrated
    measured = read_weights(folder).measured
    assert measured is not None
    assert measured.told_calibration == ()
    assert "| tells |" not in (folder / "README.md").read_text()
    assert "it tells raw quantiles, for it has no calibration as driven on validation" in capsys.readouterr().out


def test_a_film_shows_what_is_told(published: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    filmed: list[tuple[list[list[Moment]], list[list[Moment]]]] = []
    original = filming.recorded

    def both(*given: Any) -> list[list[Moment]]:
        *drive, recalibration = given
        filmed.append((original(*drive), original(*drive, recalibration)))
        return filmed[0][1]

    monkeypatch.setattr(filming, "recorded", both)
    monkeypatch.setattr(filming, "write_video", lambda *_: [])
    tiny.evaluate(f"run={published}", "beta=[-2,-1]", "record=true", f"out={tmp_path}")
    recalibration = read_weights(published).config.recalibration
    assert recalibration is not None
    ((said, told),) = filmed
    for beta, raw, shown in zip((-2.0, -1.0), said, told, strict=True):
        for one, other in zip(raw, shown, strict=True):
            assert one.quantiles is not None
            assert other.quantiles == pytest.approx(np.sort(one.quantiles + recalibration.offsets_of(beta)), abs=1e-5)
            assert one.scene.pose == other.scene.pose
