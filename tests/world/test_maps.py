import json
import math
import re
import sys
from collections import defaultdict
from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import scipy.ndimage
import yaml
from PIL import Image

from rcdsac_trl import draw_maps
from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.paths import CONF_DIR
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.world.maps.contact_sheet import contact_sheet
from rcdsac_trl.world.maps.files.file_map import FileMapSettings, file_map
from rcdsac_trl.world.maps.files.map_files import map_files
from rcdsac_trl.world.maps.generator import LAYOUTS, SPLITS, Box, Cylinder, Map, MapSettings, Mover, generate_map
from rcdsac_trl.world.maps.geometry import CELL_M, ROBOT_RADIUS_M, lower_clearance, segment_clearance
from rcdsac_trl.world.maps.grid_search import keeps_connected, label_components

MAP_SETS = ("mixed", "static", "easy", "hard")
EIGHT_NEIGHBOURS = np.ones((3, 3))


def conf(name: str) -> dict:
    return yaml.safe_load((CONF_DIR / "map" / f"{name}.yaml").read_text())


def free_cells(map_: Map) -> np.ndarray:
    clearance_m = ROBOT_RADIUS_M + map_.clearance_margin_m
    side = round(map_.size_m / CELL_M)
    field = np.full((side, side), np.inf)
    lower_clearance(field, *map_.solids(), clearance_m, CELL_M)
    return field >= clearance_m


def some_maps(name: str = "mixed", count: int = 6) -> list[Map]:
    return [generate_map(MapSettings(**conf(name)), "train", 1, index) for index in range(count)]


# ---------------------------------------------------------------- the guarantee


@pytest.mark.parametrize("seed", range(200))
def test_free_space_is_one_component(seed: int) -> None:
    name = MAP_SETS[seed % 4]
    map_ = generate_map(MapSettings(**conf(name)), "train", seed, index=seed)
    free = free_cells(map_)
    _, count = scipy.ndimage.label(free, structure=EIGHT_NEIGHBOURS)
    assert count == 1
    assert free.mean() > 0.25


def test_free_space_is_one_component_with_unusual_settings() -> None:
    for settings in (
        MapSettings(size_m=10.0),
        MapSettings(size_m=30.0, num_movers=0),
        MapSettings(clutter_per_m2=0.6, mapped_fraction=0.0, layouts=("rooms",)),
        MapSettings(clutter_per_m2=0.6, mapped_fraction=1.0),
        MapSettings(door_width_m=(0.7, 0.7), corridor_width_m=(0.7, 0.7), layouts=("rooms",)),
        MapSettings(clearance_margin_m=0.2, door_width_m=(1.0, 1.2)),
        MapSettings(clutter_per_m2=0.0),
    ):
        for index in range(4):
            free = free_cells(generate_map(settings, "train", 0, index))
            assert scipy.ndimage.label(free, structure=EIGHT_NEIGHBOURS)[1] == 1


def test_unmapped_clutter_closes_no_passage() -> None:
    """What is connected when only the mapped clutter stands stays so: no passage of the known map is closed."""
    for map_ in some_maps("hard"):
        known = Map(
            map_.layout,
            map_.size_m,
            tuple(box for box in map_.boxes if box.mapped),
            tuple(cylinder for cylinder in map_.cylinders if cylinder.mapped),
            (),
            map_.clearance_margin_m,
        )
        before, after = free_cells(known), free_cells(map_)
        # What is connected within 4 m on the known map is truly connected with 2 m more to go around in.
        for row in range(0, 161, 20):
            for column in range(0, 161, 20):
                near = np.s_[row : row + 40, column : column + 40]
                wide = np.s_[max(row - 20, 0) : row + 60, max(column - 20, 0) : column + 60]
                old, _ = label_components(before[near])
                new = np.zeros_like(before, np.int32)
                new[wide], _ = label_components(after[wide])
                both = (old > 0) & (new[near] > 0)
                for label in np.unique(old[both]):
                    assert len(np.unique(new[near][both & (old == label)])) == 1


# ---------------------------------------------------------------- what stands


def test_no_two_solids_overlap_and_all_are_inside() -> None:
    for map_ in some_maps("hard"):
        clutter = [*(box for box in map_.boxes if not box.wall), *map_.cylinders]
        for piece in clutter:
            assert 0 < piece.x < map_.size_m
            assert 0 < piece.y < map_.size_m
            others = replace(
                map_,
                boxes=tuple(box for box in map_.boxes if box is not piece),
                cylinders=tuple(cylinder for cylinder in map_.cylinders if cylinder is not piece),
            )
            solids = others.solids()
            if isinstance(piece, Cylinder):
                assert segment_clearance(piece.x, piece.y, piece.x, piece.y, *solids, 9.0) > piece.radius
            else:
                corners = piece.corners()
                for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
                    assert segment_clearance(*a, *b, *solids, 9.0) > 0


def test_openings_in_walls_are_doors_or_corridors() -> None:
    """On one line of a building, the gap between two walls is a door (0.9-1.6 m) or a corridor's mouth."""
    settings = MapSettings(layouts=("rooms",), clutter_per_m2=0.0)
    gaps = []
    for index in range(20):
        lines: dict[tuple[int, float], list[tuple[float, float]]] = defaultdict(list)
        for wall in generate_map(settings, "train", 0, index).boxes:
            assert wall.wall
            assert wall.mapped
            upright = wall.half_y > wall.half_x
            at, along, half = (wall.x, wall.y, wall.half_y) if upright else (wall.y, wall.x, wall.half_x)
            lines[int(upright), at].append((along - half, along + half))
        for line in lines.values():
            gaps += [second[0] - first[1] for first, second in pairwise(sorted(line))]
    assert len(gaps) > 200
    assert min(gaps) >= 0.9 - 1e-9
    assert max(gaps) <= 2.4 + 1e-9
    assert np.mean(np.array(gaps) <= 1.6) > 0.6


def test_counts_follow_the_settings() -> None:
    for name in MAP_SETS:
        settings = MapSettings(**conf(name))
        clutter = [
            piece
            for index in range(10)
            for map_ in [generate_map(settings, "train", 0, index)]
            for piece in (*(box for box in map_.boxes if not box.wall), *map_.cylinders)
        ]
        # The densest sets leave some pieces out for lack of room.
        assert np.mean([piece.mapped for piece in clutter]) == pytest.approx(settings.mapped_fraction, abs=0.08)
        map_ = generate_map(settings, "train", 0, 0)
        assert len(map_.movers) == settings.num_movers
        for mover in map_.movers:
            assert settings.mover_radius_m[0] <= mover.radius <= settings.mover_radius_m[1]
            assert settings.mover_speed_m_per_s[0] <= mover.speed_m_per_s <= settings.mover_speed_m_per_s[1]
    empty = generate_map(MapSettings(clutter_per_m2=0.0), "train", 0, 0)
    assert all(box.wall for box in empty.boxes)
    assert not empty.cylinders


def test_clutter_density() -> None:
    for layout, expected in (("rooms", 60), ("clutter", 90)):
        map_ = generate_map(MapSettings(layouts=(layout,), clutter_per_m2=0.15), "train", 0, 0)
        clutter = sum(not box.wall for box in map_.boxes) + len(map_.cylinders)
        assert 0.8 * expected <= clutter <= expected


def test_kinds_of_what_stands() -> None:
    """Every layout has four outer walls; the others are inner ones, and clutter is no wall."""
    for layout in ("rooms", "clutter", "mixed"):
        map_ = generate_map(MapSettings(layouts=(layout,), mapped_fraction=0.5), "train", 0, 0)
        kinds = [map_.kind(piece) for piece in (*map_.boxes, *map_.cylinders)]
        assert kinds[:4] == ["outer_wall"] * 4
        assert kinds.count("outer_wall") == 4
        assert kinds.count("inner_wall") == sum(box.wall for box in map_.boxes) - 4 > 0
        clutter = [piece for piece in (*map_.boxes, *map_.cylinders) if not getattr(piece, "wall", False)]
        assert kinds.count("mapped_clutter") == sum(piece.mapped for piece in clutter) > 0
        assert kinds.count("unmapped_clutter") == sum(not piece.mapped for piece in clutter) > 0


def test_all_layouts_are_drawn() -> None:
    drawn = {generate_map(MapSettings(clutter_per_m2=0.0), "train", 0, index).layout for index in range(20)}
    assert drawn == set(LAYOUTS)


# ---------------------------------------------------------------- streams


def test_the_same_seed_gives_the_same_map() -> None:
    settings = MapSettings()
    assert generate_map(settings, "train", 3, 5) == generate_map(settings, "train", 3, 5)


def test_seeds_indices_and_splits_share_no_map() -> None:
    settings = MapSettings(clutter_per_m2=0.02)
    maps = [generate_map(settings, split, seed, index) for split in SPLITS for seed in (0, 1) for index in range(8)]
    assert len({map_.to_json() for map_ in maps}) == len(maps) == 48


def test_the_number_of_movers_changes_nothing_else() -> None:
    walking = generate_map(MapSettings(**conf("mixed")), "validation", 0, 2)
    static = generate_map(MapSettings(**conf("static")), "validation", 0, 2)
    assert replace(walking, movers=()) == static


# ---------------------------------------------------------------- values


def test_json_round_trip_is_exact() -> None:
    for map_ in some_maps():
        again = Map.from_json(map_.to_json())
        assert again == map_
        assert again.to_json() == map_.to_json()
        np.testing.assert_array_equal(again.segments(), map_.segments())
        hash(again)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": 1}', "null"])
def test_json_that_is_no_map_is_refused(text: str) -> None:
    with pytest.raises(UserInputError, match="not a map"):
        Map.from_json(text)


def test_json_of_another_format_is_refused() -> None:
    data = json.loads(some_maps(count=1)[0].to_json())
    with pytest.raises(UserInputError, match="format is 99"):
        Map.from_json(json.dumps(data | {"format": 99}))


def test_segments_and_circles_by_hand() -> None:
    map_ = Map(
        layout="clutter",
        size_m=20.0,
        boxes=(Box(1.0, 2.0, 2.0, 1.0, math.pi / 2, mapped=True), Box(5.0, 5.0, 1.0, 1.0, 0.0, mapped=False)),
        cylinders=(Cylinder(3.0, 4.0, 0.5, mapped=False), Cylinder(6.0, 7.0, 0.2, mapped=True)),
        movers=(Mover(0.2, 0.5),),
    )
    # The quarter turn exchanges the half sides; corners run counter-clockwise from the box's own (-, -).
    np.testing.assert_allclose(map_.boxes[0].corners(), [[2, 0], [2, 4], [0, 4], [0, 0]], atol=1e-12)
    assert map_.segments().shape == (8, 4)
    np.testing.assert_allclose(
        map_.segments(mapped_only=True), [[2, 0, 2, 4], [2, 4, 0, 4], [0, 4, 0, 0], [0, 0, 2, 0]], atol=1e-12
    )
    np.testing.assert_array_equal(map_.circles(), [[3.0, 4.0, 0.5], [6.0, 7.0, 0.2]])
    np.testing.assert_array_equal(map_.circles(mapped_only=True), [[6.0, 7.0, 0.2]])
    nothing = replace(map_, boxes=(), cylinders=())
    assert nothing.segments().shape == (0, 4)
    assert nothing.circles().shape == (0, 3)


def test_components_by_hand() -> None:
    free = np.array([[1, 0, 1], [0, 1, 0], [0, 0, 0], [1, 1, 0]], bool)
    labels, count = label_components(free)
    assert count == 2
    np.testing.assert_array_equal(labels, [[1, 0, 1], [0, 1, 0], [0, 0, 0], [2, 2, 0]])


def test_keeps_connected_by_hand() -> None:
    before = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], bool)
    ring_opened, ring_cut = before.copy(), before.copy()
    ring_opened[0, 1] = False
    ring_cut[0, 1] = ring_cut[2, 1] = False
    assert keeps_connected(before, ring_opened)
    assert not keeps_connected(before, ring_cut)
    # What was apart before need not be together, and what is filled up wholly cuts nothing.
    assert keeps_connected(ring_cut, ring_cut)
    assert keeps_connected(before, np.zeros_like(before))


# ---------------------------------------------------------------- settings


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"version": 2}, "version is 2"),
        ({"size_m": 5.0}, "size_m is 5.0 but must be a number from 10 to 60"),
        ({"size_m": math.nan}, "size_m is nan"),
        ({"size_m": "large"}, "size_m is 'large'"),
        ({"layouts": ["rooms", "maze"]}, "must name at least one of rooms, clutter, mixed"),
        ({"layouts": []}, "must name at least one of rooms, clutter, mixed"),
        ({"layouts": "rooms"}, "layouts is 'rooms' but must be a list"),
        ({"door_width_m": [0.5, 1.0]}, "door_width_m is 0.5 but must be a number from 0.7"),
        ({"door_width_m": [1.4, 1.0]}, "smallest value must not exceed its largest"),
        ({"corridor_width_m": [1.2]}, "must be two numbers"),
        ({"corridor_width_m": 1.2}, "corridor_width_m is 1.2 but must be a list"),
        ({"clutter_per_m2": -0.1}, "clutter_per_m2 is -0.1"),
        ({"mapped_fraction": 1.5}, "mapped_fraction is 1.5"),
        ({"num_movers": -1}, "num_movers is -1"),
        ({"num_movers": 2.5}, "must be a whole number from 0 to 50"),
        ({"num_movers": True}, "num_movers is True"),
        ({"mover_radius_m": [0.2, 0.9]}, "mover_radius_m is 0.9"),
        ({"mover_speed_m_per_s": [0.0, 0.5]}, "mover_speed_m_per_s is 0.0"),
        ({"clearance_margin_m": 0.0}, "clearance_margin_m is 0.0"),
        ({"waypoint_clearance_m": -1.0}, "waypoint_clearance_m is -1.0"),
        ({"detour_m": 0.0}, "detour_m is 0.0"),
    ],
)
def test_wrong_settings_get_one_sentence(wrong: dict, sentence: str) -> None:
    with pytest.raises(UserInputError, match=re.escape(sentence)) as caught:
        MapSettings(**wrong)
    assert "\n" not in str(caught.value)


def test_margin_raises_the_narrowest_door() -> None:
    with pytest.raises(UserInputError, match=r"door_width_m is 0\.9"):
        MapSettings(clearance_margin_m=0.2)


def test_unknown_split_is_refused() -> None:
    with pytest.raises(UserInputError, match="train, validation, evaluation"):
        generate_map(MapSettings(), "test", 0, 0)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", MAP_SETS)
def test_conf_has_every_field_with_one_comment(name: str) -> None:
    assert list(conf(name)) == [field.name for field in fields(MapSettings)]
    lines = (CONF_DIR / "map" / f"{name}.yaml").read_text().splitlines()
    assert all(line.startswith("# ") for line in lines[0::2])
    assert [line.split(":")[0] for line in lines[1::2]] == list(conf(name))


def test_mixed_is_the_default_and_static_differs_in_movers_only() -> None:
    assert MapSettings(**conf("mixed")) == MapSettings()
    assert MapSettings(**conf("static")) == MapSettings(num_movers=0)
    easy, hard = MapSettings(**conf("easy")), MapSettings(**conf("hard"))
    assert easy.num_movers == 0
    assert easy.mapped_fraction == 1.0
    assert hard.num_movers == 8
    assert easy.clutter_per_m2 < MapSettings().clutter_per_m2 < hard.clutter_per_m2


# ---------------------------------------------------------------- drawing


def test_contact_sheet_draws_every_map() -> None:
    maps = [generate_map(MapSettings(), "validation", seed=1, index=index) for index in range(5)]
    figure = contact_sheet(maps, "validation", seed=1)
    assert len(figure.axes) == 5
    for index, axes in enumerate(figure.axes):
        map_ = generate_map(MapSettings(), "validation", 1, index)
        assert axes.get_title() == f"validation {index} · {map_.layout}"
        # Boxes, cylinders, movers, the robot at its start, and the goal's two rings.
        assert len(axes.patches) == len(map_.boxes) + len(map_.cylinders) + len(map_.movers) + 3
        assert [axes.xaxis.get_major_formatter()(metres) for metres in (0.0, 20.0)] == ["0 m", "20 m"]


def draw(monkeypatch: pytest.MonkeyPatch, folder: Path, *overrides: str) -> None:
    """Run the command in a folder."""
    monkeypatch.chdir(folder)
    monkeypatch.setenv("MALLOC_MMAP_MAX_", "0")  # else it starts this process again
    monkeypatch.setattr(sys, "argv", ["draw_maps", *overrides])
    draw_maps.main()


def test_draw_maps_writes_the_picture_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    draw(monkeypatch, tmp_path, "out=maps.png", "count=1", "map=static")
    assert capsys.readouterr().out.strip() == "drew 1 map: maps.png"
    assert [path.name for path in tmp_path.iterdir()] == ["maps.png"]
    with Image.open(tmp_path / "maps.png") as image:
        assert min(image.size) > 300


def test_draw_maps_writes_maps_that_can_be_read_and_says_what_files_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    draw(monkeypatch, tmp_path, "count=2", "map=easy", "json=drawn")
    settings = FileMapSettings(path="drawn")
    assert [path.name for path in map_files("drawn")] == ["train-0.json", "train-1.json"]
    assert file_map(settings, "train", 0, 1) == generate_map(MapSettings(**conf("easy")), "train", 0, 1)
    capsys.readouterr()
    draw(monkeypatch, tmp_path, "count=1", "map=file", "map.path=drawn", "out=again.png")
    told = capsys.readouterr().out.splitlines()
    assert re.match(
        r"drawn/train-0\.json: a square of 20\.0 m with \d+ boxes and \d+ cylinders; .* m², 100\.0 % ", told[0]
    )
    assert told[1:] == ["drew 1 map: again.png"]


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("count=0", "count=0 is not a whole number from 1 to 100"),
        ("count=many", "count=many must be a whole number"),
        ("split=training", "must be one of train, validation, evaluation"),
        ("seed=-1", "seed=-1 must be at least 0"),
        ("out=maps.jpg", "does not name a PNG file"),
        ("map.num_movers=-3", "num_movers is -3"),
    ],
)
def test_draw_maps_refuses_what_it_cannot_draw(override: str, sentence: str) -> None:
    with pytest.raises(UserInputError, match=re.escape(sentence)):
        draw_maps.main.check(compose("draw_maps", [override]))
