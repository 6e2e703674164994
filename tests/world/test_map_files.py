"""Maps from files: every format by hand, what is added to them, and one sentence with numbers for what cannot serve."""

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from world_files import FREE, OCCUPIED, UNKNOWN, room, write_map_server, write_world

from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.paths import CONF_DIR
from rcdsac_trl.draw_maps import make_sheet
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.maps.files.barn import GOAL, START, BarnMapSettings, optimal_time_s
from rcdsac_trl.world.maps.files.file_map import FileMapSettings, check_file_maps, file_map, read_building
from rcdsac_trl.world.maps.files.floor_plan import BORDER_M
from rcdsac_trl.world.maps.files.map_files import digests, map_files
from rcdsac_trl.world.maps.files.map_server import read_map_server
from rcdsac_trl.world.maps.files.rectangles import rectangles
from rcdsac_trl.world.maps.generator import MapSettings, generate_map
from rcdsac_trl.world.maps.geometry import ROBOT_RADIUS_M, segment_clearance
from rcdsac_trl.world.maps.planner import Planner
from rcdsac_trl.world.maps.shapes import Box, Cylinder, Map, Mover
from rcdsac_trl.world.task.env import NavigationEnv
from rcdsac_trl.world.task.gymnasium_env import NavigationGymEnv


def is_solid(map_: Map, x: float, y: float) -> bool:
    return float(segment_clearance(x, y, x, y, *map_.solids(), 1.0)) == 0.0


def building(path: Path, **given) -> Map:
    return file_map(FileMapSettings(path=str(path), **given), "train", 0, 0)


# ------------------------------------------------------------------------------------------------ cells
@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_rectangles_cover_exactly_what_is_occupied(share: float) -> None:
    rng = stream(0, "cells")
    for _ in range(20):
        occupied = rng.random(rng.integers(1, 30, 2)) < share
        covered = np.zeros_like(occupied)
        for row, column, end_row, end_column in rectangles(occupied):
            assert not covered[row:end_row, column:end_column].all(), "a rectangle covers nothing new"
            covered[row:end_row, column:end_column] = True
        np.testing.assert_array_equal(covered, occupied)


def test_rectangles_are_few() -> None:
    cross = np.zeros((9, 9), bool)
    cross[4, :] = cross[:, 4] = True
    assert len(rectangles(cross)) == 2
    walls = np.ones((200, 300), bool)
    walls[1:-1, 1:-1] = False
    assert len(rectangles(walls)) == 4


# ------------------------------------------------------------------------------------------------ map_server
@pytest.mark.parametrize("suffix", ["pgm", "png"])
def test_every_cell_of_a_map_server_map_is_where_its_pixel_was(tmp_path: Path, suffix: str) -> None:
    cells = room(40, 60)
    cells[10:14, 20:50] = OCCUPIED  # lines from the top
    path = write_map_server(tmp_path / "a.yaml", cells, suffix=suffix)
    map_ = building(path)
    assert (map_.layout, map_.size_m) == ("a", pytest.approx(6 - 0.2 + 2 * BORDER_M))
    for line, column in [(1, 1), (10, 20), (13, 49), (14, 20), (9, 30), (38, 58), (20, 30)]:
        # Cells of 0.1 m; the walls around, a cell thick, are replaced by the border.
        x, y = BORDER_M + 0.1 * (column - 1) + 0.05, BORDER_M + 0.1 * (38 - line) + 0.05
        assert is_solid(map_, x, y) == (cells[line, column] == OCCUPIED), (line, column)
    # Beside the map, whose width is larger than its height, everything is filled.
    assert is_solid(map_, 3.0, BORDER_M + 3.8 + 0.01)
    assert is_solid(map_, 3.0, map_.size_m - 0.01)


def test_a_rotated_origin_says_where_a_place_of_the_file_lies(tmp_path: Path) -> None:
    cells = room(60, 60)
    cells[59 - 30, 45] = OCCUPIED  # its centre is 4.55, 3.05 m from the lower left corner of the image
    turned = write_map_server(tmp_path / "a.yaml", cells, origin=[10.0, -2.0, math.pi / 2])
    plan = read_map_server(turned, "occupied", mapped=True)
    x, y = plan.to_map_frame(10.0 - 3.05, -2.0 + 4.55)
    assert (x, y) == pytest.approx((4.55 - 0.1 + BORDER_M, 3.05 - 0.1 + BORDER_M))
    map_ = building(turned, start=[10.0 - 1.0, -2.0 + 2.0, math.pi / 2])
    assert is_solid(map_, x, y)
    assert map_.start == pytest.approx((2.0 - 0.1 + BORDER_M, 1.0 - 0.1 + BORDER_M, 0.0))


@pytest.mark.parametrize(
    ("mode", "negate", "unknown", "solid"),
    [
        # Values 0, 60, 120, 205 and 255: occupancies 1, 0.76, 0.53, 0.2 and 0; in raw 0, 60, and thrice unknown.
        ("trinary", 0, "occupied", [True, True, True, False, False]),
        ("trinary", 0, "free", [True, True, False, False, False]),
        ("trinary", 1, "occupied", [False, False, True, True, True]),
        ("trinary", 1, "free", [False, False, False, True, True]),
        ("scale", 0, "free", [True, True, True, False, False]),
        ("raw", 0, "occupied", [False, True, True, True, True]),
        ("raw", 0, "free", [False, True, False, False, False]),
    ],
)
def test_the_modes_of_map_server(tmp_path: Path, mode: str, negate: int, unknown: str, solid: list[bool]) -> None:
    free = {"trinary": 255, "scale": 255, "raw": 0}[mode]
    cells = np.full((50, 70), 255 - free if negate else free, np.uint8)
    values = [0, 60, 120, 205, 255]
    for number, value in enumerate(values):
        cells[20:24, 10 + 10 * number : 14 + 10 * number] = value
    path = write_map_server(tmp_path / "a.yaml", cells, mode=mode, negate=negate)
    map_ = building(path, unknown=unknown)
    found = [is_solid(map_, BORDER_M + 1.2 + number, BORDER_M + 0.1 * (49 - 21.5)) for number in range(len(values))]
    assert found == solid


def test_transparency_is_unknown_in_scale_and_averaged_in_trinary(tmp_path: Path) -> None:
    cells = np.zeros((50, 50, 4), np.uint8)
    cells[:] = 255
    cells[10:20, 10:20] = (255, 255, 255, 0)  # white, and not there
    cells[30:40, 30:40] = (0, 0, 0, 255)
    path = write_map_server(tmp_path / "a.yaml", cells, suffix="png", mode="scale")
    places = [(BORDER_M + 1.5, BORDER_M + 3.5), (BORDER_M + 3.5, BORDER_M + 1.5), (BORDER_M + 2.5, BORDER_M + 2.5)]
    assert [is_solid(building(path), *place) for place in places] == [True, True, False]
    assert [is_solid(building(path, unknown="free"), *place) for place in places] == [False, True, False]
    # (255 + 255 + 255 + 0) / 4 = 191, an occupancy of 0.25; (0 + 0 + 0 + 255) / 4 = 64, one of 0.75.
    path = write_map_server(tmp_path / "b.yaml", cells, suffix="png", mode="trinary")
    assert [is_solid(building(path, unknown="free"), *place) for place in places] == [False, True, False]


# ------------------------------------------------------------------------------------------------ other formats
def test_a_map_of_movingai(tmp_path: Path) -> None:
    path = tmp_path / "den.map"
    lines = ["@@@@@@@@@@", "@........@", "@..TT....@", "@....S.G.@", "@.......W@", "@@@@@@@@@@"]
    path.write_text("type octile\nheight 6\nwidth 10\nmap\n" + "\n".join(lines) + "\n")
    map_ = building(path, cell_m=1.0)
    assert (map_.layout, map_.size_m) == ("den", pytest.approx(8 + 2 * BORDER_M))
    solid = [
        "".join("#" if is_solid(map_, BORDER_M + c + 0.5, BORDER_M + 3.5 - r) else "." for c in range(8))
        for r in range(4)
    ]
    assert solid == ["........", "..##....", "........", ".......#"]


def test_a_world_of_cylinders(tmp_path: Path) -> None:
    path = write_world(tmp_path / "world_0.world", [(0.0, 0.0, 0.1), (4.0, 1.0, 0.1), (4.0, 5.0, 0.2)])
    map_ = building(path, start=[2.0, 2.0, 0.5], goal=[2.0, 9.0])
    # From 0.6 m left of the outermost cylinder, or 2 m around start and goal.
    low_x, low_y, high_y = -0.6, -0.6, 11.0
    assert map_.size_m == pytest.approx(high_y - low_y + 2 * BORDER_M)
    shift = np.array([-low_x + BORDER_M, -low_y + BORDER_M])
    found = sorted((c.x, c.y, c.radius, c.mapped) for c in map_.cylinders)
    assert found == [
        pytest.approx((*(np.array(at) + shift), r, True)) for *at, r in [(0, 0, 0.1), (4, 1, 0.1), (4, 5, 0.2)]
    ]
    assert map_.start == pytest.approx((*(np.array([2.0, 2.0]) + shift), 0.5))
    assert map_.goal == pytest.approx(tuple(np.array([2.0, 9.0]) + shift))
    # What a simulation saved, and the ground, do not count.
    assert len(map_.cylinders) == 3


def test_a_map_of_ours_written_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "hut.json"
    hut = {
        "size_m": [8.0, 6.0],
        "walls": [[0.1, 0.1, 7.9, 0.1], [7.9, 0.1, 7.9, 5.9], [7.9, 5.9, 0.1, 5.9], [0.1, 5.9, 0.1, 0.1]],
        "wall_thickness_m": 0.2,
        "boxes": [{"x": 3.0, "y": 3.0, "half_x": 0.5, "half_y": 0.2, "mapped": False}],
        "cylinders": [{"x": 6.0, "y": 3.0, "radius": 0.3}],
        "goal": [1.0, 5.0],
    }
    path.write_text(json.dumps(hut))
    map_ = building(path)
    assert (map_.layout, map_.size_m, map_.goal) == ("hut", 8.0, (1.0, 5.0))
    assert [map_.kind(piece) for piece in (map_.boxes[-1], map_.cylinders[0])] == ["unmapped_clutter", "mapped_clutter"]
    assert [is_solid(map_, x, y) for x, y in [(4.0, 6.1), (4.0, 5.7), (0.19, 0.19), (0.21, 0.21)]] == [
        True,
        False,
        True,
        False,
    ]
    unknown = building(path, mapped=False)
    assert not any(piece.mapped for piece in (*unknown.boxes, *unknown.cylinders))


def test_the_example_of_the_documents_is_a_map(tmp_path: Path) -> None:
    document = (CONF_DIR.parent / "docs" / "your-building.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"^```json\n(.*?)^```", document, re.M | re.S)
    path = tmp_path / "example.json"
    path.write_text(example)
    check_file_maps(FileMapSettings(path=str(path)), 4.0)
    map_ = building(path)
    assert (len(map_.boxes), len(map_.cylinders), len(map_.movers)) == (7, 1, 1)  # 8 m x 6 m is no square
    planner = Planner(map_)
    assert planner.path_length((1.0, 1.0), (7.0, 1.0)) > 8.0  # around the wall in the middle


def test_a_generated_map_that_was_written_is_read_as_it_was(tmp_path: Path) -> None:
    map_ = generate_map(MapSettings(num_movers=3), "validation", seed=0, index=4)
    path = tmp_path / "map.json"
    path.write_text(map_.to_json())
    assert building(path) == map_
    more = building(path, num_movers=2)
    assert more.movers[:3] == map_.movers
    assert len(more.movers) == 5


# ------------------------------------------------------------------------------------------------ what is added
def test_files_of_a_folder_follow_each_other_by_number(tmp_path: Path) -> None:
    for number, size in ((10, 60), (2, 70)):
        write_map_server(tmp_path / f"floor{number}.yaml", room(size, size))
    (tmp_path / "notes.txt").write_text("no map")
    settings = FileMapSettings(path=str(tmp_path))
    assert [path.name for path in map_files(settings.path)] == ["floor2.yaml", "floor10.yaml"]
    assert [file_map(settings, "train", 0, index).layout for index in range(3)] == ["floor2", "floor10", "floor2"]
    chosen = FileMapSettings(path=[str(tmp_path / "floor10.yaml"), str(tmp_path / "floor2.yaml")])  # type: ignore[arg-type]
    assert [file_map(chosen, "train", 0, index).layout for index in range(2)] == ["floor10", "floor2"]


def test_clutter_and_movers_are_another_draw_for_each_index_and_split(tmp_path: Path) -> None:
    path = write_map_server(tmp_path / "a.yaml", room(100, 140))
    settings = FileMapSettings(
        path=str(path), unmapped_clutter_per_m2=0.08, num_movers=3, start=(2.0, 2.0, 0.0), goal=(11.0, 8.0)
    )
    first = file_map(settings, "train", 0, 0)
    assert first == file_map(settings, "train", 0, 0)
    plain, floor = read_building(settings, path)
    others = [
        file_map(settings, "train", 0, 1),
        file_map(settings, "evaluation", 0, 0),
        file_map(settings, "train", 1, 0),
    ]
    for map_ in (first, *others):
        pieces: list[Box | Cylinder] = [*map_.boxes[len(plain.boxes) :], *map_.cylinders]
        assert 0.6 * 0.08 * floor.area_m2 < len(pieces) <= round(0.08 * floor.area_m2)
        assert all(map_.kind(piece) == "unmapped_clutter" for piece in pieces)
        assert map_.boxes[: len(plain.boxes)] == plain.boxes
        assert all(isinstance(mover, Mover) for mover in map_.movers)
        assert len(map_.movers) == 3
        for place in (map_.start, map_.goal):
            assert place is not None
            x, y = place[:2]
            assert segment_clearance(x, y, x, y, *map_.solids(), 1.0) >= ROBOT_RADIUS_M + 0.05
        planner = Planner(map_)
        assert planner.path_length(map_.start[:2], map_.goal) < 25.0  # type: ignore[index, arg-type]
    assert len({map_.to_json() for map_ in (first, *others)}) == 4


def test_environments_begin_at_the_start_and_go_to_the_goal(tmp_path: Path) -> None:
    path = write_map_server(tmp_path / "a.yaml", room(60, 80))
    settings = FileMapSettings(path=str(path), start=(2.0, 2.0, 1.0), goal=(6.0, 4.0))
    shift = BORDER_M - 0.1
    env = NavigationEnv(map_settings=settings, agent_ids=(0, 5))
    pose = env.reset()["pose"].numpy()
    np.testing.assert_allclose(pose, np.tile([2.0 + shift, 2.0 + shift, 1.0], (2, 1)), rtol=1e-6)
    path_m = env.agents.scene(1).waypoints[-1]
    np.testing.assert_allclose(path_m, [6.0 + shift, 4.0 + shift])
    env.close()
    drawn = NavigationGymEnv(map_settings=FileMapSettings(path=str(path)), seed=0)
    poses = [drawn.reset()[1]["pose"] for _ in range(3)]
    assert len({tuple(pose) for pose in poses}) == 3
    assert isinstance(drawn, gymnasium.Env)
    drawn.close()


def test_a_new_environment_reads_what_the_file_says_now(tmp_path: Path) -> None:
    path = write_map_server(tmp_path / "a.yaml", room(60, 80))
    settings = FileMapSettings(path=str(path), start=(2.0, 2.0, 0.0))
    nearest = []
    for distance in (6, 12):
        cells = room(60, 80)
        cells[30:50, 20 + distance] = OCCUPIED
        write_map_server(path, cells)
        env = NavigationEnv(map_settings=settings, agent_ids=(0,), sensor="full")
        env.reset()
        nearest.append(env.agents.scene(0).distances_m[0])
        env.close()
    assert nearest == pytest.approx([0.6, 1.2])


# ------------------------------------------------------------------------------------------------ digests
def test_digests_are_those_of_sha256sum_and_a_changed_file_is_refused(tmp_path: Path) -> None:
    path = write_map_server(tmp_path / "a.yaml", room(60, 60))
    noted = digests([path])
    assert [line.partition("  ")[2] for line in noted] == [path.as_posix(), (tmp_path / "a.pgm").as_posix()]
    (tmp_path / "empty").write_bytes(b"")
    empty = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    assert digests([tmp_path / "empty"]) == (f"{empty}  {(tmp_path / 'empty').as_posix()}",)
    settings = FileMapSettings(path=str(path), sha256=noted)
    check_file_maps(settings, 1.0)
    changed = room(60, 60)
    changed[30, 30] = OCCUPIED
    write_map_server(path, changed)
    read_building.cache_clear()
    for refused in (lambda: check_file_maps(settings, 1.0), lambda: file_map(settings, "train", 0, 0)):
        with pytest.raises(
            UserInputError, match=r"a\.pgm had sha256 [0-9a-f]{12}\.\., and now has .*bring the old file"
        ):
            refused()


def test_a_file_that_came_or_went_is_refused(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_map_server(tmp_path / f"{name}.yaml", room(60, 60))
    settings = FileMapSettings(path=str(tmp_path), sha256=digests(map_files(str(tmp_path))))
    write_map_server(tmp_path / "c.yaml", room(60, 60))
    with pytest.raises(UserInputError, match=r"c\.yaml was not there"):
        check_file_maps(settings, 1.0)
    for name in ("c.yaml", "b.yaml"):
        (tmp_path / name).unlink()
    with pytest.raises(UserInputError, match=r"b\.yaml was there, and now is not"):
        check_file_maps(settings, 1.0)


# ------------------------------------------------------------------------------------------------ what cannot serve
def islands(path: Path) -> Path:
    cells = room(60, 101)
    for wall in (33, 66):
        cells[:, wall] = OCCUPIED
    return write_map_server(path, cells)


def with_header(path: Path, **changes: object) -> Path:
    return write_map_server(path, room(60, 60), **changes)  # type: ignore[arg-type]


def text(name: str, content: str) -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        path = path.with_name(name)
        path.write_text(content)
        return path

    return write


REFUSED: dict[str, tuple[Callable[[Path], Path], str]] = {
    "no free space": (
        lambda path: write_map_server(path, np.full((9, 9), OCCUPIED)),
        r"a: none of its 81 cells is free: look at its thresholds, negate and map\.unknown",
    ),
    "too narrow": (
        lambda path: write_map_server(path, room(8, 60)),
        r"no place is 0\.3 m clear .* side of a cell right",
    ),
    "islands": (
        islands,
        r"is 3 parts that no way connects, and the largest is 3\d % of it, below map\.connected_share=0\.5",
    ),
    "too small": (
        lambda path: write_map_server(path, room(40, 40)),
        r"is \d+\.\d m² large and \d\.\d m long, .* may be only [12]\.\d m away, and task\.min_path_m=4.* to [12]\.\d",
    ),
    "resolution too coarse": (
        lambda path: write_map_server(path, room(900, 60), resolution=0.5),
        r"58 x 898 cells of 0\.5 m, 29\.0 x 449\.0 m, and maps have at most 200 m: is the side of a cell right",
    ),
    "resolution no number": (
        lambda path: with_header(path, resolution="fine"),
        r"resolution=fine must be a number from 0\.005 to 1",
    ),
    "resolution too fine": (
        lambda path: with_header(path, resolution=0.0005),
        r"resolution=0\.0005 must be a number from 0\.005",
    ),
    "thresholds": (
        lambda path: with_header(path, free_thresh=0.7),
        r"free_thresh=0\.7 is above occupied_thresh=0\.65",
    ),
    "mode": (
        lambda path: with_header(path, mode="cubic"),
        "mode=cubic is unknown: it must be one of trinary, scale, raw",
    ),
    "yaw in degrees": (
        lambda path: with_header(path, origin=[1.0, 2.0, 90]),
        r"the yaw of origin, 90, is more than two turns: give radians",
    ),
    "origin": (lambda path: with_header(path, origin=[1.0, 2.0]), r"origin is \[1\.0, 2\.0\], not three numbers"),
    "missing image": (lambda path: with_header(path, image="b.pgm"), r"its image .*b\.pgm does not exist"),
    "no image": (
        text("a.yaml", "resolution: 0.05\norigin: [0, 0, 0]\n"),
        "image is None, not the name of a PGM or PNG",
    ),
    "endless yaml": (text("a.yaml", "[" * 3000), "cannot be read as YAML"),
    "no yaml": (text("a.yaml", "a: [1"), "cannot be read as YAML"),
    "yaml of nothing": (text("a.yaml", ""), "holds no keys"),
    "movingai header": (text("a.map", "type octile\nheight 2\nmap\n..\n..\n"), "is no map of MovingAI"),
    "movingai lines": (
        text("a.map", "type octile\nheight 3\nwidth 2\nmap\n..\n..\n"),
        "says height 3 and width 2, but holds 2 lines of 2 cells$",
    ),
    "movingai without lines": (
        text("a.map", "type octile\nheight 3\nwidth 2\nmap\n"),
        "says height 3 and width 2, but holds 0 lines$",
    ),
    "movingai letters": (text("a.map", "type octile\nheight 1\nwidth 3\nmap\n.x.\n"), "has 'x' in 1 cells"),
    "world without xml": (text("a.world", "<sdf"), "cannot be read as SDF"),
    "world of nothing": (text("a.world", "<sdf><world></world></sdf>"), "no upright cylinder stands in it"),
    "world with a box": (
        text(
            "a.world",
            "<sdf><world><model name='crate'><link><collision><geometry><box/></geometry></collision></link></model>"
            "</world></sdf>",
        ),
        "of the model crate only an upright cylinder .* and it has box",
    ),
    "world lying": (
        lambda path: write_world(path.with_name("a.world"), [(0, 0, 0.1)], roll=1.57),
        "only an upright cylinder",
    ),
    "world with an include": (
        text("a.world", "<sdf><world><include><uri>model://table</uri></include></world></sdf>"),
        "includes 'model://table', which is not read",
    ),
    "world with a model in a model": (
        text("a.world", "<sdf><world><model name='set'><model name='post'/></model></world></sdf>"),
        "the model set holds another one, which is not read",
    ),
    "world with a pose elsewhere": (
        text("a.world", "<sdf><world><model name='a'><pose relative_to='b'>1 2 0 0 0 0</pose></model></world></sdf>"),
        "a pose is relative to 'b', which is not read",
    ),
    "world of no size": (
        lambda path: write_world(path.with_name("a.world"), [(0, 0, 0.0)]),
        "the radius of cylinder_0 is 0, and must be above 0",
    ),
    "json": (text("a.json", "{"), "is no map: Expecting"),
    "json without a size": (text("a.json", '{"walls": []}'), "is no map: 'size_m' is missing"),
    "json with a strange key": (
        text("a.json", '{"size_m": 9, "doors": []}'),
        "is no map: there is no key doors, a map has format, walls, wall_thickness_m, layout, size_m, boxes",
    ),
    "json with a mistyped key": (
        text("a.json", '{"size_m": 9, "boxs": []}'),
        "is no map: there is no key boxs: did you mean boxes?",
    ),
    "json with a strange key of a box": (
        text("a.json", '{"size_m": 9, "boxes": [{"x": 1, "y": 1, "half": 1}]}'),
        "is no map: there is no key half, what is in boxes has x, y, half_x",
    ),
    "json with a number for a box": (text("a.json", '{"size_m": 9, "boxes": [3]}'), "3 in boxes is no section with"),
    "json of null": (text("a.json", "null"), "is no map: it holds no keys"),
    "json with a mover of no size": (
        text("a.json", '{"size_m": 9, "movers": [{"radius": 0, "speed_m_per_s": 1}]}'),
        "radius in movers is 0, not a number from 0.05 to 9",
    ),
    "json with a mover that stands": (
        text("a.json", '{"size_m": 9, "movers": [{"radius": 0.2, "speed_m_per_s": 0}]}'),
        "speed_m_per_s in movers is 0, not a number from 0.05 to 2",
    ),
    "json outside": (
        text("a.json", '{"size_m": 9, "cylinders": [{"x": 10, "y": 1, "radius": 1}]}'),
        "x in cylinders is 10, not a number from 0 to 9",
    ),
    "json open": (
        text("a.json", '{"size_m": 9, "walls": [[1, 1, 5, 1]]}'),
        r"is open at its edge, as at x=0\.0, y=0\.0 m",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_serve_is_told_in_one_sentence(tmp_path: Path, case: str) -> None:
    write, sentence = REFUSED[case]
    path = write(tmp_path / "a.yaml")
    with pytest.raises(UserInputError, match=sentence) as refused:
        check_file_maps(FileMapSettings(path=str(path)), 4.0)
    assert "\n" not in str(refused.value)
    assert "a" in str(refused.value)


def test_a_first_goal_does_not_make_a_floor_large_enough_for_the_next(tmp_path: Path) -> None:
    path = write_map_server(tmp_path / "a.yaml", room(40, 40))
    settings = FileMapSettings(path=str(path), start=(1.0, 1.0, 0.0), goal=(1.6, 1.6))
    with pytest.raises(UserInputError, match=r"and task\.min_path_m=4"):
        check_file_maps(settings, 4.0)
    check_file_maps(settings, 0.0)  # BARN's goals are given


def test_a_picture_says_what_a_drive_will_refuse(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for cells in (120, 40):
        path = write_map_server(tmp_path / f"{cells}.yaml", room(cells, cells))
        out = tmp_path / f"{cells}.png"
        make_sheet(compose("draw_maps", ["map=file", f"map.path={path}", "count=1", f"out={out}"])).run()
        assert out.is_file()
        said = capsys.readouterr().out
        assert ("train and evaluate refuse this for the paper's robot: " in said) == (cells == 40)


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"path": None}, r"map\.path names no map"),
        ({"path": []}, r"map\.path names no map"),
        ({"path": 3}, r"map\.path names no map"),
        ({"path": "a", "start": "abc"}, r"map\.start=abc must be 3 numbers"),
        ({"path": "a", "mover_radius_m": 0.2}, r"map\.mover_radius_m is 0\.2 but must be two numbers"),
        ({"path": "a", "unknown": "perhaps"}, r"map\.unknown=perhaps must be one of occupied, free"),
        ({"path": "a", "cell_m": math.nan}, r"map\.cell_m is nan but must be a number from 0\.01 to 10"),
        ({"path": "a", "start": [1.0, 2.0]}, r"map\.start=\[1\.0, 2\.0\] must be 3 numbers"),
        ({"path": "a", "goal": [1.0, math.inf]}, r"map\.goal=\[1\.0, inf\] must be 2 numbers"),
        ({"path": "a", "num_movers": 1.5}, r"map\.num_movers is 1\.5 but must be a whole number from 0 to 50"),
        ({"path": "a", "connected_share": 2.0}, r"map\.connected_share is 2\.0"),
    ],
)
def test_settings_outside_their_limits(given: dict, sentence: str) -> None:
    with pytest.raises(UserInputError, match=sentence):
        FileMapSettings(**given)


@pytest.mark.parametrize(
    ("place", "sentence"),
    [
        (
            {"start": (5.0, 3.0, 0.0)},
            r"map\.start=\[5\.0, 3\.0, 0\.0\] is 0\.10 m from what stands there, .* needs 0\.3 m",
        ),
        ({"goal": (50.0, 3.0)}, r"map\.goal=\[50\.0, 3\.0\] lies outside of the map"),
        ({"goal": (8.5, 1.0)}, r"map\.goal=\[8\.5, 1\.0\] is not on the largest connected floor"),
    ],
)
def test_a_start_or_goal_where_no_robot_can_be(tmp_path: Path, place: dict, sentence: str) -> None:
    cells: NDArray[np.uint8] = room(60, 100)
    cells[:, 80] = OCCUPIED
    cells[59 - 30 : 59 - 28, 51:53] = OCCUPIED  # from x = 5.1, y = 2.9
    path = write_map_server(tmp_path / "a.yaml", cells)
    with pytest.raises(UserInputError, match=sentence):
        building(path, **place)


def test_movers_that_fit_nowhere_are_told_before_anything_is_driven(tmp_path: Path) -> None:
    """A corridor of 0.66 m, in which the robot has 0.3 m to both sides, and movers of 0.3 m need 0.35 m."""
    cells = np.kron(room(8, 62), np.ones((11, 11), np.uint8))
    cells[33:, 11:-11] = OCCUPIED
    corridor = write_map_server(tmp_path / "a.yaml", cells, resolution=0.03)
    check_file_maps(FileMapSettings(path=str(corridor)), 4.0)
    with pytest.raises(UserInputError, match=r"a\.yaml: no place is 0\.35 m clear .* movers of 0\.3 m need: make them"):
        check_file_maps(FileMapSettings(path=str(corridor), num_movers=1), 4.0)


def test_numbers_of_a_header_may_be_text(tmp_path: Path) -> None:
    """PyYAML takes 5e-2 for text, the YAML of map_server for a number."""
    plain, odd = (write_map_server(tmp_path / f"{name}.yaml", room(90, 90)) for name in "ab")
    odd.write_text(odd.read_text().replace("resolution: 0.1", "resolution: 1e-1"))
    assert replace(building(odd), layout="a") == building(plain)


def test_a_path_need_not_be_text(tmp_path: Path) -> None:
    path = write_map_server(tmp_path / "a.yaml", room(90, 90))
    assert FileMapSettings(path=path) == FileMapSettings(path=str(path))  # type: ignore[arg-type]


def test_clutter_where_nothing_has_a_back_to_stand_at(tmp_path: Path) -> None:
    """Shelves stand at walls, and a ring of posts has none."""
    ring = [{"x": 6 + 5 * math.cos(k / 14), "y": 6 + 5 * math.sin(k / 14), "radius": 0.3} for k in range(88)]
    path = tmp_path / "a.json"
    path.write_text("\ufeff" + json.dumps({"size_m": 12.0, "cylinders": ring}))
    assert len(building(path, unmapped_clutter_per_m2=0.1).cylinders) > len(ring)


def test_paths_that_name_no_map(tmp_path: Path) -> None:
    write_map_server(tmp_path / "a.yaml", room(60, 60))
    (tmp_path / "empty").mkdir()
    for name, sentence in (
        ("b.yaml", r"b\.yaml does not exist: name a file or a folder"),
        ("a.pgm", r"a\.pgm is no map, .*: name the YAML file that belongs to it"),
        ("empty", "is a folder without a map"),
    ):
        with pytest.raises(UserInputError, match=sentence):
            check_file_maps(FileMapSettings(path=str(tmp_path / name)), 4.0)


def test_an_image_that_is_none(tmp_path: Path) -> None:
    path = write_map_server(tmp_path / "a.yaml", room(60, 60))
    (tmp_path / "a.pgm").write_bytes(b"P5\n60 60\n255\nshort")
    with pytest.raises(UserInputError, match=r"a\.pgm cannot be read as an image"):
        building(path)
    # Sixteen bits a pixel are read as such.
    Image.fromarray(np.where(room(60, 60) == FREE, 65535, 0).astype(np.uint16)).save(tmp_path / "a.png")
    deep = write_map_server(tmp_path / "b.yaml", room(60, 60), image="a.png")
    assert building(deep).boxes == building(write_map_server(path, room(60, 60))).boxes


def test_unknown_cells_count_as_the_key_says(tmp_path: Path) -> None:
    cells = room(60, 60)
    cells[20:30, 20:30] = UNKNOWN
    path = write_map_server(tmp_path / "a.yaml", cells, free_thresh=0.196)
    place = BORDER_M + 2.4, BORDER_M + 3.4
    assert is_solid(building(path), *place)
    assert not is_solid(building(path, unknown="free"), *place)


# ------------------------------------------------------------------------------------------------ BARN
def test_the_worlds_of_the_protocol(tmp_path: Path) -> None:
    for number in (12, 6, 7, 300):
        write_world(tmp_path / f"world_{number}.world", [(-4.5, 0.0, 0.1), (0.0, 0.0, 0.1)])
    settings = BarnMapSettings("barn", path=str(tmp_path))
    assert [world.name for world in settings.worlds()] == ["world_6.world", "world_12.world"]
    files = settings.files()
    assert (files.start, files.goal, files.mapped) == (START, GOAL, False)
    world = settings.worlds()[0]
    with pytest.raises(
        UserInputError, match=r"path_6\.npy is missing, and BARN's score needs it: get them from github"
    ):
        optimal_time_s(world)
    (tmp_path / "path_files").mkdir()
    # Two cells straight ahead, x = 0.15 * 15.5 - 4.575 = -2.25: the way is the 10 m from start to goal.
    np.save(tmp_path / "path_files" / "path_6.npy", np.array([[15.5, 0.0], [15.5, 10.0]]))
    assert optimal_time_s(world) == pytest.approx(5.0)


@pytest.mark.parametrize("path", [None, "nowhere", "."])
def test_worlds_that_are_missing_are_told_with_their_source(tmp_path: Path, path: str | None) -> None:
    with pytest.raises(UserInputError, match=r"map\.path.*get them from github\.com/Daffan/the-barn-challenge"):
        BarnMapSettings("barn", path=path and str(tmp_path / path)).worlds()
