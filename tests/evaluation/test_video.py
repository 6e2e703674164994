"""Films: right number of frames and size, what they show is what was measured, and nothing half-written."""

import dataclasses
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image

from rcdsac_trl.colors import LIGHT, mixed, rgb
from rcdsac_trl.config.compose import compose
from rcdsac_trl.deploy.policy.distortion import NUM_REPORTED_QUANTILES
from rcdsac_trl.errors import FaultError, UserInputError
from rcdsac_trl.evaluation import branches
from rcdsac_trl.evaluation.branches import predict
from rcdsac_trl.evaluation.evaluation import make_evaluation
from rcdsac_trl.evaluation.film import filming, video
from rcdsac_trl.evaluation.film.episode_film import Track, film
from rcdsac_trl.evaluation.film.recording import Moment
from rcdsac_trl.evaluation.film.trajectories import trajectories
from rcdsac_trl.evaluation.film.video import Frame, write_video
from rcdsac_trl.rollout.make_agent import make_loss
from rcdsac_trl.rollout.quantile_predictor import QuantilePredictor
from still_scene import SIZE_M, scene
from tiny import STEPS, evaluate, tiny_settings


def moving_square(number: int, height: int, width: int) -> Iterator[Frame]:
    for i in range(number):
        frame = np.full((height, width, 3), 250, np.uint8)
        frame[10:30, 4 * i : 4 * i + 20] = (214, 60, 40)
        yield frame


def frames_of(movie: Path) -> np.ndarray:
    """Decode a film, ``[frames, height, width, 3]``."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", movie, "-f", "image2pipe"]
    stream = subprocess.run([*command, "-vcodec", "ppm", "-"], capture_output=True, check=True).stdout
    kind, size, depth, _ = stream.split(b"\n", 3)
    assert (kind, depth) == (b"P6", b"255")
    width, height = map(int, size.split())
    header = len(kind) + len(size) + len(depth) + 3
    pictures = np.frombuffer(stream, np.uint8).reshape(-1, header + height * width * 3)
    return pictures[:, header:].reshape(-1, height, width, 3)


# ------------------------------------------------------------------------------------------------ files
@pytest.mark.parametrize(("height", "width"), [(64, 96), (65, 97)])
def test_a_film_has_the_frames_it_was_given(tmp_path: Path, height: int, width: int) -> None:
    movie, gif = write_video(moving_square(12, height, width), tmp_path / "a.film", 24.0)
    assert (movie.name, gif.name) == ("a.film.mp4", "a.film.gif")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.film.gif", "a.film.mp4"]
    shown = frames_of(movie)
    assert shown.shape == (12, height + height % 2, width + width % 2, 3)  # a video has even sides
    assert imageio_ffmpeg.count_frames_and_secs(str(movie)) == (12, 0.5)
    for i, frame in enumerate(shown):
        assert np.abs(frame[20, 4 * i + 10].astype(int) - (214, 60, 40)).max() < 30
        assert np.abs(frame[50, 40].astype(int) - 250).max() < 12
    with Image.open(gif) as picture:
        assert picture.size == (width, height)
        assert picture.n_frames == 2  # three a second: every eighth
        assert picture.info["duration"] == 330  # 8 / 24 s, in the hundredths that the format has


def test_a_large_film_becomes_a_small_gif(tmp_path: Path) -> None:
    _, gif = write_video(moving_square(1, 500, 1920), tmp_path / "film", 20.0)
    with Image.open(gif) as picture:
        assert picture.size == (960, 250)


def test_a_gif_has_the_palette_s_colours_exactly_and_no_mesh(tmp_path: Path) -> None:
    """Beside a picture of more colours than the format has."""
    ramp = np.linspace(0, 255, 400).astype(np.uint8)
    many = np.stack([np.broadcast_to(ramp, (40, 400)), np.broadcast_to(ramp[::-1], (40, 400))] * 2, axis=-1)[..., :3]
    areas = [LIGHT.mapped, LIGHT.unmapped, LIGHT.card, LIGHT.page, mixed(LIGHT.card, LIGHT.alarm, 0.22)]
    stripes = [np.full((10, 400, 3), rgb(color), np.uint8) for color in areas]
    frame = np.concatenate([*stripes, many])
    _, gif = write_video(iter([frame, frame]), tmp_path / "film", 3.0)
    with Image.open(gif) as picture:
        shown = np.asarray(picture.convert("RGB"))
    assert np.array_equal(shown[:50], frame[:50])
    assert np.abs(shown[50:].astype(int) - frame[50:]).max() < 24


def test_a_film_that_breaks_off_leaves_nothing(tmp_path: Path) -> None:
    def broken() -> Iterator[Frame]:
        yield from moving_square(3, 64, 64)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(broken(), tmp_path / "film", 20.0)
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_written_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserInputError, match="there is no frame to write"):
        write_video(iter(()), tmp_path / "film", 20.0)
    with pytest.raises(UserInputError, match="fps=0 is not above 0"):
        write_video(moving_square(1, 64, 64), tmp_path / "film", 0.0)

    monkeypatch.setattr(video.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserInputError, match=r"imageio_ffmpeg is not installed: pip install 'rcdsac-trl\[video\]'"):
        make_evaluation(compose("evaluate", ["baseline=pursuit", "record=true"]))


def test_what_ffmpeg_says_is_told(tmp_path: Path) -> None:
    with pytest.raises(FaultError, match=r"the film was not written: .*No such file or directory"):
        write_video(moving_square(1, 64, 64), tmp_path / "nowhere" / "film", 20.0)


# ------------------------------------------------------------------------------------------------ frames
def moment(**changes: object) -> Moment:
    values = {"scene": scene(), "beta": -1.0, "speed_m_per_s": 0.5, "collisions": 0, "goals": 0, "quantiles": None}
    return Moment(**(values | changes))  # type: ignore[arg-type]


def test_panels_stand_in_lines_of_four() -> None:
    def size(number: int, quantiles: np.ndarray | None = None) -> tuple[int, ...]:
        return next(film([Track("a", [moment(quantiles=quantiles)])] * number, 0.14)).shape

    one, four, five = size(1), size(4), size(5)
    assert (one[1], four[1], five[1]) == (720, 4 * 480, 4 * 480)
    assert 1.9 < five[0] / four[0] < 2.0  # one legend for all
    assert size(1, np.arange(16, dtype=np.float32))[0] - one[0] == round(0.26 * 720)


def test_each_panel_shows_its_own_moment() -> None:
    tracks = [
        Track("left", [moment(scene=scene(in_contact=True), collisions=1), moment(collisions=1)]),
        Track("right", [moment(), moment(scene=scene(in_contact=True), collisions=1)]),
    ]
    first, second = film(tracks, 0.14)
    side = 640
    head = round(0.09 * side)
    scale = side / (1.04 * SIZE_M)

    def color(frame: Frame, panel: int, x: float, y: float) -> tuple[int, ...]:
        column, line = (x + 0.02 * SIZE_M) * scale, (1.02 * SIZE_M - y) * scale
        return tuple(frame[head + round(line), panel * side + round(column)])

    for panel in (0, 1):
        assert color(first, panel, 5.0, 5.0) == rgb(LIGHT.mapped)
        assert color(first, panel, 1.5, 9.5) == rgb(LIGHT.floor)
    red = rgb(LIGHT.touching)
    touched = [
        [(frame[head : head + side, i * side : (i + 1) * side] == red).all(-1).any() for i in (0, 1)]
        for frame in (first, second)
    ]
    assert touched == [[True, False], [False, True]]


def test_ways_show_goals_and_contacts_where_they_were() -> None:
    def at(x: float, y: float, collisions: int = 0, goals: int = 0) -> Moment:
        where = dataclasses.replace(scene(), pose=(x, y, 0.0), waypoints=np.array([[14.0, 8.0]]))
        return moment(scene=where, collisions=collisions, goals=goals)

    free = Track("a", [at(2.5, 10.0), at(4.5, 10.0), at(6.5, 10.0)])
    hit = Track("b", [at(2.5, 10.0), at(4.5, 10.0, collisions=1), at(6.5, 10.0, 1), at(8.5, 10.0, 1, goals=1)])
    title, picture = np.split(trajectories([free, hit], "an agent"), [42])
    assert [(title[:, i * 420 : (i + 1) * 420] == rgb(LIGHT.ink)).all(-1).any() for i in (0, 1)] == [True, True]
    side, head = 420, 42
    assert picture.shape[1] == 2 * side
    assert side + 2 * head < picture.shape[0] < side + 5 * head  # what the colours mean stands below
    scale = side / (1.04 * SIZE_M)

    def color(panel: int, x: float, y: float) -> tuple[int, ...]:
        return tuple(picture[head + int((1.02 * SIZE_M - y) * scale), panel * side + int((x + 0.02 * SIZE_M) * scale)])

    assert (color(0, 2.5, 10.1), color(1, 2.5, 10.1)) == (rgb(LIGHT.robot),) * 2
    assert color(0, 4.5, 10.15) == rgb(LIGHT.floor)
    assert color(1, 4.5, 10.5) == rgb(LIGHT.touching)
    assert color(1, 6.5, 10.5) == rgb(LIGHT.floor)  # the same contact
    assert color(0, 13.7, 8.2) == rgb(LIGHT.floor)  # not reached
    assert color(1, 13.7, 8.2) != rgb(LIGHT.floor)
    below = picture[head + side : 2 * head + side]
    texts = [(below[:, i * side : (i + 1) * side] == rgb(LIGHT.touching)).all(-1).any() for i in (0, 1)]
    assert texts == [False, True]


# ------------------------------------------------------------------------------------------------ of an evaluation
@pytest.fixture(scope="module")
def run(tiny_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("filmed") / "run"
    shutil.copytree(tiny_run, folder)
    return folder


def test_an_evaluation_films_what_it_measured(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    filmed: list[list[list[Moment]]] = []
    original = filming.recorded
    monkeypatch.setattr(filming, "recorded", lambda *given: filmed.append(original(*given)) or filmed[0])
    out = evaluate(
        f"run={run}", "beta=[-2,-1]", "num_maps=2", f"out={tmp_path}", "record=true", "video.map=1", "video.episode=1"
    )
    assert {path.name for path in out.iterdir()} == {
        *("episodes.csv", "summary.csv", "collisions.csv", "evaluation.json"),
        *("video-map1-episode1.mp4", "video-map1-episode1.gif", "ways-map1-episode1.png"),
    }
    number, height, width, _ = frames_of(out / "video-map1-episode1.mp4").shape
    assert (number, width) == (STEPS, 2 * 640)
    assert height > 640
    rows = pd.read_csv(out / "episodes.csv").query("map == 1 and episode == 1")
    assert rows["beta"].tolist() == [-2.0, -1.0]
    for track, (_, row) in zip(filmed[0], rows.iterrows(), strict=True):
        assert [moment.beta for moment in track] == [row["beta"]] * STEPS
        # The speed after each step but the last; that one is beyond the film.
        driven = np.abs([moment.speed_m_per_s for moment in track[1:]]).sum() / STEPS
        assert 0 <= row["mean_speed_m_per_s"] - driven <= 0.65 / STEPS + 1e-6
        assert len(track[-1].scene.trail) == STEPS
        assert all(moment.quantiles is not None and moment.quantiles.shape == (16,) for moment in track)
    assert filmed[0][0][-1].scene.pose != filmed[0][1][-1].scene.pose


def test_the_baseline_is_filmed_without_quantiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tracks: list[list[Track]] = []

    def one_frame(given: list[Track], period_s: float) -> Iterator[Frame]:
        tracks.append(given)
        return moving_square(1, 64, 64)

    monkeypatch.setattr(filming, "film", one_frame)
    evaluate("baseline=pursuit", "map=easy", "task=default", "task.episode_steps=3", f"out={tmp_path}", "record=true")
    ((track,),) = tracks
    assert track.heading == "pursuit"
    assert [(moment.beta, moment.quantiles) for moment in track.moments] == [(None, None)] * 3


def test_predictions_are_those_of_critics_that_see_the_whole_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(branches, "NUM_READ_QUANTILES", NUM_REPORTED_QUANTILES)
    loss = make_loss(tiny_settings(), "cpu")
    generator = torch.Generator().manual_seed(0)

    def drawn(size: int) -> torch.Tensor:
        return torch.rand(3, 6, size, generator=generator)

    history = {"range": drawn(180), "waypoint": drawn(6), "velocity": drawn(4), "action": drawn(2)}
    betas = torch.tensor([-2.0, -1.0, -0.5])
    # Two episodes of three steps; rows 2 and 0 of three agents.
    predictor = QuantilePredictor(loss.critics, [2, 0])
    for step in range(6):
        now = {key: value[:, step] for key, value in history.items()}
        now |= {"risk": betas.unsqueeze(1), "is_init": torch.full((3, 1), step in (0, 3))}
        told = predictor.step(now)  # type: ignore[arg-type]
        begun = 3 if step >= 3 else 0
        episode = {key: value[:, begun:] for key, value in history.items()}
        with torch.no_grad():
            each = predict(loss, episode, branch_steps=[step - begun] * 3, risk=betas, memory_steps=6)
        expected = each.sort(-1).values.amin(0)  # in rising order, as a robot's policy tells them
        torch.testing.assert_close(told, expected[[2, 0]], rtol=1e-4, atol=1e-5)
