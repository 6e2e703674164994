from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from rcdsac_trl import draw_maps
from rcdsac_trl.config.compose import compose
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.plot_training import _read_run, best_updates, draw_run, main
from rcdsac_trl.report.learning_curve import PANELS, learning_curve, validation_curves
from rcdsac_trl.rollout.metrics import METRICS

NAN = float("nan")


def validation(beta: float, collision_weight: float, rewards: dict[int, list[float]]) -> pd.DataFrame:
    rows = [
        dict.fromkeys(METRICS, 0.5)
        | {"updates": updates, "beta": beta, "collision_weight": collision_weight, "reward": reward}
        for updates, values in rewards.items()
        for reward in values
    ]
    return pd.DataFrame(rows)


TWO_BETAS = pd.concat(
    [
        validation(-0.5, NAN, {100: [10.0, 20.0], 200: [30.0, 50.0], 300: [50.0, 60.0]}),
        validation(-2.0, NAN, {100: [0.0, 4.0], 200: [90.0, 110.0], 300: [20.0, 30.0]}),
    ]
)
TRAINING = TWO_BETAS.drop(columns=["beta", "collision_weight"])


def test_every_metric_has_a_panel() -> None:
    assert set(PANELS) == set(METRICS)


def test_curves_are_the_means_of_a_condition_in_ascending_order() -> None:
    averse, bold = validation_curves(TWO_BETAS)
    assert (averse.label, bold.label) == ("validation, β = -2", "validation, β = -0.5")
    assert averse.means["reward"].to_dict() == {100: 2.0, 200: 100.0, 300: 25.0}
    assert bold.means["reward"].to_dict() == {100: 15.0, 200: 40.0, 300: 55.0}
    assert averse.color != bold.color
    assert averse.marker != bold.marker


def test_rows_without_beta_have_their_own_labels() -> None:
    weights = pd.concat([validation(NAN, weight, {1: [0.0]}) for weight in (1.0, 1.5, 2.0)])
    assert [c.label for c in validation_curves(weights)] == [f"validation, w_coll = {w}" for w in ("1", "1.5", "2")]
    assert [c.label for c in validation_curves(validation(NAN, NAN, {1: [0.0]}))] == ["validation"]


def test_the_best_checkpoint_has_the_highest_mean_over_the_conditions() -> None:
    # 8.5, 70 and 40 over both betas, however many episodes a beta has.
    no_contact = TWO_BETAS.assign(contact_fraction=0.0, collisions=0.0)
    assert best_updates(no_contact, 1000) == 200
    # A step in contact counts as much as a reward of 1: 40 in each of these episodes.
    leaning = no_contact.assign(contact_fraction=no_contact["updates"].map({100: 0.0, 200: 0.04, 300: 0.0}))
    assert best_updates(leaning, 1000) == 300
    # So does a tenth of a collision, beside what the reward charges for it.
    colliding = no_contact.assign(collisions=no_contact["updates"].map({100: 0.0, 200: 4.0, 300: 0.0}))
    assert best_updates(colliding, 1000) == 300
    # Of equal scores the first stays, as in training.
    assert best_updates(validation(-1.0, NAN, {5: [3.0], 9: [3.0]}), 1000) == 5


@pytest.mark.parametrize(("table", "lines"), [(None, 1), (TWO_BETAS, 4)])  # training, two betas, the best checkpoint
def test_every_panel_shows_every_curve(table: pd.DataFrame | None, lines: int) -> None:
    figure = learning_curve("title", TRAINING, table, None if table is None else best_updates(table, 1000))
    *panels, legend = figure.axes
    assert [axes.get_title(loc="left") for axes in panels] == list(PANELS.values())
    assert {len(axes.get_lines()) for axes in panels} == {lines}
    assert len(legend.get_legend().get_texts()) == lines


def test_a_disastrous_iteration_does_not_flatten_the_reward() -> None:
    steady = validation(NAN, NAN, {updates: [300.0, 302.0] for updates in range(1, 61)})
    spoilt = steady.assign(reward=steady["reward"].where(steady["updates"] != 2, -1000.0))
    low, high = learning_curve("title", spoilt, None).axes[0].get_ylim()
    assert 290.0 < low < 301.0 < high < 310.0


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.yaml").write_text(
        "algo: {name: sac}\nsensor: {name: full}\nseed: 3\ntask: {episode_steps: 1000}\n"
    )
    TRAINING.to_csv(folder / "training_episodes.csv", index=False)
    return folder


def test_draws_a_run_before_and_after_its_first_validation(run: Path) -> None:
    draw_run(run, run / "before.png")
    TWO_BETAS.to_csv(run / "validation_episodes.csv", index=False)
    draw_run(run, run / "deeper" / "after.png")
    pictures = []
    for path in (run / "before.png", run / "deeper" / "after.png"):
        with Image.open(path) as image:
            pictures.append(np.asarray(image))
    assert pictures[0].shape == pictures[1].shape
    assert not np.array_equal(*pictures)


def test_refuses_what_it_cannot_draw(run: Path, tmp_path: Path) -> None:
    def refused(match: str, *overrides: str) -> None:
        with pytest.raises(UserInputError, match=match):
            main.check(compose("plot_training", list(overrides)))

    main.check(compose("plot_training", [f"run={run}"]))
    refused("name what to draw: run=<folder>")
    refused(r"holds no config\.yaml: name a folder that training wrote", f"run={tmp_path}")
    refused(r"out=.*picture\.jpg does not name a PNG file", f"run={run}", f"out={run}/picture.jpg")
    (run / "training_episodes.csv").unlink()
    refused(r"holds no training_episodes\.csv", f"run={run}")
    assert [path.name for path in run.iterdir()] == ["config.yaml"]


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("config.yaml", bytes(range(256)), r"config\.yaml cannot be read \(.*decode.*\): name a folder"),
        ("config.yaml", b"algo: 3", r"config\.yaml cannot be read \("),
        ("config.yaml", b"", r"config\.yaml cannot be read \("),
        ("training_episodes.csv", b"", r"training_episodes\.csv holds no episode: wait for one"),
        ("training_episodes.csv", b"updates,rewa", r"training_episodes\.csv holds no episode: wait for one"),
        ("training_episodes.csv", b"a,b\n1,2\n", r"training_episodes\.csv cannot be read \(no column updates"),
        ("training_episodes.csv", bytes(range(256)), r"training_episodes\.csv cannot be read \("),
        (
            "validation_episodes.csv",
            b"updates\n1\n2,3\n",
            r"validation_episodes\.csv cannot be read \(Error token",
        ),
    ],
)
def test_a_damaged_run_is_refused_in_one_sentence(run: Path, name: str, content: bytes, told: str) -> None:
    (run / name).write_bytes(content)
    with pytest.raises(UserInputError, match=told):
        main.check(compose("plot_training", [f"run={run}"]))


def test_a_row_that_is_being_written_is_left_out(run: Path) -> None:
    """Cut anywhere: a number without its end is another number."""
    whole = (run / "training_episodes.csv").read_bytes()
    _, before, _, _ = _read_run(run)
    lines = whole.splitlines(keepends=True)
    for kept in range(len(lines[-1])):
        (run / "training_episodes.csv").write_bytes(b"".join(lines[:-1]) + lines[-1][:kept])
        pd.testing.assert_frame_equal(_read_run(run)[1], before[:-1])


@pytest.mark.parametrize("name", ["training_episodes.csv", "validation_episodes.csv"])
def test_a_table_without_rows_or_with_words_is_refused(run: Path, name: str) -> None:
    (TWO_BETAS if "validation" in name else TRAINING)[:0].to_csv(run / name, index=False)
    with pytest.raises(UserInputError, match=f"{name} holds no episode: wait for one"):
        main.check(compose("plot_training", [f"run={run}"]))
    text = (TWO_BETAS if "validation" in name else TRAINING).to_csv(index=False)
    (run / name).write_text(text.replace("\n0.5", "\nx"))
    assert (run / name).read_text() != text
    with pytest.raises(UserInputError, match=f"{name} cannot be read .*could not convert"):
        main.check(compose("plot_training", [f"run={run}"]))


@pytest.mark.parametrize(
    ("out", "told"),
    [
        ("/proc/x.png", "nothing can be written into /proc "),
        ("/dev/null/x.png", "/dev/null cannot be a folder"),
        ("x" * 300 + ".png", "cannot be a file .File name too long.: give another"),
        ("{run}/taken.png", "taken.png is a folder: give a file"),
    ],
)
def test_a_picture_that_cannot_be_written_is_refused(run: Path, out: str, told: str) -> None:
    (run / "taken.png").mkdir()
    out = out.replace("{run}", str(run))
    for verb, overrides in ((main.check, ["plot_training", f"run={run}"]), (draw_maps.main.check, ["draw_maps"])):
        with pytest.raises(UserInputError, match=told):
            verb(compose(overrides[0], [*overrides[1:], f"out={out}"]))
