"""Frames: shape, and that each thing is drawn where it is and in its colour."""

import dataclasses

import numpy as np
import pytest

from rcdsac_trl.colors import CAPTIONS, LIGHT, rgb
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.world import render
from rcdsac_trl.world.canvas import scale_bar_m
from rcdsac_trl.world.legend import legend
from rcdsac_trl.world.maps.generator import MapSettings
from rcdsac_trl.world.render import Renderer
from rcdsac_trl.world.task.env import NavigationEnv
from still_scene import MAP, SIZE_M, scene

SIZE_PX = 416  # 20 px/m and 8 px of margin


def at(frame: np.ndarray, x: float, y: float) -> np.ndarray:
    """Return the pixel of a point of the whole-map view."""
    scale = SIZE_PX / (1.04 * SIZE_M)
    return frame[int((1.02 * SIZE_M - y) * scale), int((x + 0.02 * SIZE_M) * scale)].astype(int)


def test_everything_is_drawn_in_its_place_and_colour() -> None:
    frame = Renderer(SIZE_PX).draw(scene())
    assert frame.shape == (SIZE_PX, SIZE_PX, 3)
    assert frame.dtype == np.uint8
    for point, color in {
        (8.0, 15.0): LIGHT.wall,
        (5.0, 5.0): LIGHT.mapped,
        (16.0, 5.0): LIGHT.unmapped,
        (17.0, 12.0): LIGHT.unmapped,
        (2.0, 17.0): LIGHT.mover,
        (3.0, 2.0): LIGHT.goal,
        (13.5, 17.5): LIGHT.floor,
        (10.0, 8.14): LIGHT.robot,
    }.items():
        assert at(frame, *point) == pytest.approx(np.array(rgb(color)), abs=3), point
    # The upper left corner of the picture lies outside the map.
    assert frame[1, 1] == pytest.approx(np.array(rgb(LIGHT.outside)), abs=3)


def test_the_view_of_the_sensor_is_tinted_and_nothing_else() -> None:
    frame = Renderer(SIZE_PX).draw(scene(trail=[]))
    ahead, behind = at(frame, 11.5, 8.5), at(frame, 8.5, 8.5)
    assert behind == pytest.approx(np.array(rgb(LIGHT.floor)), abs=3)
    assert ahead[2] - ahead[0] > 15  # bluish
    everywhere = Renderer(SIZE_PX).draw(scene(trail=[], sensor_mask=sensor_mask("full")))
    assert at(everywhere, 8.5, 8.5) == pytest.approx(ahead, abs=3)


def test_contact_trail_and_caption_change_the_picture() -> None:
    renderer = Renderer(SIZE_PX)
    plain = renderer.draw(scene())
    touching = renderer.draw(scene(in_contact=True))
    assert at(touching, 10.0, 8.14) == pytest.approx(np.array(rgb(LIGHT.touching)), abs=3)
    untrailed = renderer.draw(scene(trail=[]))
    assert np.abs(at(plain, 9.0, 8.0) - at(untrailed, 9.0, 8.0)).max() > 50
    captioned = renderer.draw(scene(), "β = −1.0")
    changed = np.argwhere((captioned != plain).any(-1))
    assert len(changed) > 100
    assert changed[:, 0].max() < 0.1 * SIZE_PX
    assert changed[:, 1].max() < 0.4 * SIZE_PX


def test_the_same_scene_gives_the_same_frame_whatever_was_drawn_before() -> None:
    renderer = Renderer(SIZE_PX)
    first = renderer.draw(scene())
    other_map = dataclasses.replace(MAP, boxes=())
    assert not np.array_equal(renderer.draw(scene(map=other_map)), first)
    assert np.array_equal(renderer.draw(scene()), first)


def test_a_close_view_follows_the_robot() -> None:
    renderer = Renderer(200, view_m=4.0)
    for pose in ((10.0, 8.0, 0.3), (3.1, 17.2, 0.3), (0.4, 19.6, 0.3)):
        frame = renderer.draw(scene(pose=pose, trail=[]))
        assert frame.shape == (200, 200, 3)
        # White arrow in the middle, robot's blue around it: 50 px/m.
        assert frame[100, 100] == pytest.approx(np.full(3, 255), abs=3)
        assert frame[100, 91] == pytest.approx(np.array(rgb(LIGHT.robot)), abs=40)
    # The last pose is in the map's corner, so the picture's corner lies outside.
    assert frame[2, 2] == pytest.approx(np.array(rgb(LIGHT.outside)), abs=3)


def test_edges_are_smooth() -> None:
    frame = Renderer(SIZE_PX, oversampling=3).draw(scene())
    turned = frame[int((20.4 - 6.0) * 20) : int((20.4 - 4.0) * 20), int(4.4 * 20) : int(6.4 * 20)]
    assert len(np.unique(turned.reshape(-1, 3), axis=0)) > 20


def test_the_environment_draws_its_agents() -> None:
    settings = MapSettings(size_m=12.0, layouts=("rooms",))
    env = NavigationEnv(map_settings=settings, agent_ids=(0, 1))
    env.reset()
    frames = [env.render(row) for row in range(2)]
    assert frames[0].shape == (512, 512, 3)
    assert not np.array_equal(frames[0], frames[1])
    env.close()


def inked(frame: np.ndarray) -> np.ndarray:
    """Return the columns of the lower edge in which a scale bar is."""
    return np.flatnonzero((frame[-frame.shape[0] // 24 :] == rgb(LIGHT.ink)).all(-1).any(0))


@pytest.mark.parametrize(("view_m", "bar_m"), [(4.0, 1.0), (8.0, 2.0), (None, 5.0)])
def test_the_scale_bar_is_as_long_as_it_says(view_m: float | None, bar_m: float) -> None:
    frame = Renderer(SIZE_PX, view_m).draw(scene())
    columns = inked(frame)
    shown_m = view_m or 1.04 * SIZE_M
    assert scale_bar_m(shown_m) == bar_m
    assert columns[-1] - columns[0] == pytest.approx(bar_m * SIZE_PX / shown_m, abs=2)
    assert np.diff(columns).max() == 1
    way = [(10.0, 8.0), (11.0, 8.0)]
    assert np.array_equal(inked(Renderer(SIZE_PX, view_m).draw_way(MAP, way, [], [])), columns)
    beside = Renderer(SIZE_PX, view_m, scale_bar=False)
    assert not len(inked(beside.draw(scene())))
    assert beside.shown_m(MAP) == pytest.approx(shown_m)


def test_the_end_of_the_ring_of_sectors_is_seen_without_a_seam() -> None:
    mask = sensor_mask("narrow")
    assert mask[[0, -1]].all()
    frame = Renderer(SIZE_PX, view_m=8.0).draw(scene(sensor_mask=mask, distances_m=np.full(180, 2.0), trail=[]))
    *_, yaw = scene().pose
    across = [
        frame[int(SIZE_PX / 2 - 52 * np.sin(yaw + turn)), int(SIZE_PX / 2 + 52 * np.cos(yaw + turn))].astype(int)
        for turn in np.radians(np.arange(-8.0, 8.5, 0.5))
    ]
    assert np.ptp(across, axis=0).max() <= 12


def test_a_legend_fits_its_picture() -> None:
    captions = {name: CAPTIONS[name] for name in ("robot", "seen", "trail", "wall", "mapped", "unmapped")}
    wide, narrow = legend(captions, 1200, 16.0), legend(captions, 320, 16.0)
    assert (wide.width, narrow.width) == (1200, 320)
    assert 2 * wide.height < narrow.height < 6 * wide.height
    for picture in (wide, narrow):
        pixels = np.asarray(picture).astype(int)
        drawn = np.argwhere((pixels != rgb(LIGHT.card)).any(-1))
        # Nothing touches an edge, and every colour is there.
        assert drawn.min() >= 2
        assert (np.array(pixels.shape[:2]) - drawn.max(axis=0)).min() >= 2
        for name in ("robot", "trail", "wall", "mapped", "unmapped"):
            assert (np.abs(pixels - rgb(getattr(LIGHT, name))).max(-1) <= 3).any(), name


def test_every_thing_has_a_key_of_its_own() -> None:
    names = ("robot", "seen", "hit", "remembered", "expected", "contact", "trail", "way", "goal", "wall")
    assert len({np.asarray(legend({name: ""}, 64, 24.0)).tobytes() for name in names}) == len(names)


def test_a_map_too_large_to_be_kept_as_a_picture_is_drawn_alike_frame_by_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = Renderer(200, view_m=6.0).draw(scene()).astype(int)
    monkeypatch.setattr(render, "_LARGEST_BACKGROUND_PX", 100)
    renderer = Renderer(200, view_m=6.0)
    drawn = renderer.draw(scene()).astype(int)
    assert np.abs(drawn - kept).max() <= 32  # a line's edge may fall on the next fine pixel
    assert (drawn == kept).mean() > 0.99
    assert renderer._background is None


@pytest.mark.parametrize("wrong", [{"size_px": 4}, {"view_m": 0.0}, {"oversampling": 0}])
def test_what_cannot_be_drawn_is_refused(wrong: dict) -> None:
    with pytest.raises(UserInputError, match=next(iter(wrong))):
        Renderer(**wrong)
