"""A run over the office course: what the pilot is told, that it repeats, what is written, and what is refused."""

import contextlib
import importlib
import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.course_settings import PERIOD_S, CourseSettings, OdometrySettings
from rcdsac_trl.config.run_config import read_config
from rcdsac_trl.deploy import Policy
from rcdsac_trl.deploy.policy.command import Command
from rcdsac_trl.deploy.policy.input_checks import Stamps
from rcdsac_trl.deploy.policy.path import PathFollower
from rcdsac_trl.deploy.policy.weights import packed
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.course.camera_rig import camera_poses, covered
from rcdsac_trl.evaluation.course.course_collisions import collisions_of
from rcdsac_trl.evaluation.course.course_drive import (
    Conditions,
    CourseWorld,
    Direction,
    Trace,
    course_of,
    drive_course,
    is_own,
    measures,
    motor_steps,
    start_pose,
)
from rcdsac_trl.evaluation.course.course_film import frames
from rcdsac_trl.evaluation.course.course_run import make_course
from rcdsac_trl.evaluation.course.entries import entries_of
from rcdsac_trl.evaluation.course.odometry import Odometry, Pose
from rcdsac_trl.evaluation.course.pursuit_pilot import PursuitPilot
from rcdsac_trl.report.course_table import course_table, paper_course, write_course
from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.robot.sectors import Sectors
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.maps.planner import Planner
from rcdsac_trl.world.maps.shapes import Box
from rcdsac_trl.world.office.building import make_office, polyline_m
from rcdsac_trl.world.office.depth_cameras import Lens
from rcdsac_trl.world.office.furniture import desk
from rcdsac_trl.world.sim.contact import Touch
from rcdsac_trl.world.sim.simulation import Simulation
from robots import DSAC, SAC, agent
from tiny import yaml_of

OFFICE = make_office()
SMALL = Lens(width_px=24, height_px=16)
EXACT = OdometrySettings(0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.5, (0.0, 0.0))
SHORT = Conditions(SMALL, OdometrySettings(), time_limit_s=1.5, seed=0)


def drive(pilot: Any, direction: Direction = "forward", repetition: int = 0, given: Conditions = SHORT) -> Trace:
    return drive_course(OFFICE, pilot, None, direction, repetition, given, lambda: None)


class Recorder(PursuitPilot):
    """Drives as pursuit does, and keeps what it is told."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[tuple[Any, ...]] = []

    def act(
        self, ranges: Any, waypoints: Any, velocity: Any, beta: float | None, *, stamps: Stamps | None, pose: Pose
    ) -> Command:
        self.told.append((ranges, waypoints, velocity, stamps, pose))
        return super().act(ranges, waypoints, velocity, beta, stamps=stamps, pose=pose)


# ------------------------------------------------------------------------------------------------ one run
def test_a_command_lasts_015_s_on_average() -> None:
    assert sum(motor_steps(step) for step in range(200)) * 0.02 == pytest.approx(200 * PERIOD_S)
    assert {motor_steps(step) for step in range(200)} == {7, 8}


@pytest.mark.parametrize("direction", ["forward", "reverse"])
def test_pursuit_that_knows_everything_reaches_the_end(direction: Direction) -> None:
    """Without people, on the shortest way that keeps 18 cm from everything, which is hardly longer than the course."""
    course = course_of(OFFICE, direction)
    wide = Planner(replace(OFFICE.map, clearance_margin_m=0.18))
    path = np.concatenate([course[:1], *(wide.true_path(start, end) for start, end in itertools.pairwise(course))])
    assert 53.7 < polyline_m(path) < 56.0
    pilot, steps, onsets, touched = PursuitPilot(), 0, 0, False
    follower = PathFollower(path, pilot.config)  # type: ignore[arg-type]
    with contextlib.closing(Simulation()) as simulation:
        alone = replace(OFFICE.map, movers=())
        simulation.load(alone, OFFICE.planner, start_pose(path), stream(0, "nobody"))
        while (waypoints := follower.update(simulation.pose)) is not None and steps < 1000:
            command = pilot.act(None, waypoints, None, None, stamps=None, pose=simulation.pose)
            moved = simulation.step(command.v_m_per_s, command.omega_rad_per_s, motor_steps(steps))
            onsets, touched, steps = onsets + (moved.in_contact and not touched), moved.in_contact, steps + 1
    assert follower.reached
    assert 53.7 / 0.6 < steps * PERIOD_S < 110.0
    assert onsets <= 2  # it looks at nothing, and cuts corners


def test_the_pilot_is_told_what_sensors_say_and_nothing_else() -> None:
    pilot = Recorder()
    trace = drive(pilot)
    assert len(pilot.told) == len(trace.commands) == 10
    course = course_of(OFFICE, "forward")
    for step, (ranges, waypoints, velocity, stamps, pose) in enumerate(pilot.told):
        assert isinstance(ranges, Sectors)
        assert ranges.covered[sensor_mask("narrow")].all()
        assert np.array_equal(ranges.distances_m, trace.distances_m[step])
        assert stamps == Stamps(*[step * PERIOD_S] * 4)
        assert velocity == tuple(trace.velocities[step])
        # The waypoint as seen from where the robot takes itself to be.
        assert pose == tuple(trace.estimates[step])
        x, y, yaw = pose
        bearing = math.atan2(waypoints[0][1], waypoints[0][0]) + yaw
        seen_at = (x, y) + np.hypot(*waypoints[0]) * np.array([math.cos(bearing), math.sin(bearing)])
        assert seen_at == pytest.approx(course[1])
    assert not np.allclose(trace.estimates[-1], trace.poses[-1], atol=1e-4)
    assert trace.poses[-1, 0] > trace.poses[0, 0] + 0.4


def test_cameras_and_physics_know_an_obstacle_that_is_put_into_the_office() -> None:
    with contextlib.closing(CourseWorld(OFFICE, PursuitPilot().config, "forward", 0, SHORT, [(0.3, 1.0)])) as world:
        x, y, yaw = world.simulation.pose
        assert world.seen().distances_m[0] > 1.3
        world.put_disc(x + 1.0 * math.cos(yaw), y + 1.0 * math.sin(yaw))
        assert world.seen().distances_m[0] == pytest.approx(0.7, abs=0.06)
        world.simulation.move_disc(0, x + 1.5 * math.cos(yaw), y + 1.5 * math.sin(yaw))
        assert world.seen().distances_m[0] == pytest.approx(1.2, abs=0.08)
        with pytest.raises(UserInputError, match="all 1 spare obstacles of the office are in use"):
            world.put_disc(x, y)
        assert any(world.step(0.6, 0.0).in_contact for _ in range(30))


def test_a_run_repeats_bit_by_bit_and_repetitions_differ() -> None:
    first, again, other = (drive(PursuitPilot(), repetition=number) for number in (0, 0, 1))
    for name, values in vars(first).items():
        assert np.array_equal(values, getattr(again, name), equal_nan=True), name
    assert not np.array_equal(first.people, other.people)
    assert not np.array_equal(first.estimates, other.estimates)


def test_directions_end_where_the_other_begins() -> None:
    forward, reverse = (drive(PursuitPilot(), direction).poses[0, :2] for direction in ("forward", "reverse"))  # type: ignore[arg-type]
    assert forward == pytest.approx(OFFICE.course[0])
    assert reverse == pytest.approx(OFFICE.course[-1])


def test_a_run_beyond_the_time_limit_has_not_finished() -> None:
    measured = measures(drive(PursuitPilot()), OFFICE.course)
    assert measured["finished"] is False
    assert measured["time_s"] == pytest.approx(1.5)
    assert measured["goal_error_m"] > 15.0


def test_a_run_ends_where_the_robot_takes_the_goal_to_be() -> None:
    near = replace(OFFICE, course=np.array([[1.3, 2.35], [2.3, 2.4]]))
    given = Conditions(SMALL, EXACT, time_limit_s=10.0, seed=0)
    trace = drive_course(near, PursuitPilot(), None, "forward", 0, given, lambda: None)
    measured = measures(trace, near.course)
    assert measured["finished"] is True
    assert measured["goal_error_m"] < 0.15
    assert measured["collisions"] == 0
    assert 0.85 < measured["driven_m"] < 1.0
    assert measured["estimate_error_m"] < 1e-9


def test_collisions_are_counted_as_they_begin() -> None:
    poses = np.zeros((7, 3))
    contacts = np.array([False, True, True, False, True, False, False])
    empty = np.zeros((6, 2))
    trace = Trace(True, poses, poses, np.zeros((7, 1, 2)), contacts, np.ones(7), np.ones((6, 180)), empty, empty,
                  np.zeros(6, bool), np.zeros(6, bool))  # fmt: skip
    measured = measures(trace, OFFICE.course)
    assert measured["collisions"] == 2
    assert measured["contact_fraction"] == pytest.approx(0.5)
    assert measured["time_s"] == pytest.approx(0.9)


def test_what_a_pilot_is_told_exactly_is_what_the_range_sensor_says() -> None:
    """Glass, too, and chairs as the robot may not enter them; beside and behind still nothing."""
    pilot = Recorder()
    drive(pilot, given=replace(SHORT, ranges="exact"))
    in_view = covered(camera_poses(SMALL.view_deg))
    with contextlib.closing(Simulation()) as simulation:
        simulation.load(OFFICE.map, OFFICE.planner, start_pose(OFFICE.course), stream(0, "course/people", 0, 0))
        exact = simulation.scan()
    told = pilot.told[0][0]
    assert np.array_equal(told.covered, in_view)
    assert np.array_equal(told.distances_m, np.where(in_view, exact, np.inf))


def test_an_office_without_people_or_hollow_furniture_has_the_same_course() -> None:
    eased = make_office(people=False, hollow=False)
    assert np.array_equal(eased.course, OFFICE.course)
    assert len(eased.map.movers) == 0
    chairs = [piece for piece in eased.pieces if piece.name == "chair"]
    assert chairs
    for piece in chairs:
        (solid,) = piece.solids
        assert (solid.shape, solid.low_m, solid.high_m) == (piece.footprint, 0.0, 0.88)
    panes = [piece.solids for piece in eased.pieces if piece.glass]
    assert panes == [piece.solids for piece in OFFICE.pieces if piece.glass]


def test_a_collision_is_told_by_what_was_hit_and_when_it_was_seen() -> None:
    """Pursuit of a goal behind a desk; the robot looks at it, and drives into it."""
    table = desk(4.0, 2.0, 90.0)
    assert isinstance(table.footprint, Box)
    map_ = replace(OFFICE.map, boxes=(table.footprint,), cylinders=(), movers=())
    course = np.array([[2.5, 2.0], [5.5, 2.0]])
    office = replace(OFFICE, map=map_, pieces=(table,), course=course)
    given = Conditions(SMALL, EXACT, time_limit_s=4.5, seed=0, ranges="exact")
    trace = drive_course(office, PursuitPilot(), None, "forward", 0, given, lambda: None)
    (row,) = collisions_of(office, trace).to_dict("records")
    assert (row["thing"], row["own"], row["unseen_s"]) == ("desk", 1, 0.0)
    assert row["x_m"] == pytest.approx(3.6, abs=0.01)
    assert row["robot_x_m"] == pytest.approx(3.35, abs=0.03)
    assert row["robot_v_m_per_s"] > 0.5
    assert abs(row["bearing_rad"]) < math.radians(25.0)
    measured = measures(trace, course)
    assert (measured["collisions"], measured["own_collisions"]) == (1, 1)
    assert measured["reached_m"] == pytest.approx(0.85, abs=0.05)
    assert 1.0 < measured["longest_still_s"] < 3.5


def test_a_person_who_walks_into_a_standing_robot_is_no_collision_of_its_own() -> None:
    touch = Touch(0.0, 0.0, 3, (0.0, 0.0, 0.0), 0.0, 0.0, 0)
    assert not is_own(touch)
    assert is_own(touch._replace(v=0.3))
    assert is_own(touch._replace(mover=None))


# ------------------------------------------------------------------------------------------------ odometry
def walk(settings: OdometrySettings, seconds: float) -> list[float]:
    """Drive a figure of eight; return the position's error at each step."""
    rng = np.random.default_rng(5)
    pose, errors = (0.0, 0.0, 0.0), []
    odometry = Odometry(settings, pose, rng)
    for step in range(round(seconds / PERIOD_S)):
        x, y, yaw = pose
        turn = 0.08 * math.sin(step * 0.02)
        pose = (x + 0.09 * math.cos(yaw), y + 0.09 * math.sin(yaw), yaw + turn)
        odometry.move(pose, PERIOD_S)
        errors.append(math.dist(odometry.pose[:2], pose[:2]))
    return errors


def test_odometry_s_error_stays_bounded_by_the_localisation() -> None:
    assert 0.02 < max(walk(OdometrySettings(), 600.0)) < 0.25
    never_fixed = walk(replace(OdometrySettings(), fix_weight=1e-9), 600.0)
    assert max(never_fixed) > 1.0


def test_odometry_without_errors_is_exact() -> None:
    assert max(walk(EXACT, 60.0)) < 1e-9


@pytest.mark.parametrize(
    "changes",
    [{"scale_std": 0.5}, {"fix_period_s": 0.0}, {"fix_weight": 0.0}, {"fix_std_m": -1.0}, {"velocity_std": (0.0, 9.0)}],
    ids=str,
)
def test_odometry_that_leaves_the_robot_lost_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(UserInputError, match=f"odometry.{next(iter(changes))}"):
        OdometrySettings(**changes)


def test_the_code_has_the_defaults_of_the_configuration() -> None:
    values = yaml_of("course.yaml")
    assert values["camera"] == vars(Lens())
    assert values["odometry"] == vars(OdometrySettings()) | {"velocity_std": list(OdometrySettings().velocity_std)}


# ------------------------------------------------------------------------------------------------ the command
def exported(folder: Path, **changes: Any) -> Path:
    folder.mkdir()
    for name, content in packed(agent(**changes)).items():
        (folder / name).write_bytes(content)
    return folder


def given(tmp_path: Path, *overrides: str) -> list[str]:
    small = [
        "camera.width_px=24",
        "camera.height_px=16",
        "num_workers=0",
        "time_limit_s=0.6",
        f"out={tmp_path / 'out'}",
    ]
    return [*small, *overrides]


def folder_of(names: Sequence[Path]) -> str:
    return f"run=[{','.join(map(str, names))}]"


def test_the_command_writes_the_paper_s_table_and_a_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = [exported(tmp_path / "pow"), exported(tmp_path / "sac", **SAC)]
    asked = given(tmp_path, folder_of(runs), "beta=[-2,-1]", "baseline=pursuit", "repetitions=1")
    monkeypatch.setenv("MALLOC_MMAP_MAX_", "0")  # else it starts this process again
    monkeypatch.setattr("sys.argv", ["course", *asked])
    importlib.import_module("rcdsac_trl.course").main()
    out = tmp_path / "out"
    names = {
        "collisions.csv",
        "course.json",
        "course.png",
        "office.json",
        "runs.csv",
        "table.csv",
        "table.md",
        "traces.csv",
    }
    assert {path.name for path in out.iterdir()} == names
    rows = pd.read_csv(out / "runs.csv")
    assert len(rows) == 4 * 2
    assert rows["agent"].unique().tolist() == ["rcdsac_pow", "sac", "pursuit"]
    assert not rows["finished"].any()
    table = pd.read_csv(out / "table.csv", dtype=str, keep_default_na=False)
    assert table["agent"].tolist() == ["RC-DSAC", "RC-DSAC", "SAC", "pursuit"]
    assert table["β"].tolist() == ["-2", "-1", "", ""]
    assert table["forward time, s, paper"].tolist() == ["110", "107", "115", ""]
    assert set(table["reverse finished"]) == {"0 of 1"}
    assert set(table["reverse time, s"]) == {""}
    traces = pd.read_csv(out / "traces.csv")
    assert len(traces) == len(rows) * 5
    assert "RC-DSAC" in capsys.readouterr().out


def test_equal_calls_write_equal_files_and_others_another_folder(tmp_path: Path) -> None:
    run = f"run={exported(tmp_path / 'pow')}"
    contents = []
    for _ in range(2):
        make_course(compose("course", given(tmp_path, run, "repetitions=1"))).run()
        contents.append((tmp_path / "out" / "traces.csv").read_bytes())
    assert contents[0] == contents[1]
    with pytest.raises(UserInputError, match="holds the course of something else"):
        make_course(compose("course", given(tmp_path, run, "repetitions=2")))
    with pytest.raises(UserInputError, match="holds the course of something else"):
        make_course(compose("course", given(tmp_path, run, "repetitions=1", "guard_margin_m=null")))


@pytest.mark.parametrize(
    ("changes", "overrides", "entries"),
    [
        ({}, [], [-2.0, -1.0]),
        ({"measure": "cvar", "context_range": (0.01, 1.0), "embedding": (1.0, 0.0)}, [], [0.25, 0.75]),
        ({"measure": "wang", "context_range": (-1.0, 0.5)}, [], [-0.25]),
        ({}, ["beta=[-0.5]"], [-0.5]),
        (DSAC, [], [-1.0]),
        (SAC, [], [None]),
    ],
)
def test_agents_drive_at_what_the_paper_drove_them_at(
    tmp_path: Path, changes: dict[str, Any], overrides: list[str], entries: list[float | None]
) -> None:
    run = exported(tmp_path / "agent", **changes)
    course = make_course(compose("course", given(tmp_path, f"run={run}", *overrides)))
    described = json.loads(course.results.described)
    assert [entry["beta"] for entry in described["entries"]] == entries


@pytest.mark.parametrize(
    ("changes", "overrides", "acting"),
    [
        ({}, [], (1, 1.0)),
        ({"acting": {"num_candidates": 6, "spread": 0.5}}, [], (6, 0.5)),
        ({"acting": {"num_candidates": 6, "spread": 0.5}}, ["acting.num_candidates=8"], (8, 0.5)),
    ],
)
def test_agents_act_as_they_say_or_as_is_asked_of_them(
    tmp_path: Path, changes: dict[str, Any], overrides: list[str], acting: tuple[int, float]
) -> None:
    run = exported(tmp_path / "agent", **changes)
    settings = read_config(compose("course", given(tmp_path, f"run={run}", *overrides)), CourseSettings)
    for entry in entries_of(settings):
        assert isinstance(entry.pilot, Policy)
        assert (entry.pilot.acting.num_candidates, entry.pilot.acting.spread) == acting


def test_a_static_layer_shows_what_the_planner_knows_the_glass_among_it(tmp_path: Path) -> None:
    run = f"run={exported(tmp_path / 'agent')}"
    settings = read_config(compose("course", given(tmp_path, run, "navigation.static_layer=true")), CourseSettings)
    pilot = entries_of(settings)[0].pilot
    assert isinstance(pilot, Policy)
    assert pilot.navigator is not None
    assert not pilot.navigator.settings.replan
    assert pilot.navigator.static_layer is not None

    def shown(x: float, y: float) -> bool:
        points = pilot.navigator.static_layer.around((x, y, 0.0), 0.3)  # type: ignore[union-attr]
        return bool((np.hypot(*points.T) < 0.1).any())

    pane = next(piece for piece in OFFICE.pieces if piece.glass and not piece.solids)
    assert shown(pane.footprint.x, pane.footprint.y)
    unknown = [shape for shape in OFFICE.map.cylinders if not shape.mapped]
    assert not any(shown(shape.x + shape.radius, shape.y) for shape in unknown)


@pytest.mark.parametrize(
    ("changes", "overrides", "message"),
    [
        ({"sensor": "sparse"}, [], "of which the four cameras cover"),
        ({}, ["beta=[-3]"], "is outside \\[-2, 0\\]"),
        ({}, ["beta=[]"], "leaves nothing to drive with"),
        (SAC, ["beta=[-1]"], "means nothing to who drives"),
        ({}, ["beta=[-1,-1]"], "more than once"),
        ({}, ["repetitions=0"], "repetitions=0"),
        ({}, ["time_limit_s=0.1"], "time_limit_s=0.1"),
        ({}, ["seed=-1"], "seed=-1"),
        ({}, ["num_workers=-1"], "num_workers=-1"),
        ({}, ["camera.view_deg=40"], "of which the four cameras cover"),
        ({}, ["odometry.fix_weight=2"], "odometry.fix_weight=2"),
        ({}, ["out="], "out names no folder"),
        ({}, ["guard_margin_m=-0.1"], "margin_m=-0.1"),
        ({}, ["navigation.static_layer=true", "guard_margin_m=null"], "static_layer=true changes nothing"),
    ],
)
def test_what_cannot_work_is_refused_before_anything_is_written(
    tmp_path: Path, changes: dict[str, Any], overrides: list[str], message: str
) -> None:
    run = exported(tmp_path / "agent", **changes)
    with pytest.raises(UserInputError, match=message):
        make_course(compose("course", given(tmp_path, f"run={run}", *overrides)))
    assert [path.name for path in tmp_path.iterdir()] == ["agent"]


def test_without_a_shipped_agent_somebody_must_be_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = importlib.import_module("rcdsac_trl.evaluation.course.entries")
    monkeypatch.setattr(module, "shipped_names", lambda: [])
    with pytest.raises(UserInputError, match="name who drives"):
        make_course(compose("course", given(tmp_path)))
    with pytest.raises(UserInputError, match="there is no agent 'nobody'"):
        make_course(compose("course", given(tmp_path, "run=nobody")))


# ------------------------------------------------------------------------------------------------ report and film
def test_the_paper_s_numbers_are_the_paper_s() -> None:
    paper = paper_course()
    assert len(paper) == 18
    assert paper["collisions"].sum() == 7
    assert paper.groupby("name")["time_s"].sum().to_dict() == {"DSAC": 915, "RC-DSAC": 882, "SAC": 226}


def test_the_table_tells_what_did_not_finish() -> None:
    row = {"run": "runs/a", "agent": "rcdsac_pow", "beta": -2.0, "direction": "forward"}
    runs = pd.DataFrame(
        [
            row | {"finished": True, "time_s": 110.0, "collisions": 0},
            row | {"finished": True, "time_s": 130.0, "collisions": 3},
            row | {"finished": False, "time_s": 300.0, "collisions": 6},
            row | {"direction": "reverse", "finished": False, "time_s": 300.0, "collisions": 1},
        ]
    )
    (line,) = course_table(runs).to_dict("records")
    assert line["run"] == "a"
    assert line["forward finished"] == "2 of 3"
    assert line["forward collisions"] == "3.0 ± 2.4"
    assert line["forward time, s"] == "120 ± 10"
    assert line["forward collisions, paper"] == "0"
    assert (line["reverse finished"], line["reverse time, s"], line["reverse time, s, paper"]) == ("0 of 1", "", "116")


def test_a_film_shows_every_control_period() -> None:
    policy = Policy(agent())
    trace = drive(policy)
    pictures = list(frames(OFFICE, policy, trace, course_of(OFFICE, "forward"), "rcdsac_pow, forward"))
    assert {picture.shape for picture in pictures} == {(480, 960, 3)}
    assert len(pictures) == len(trace.commands)


def test_recording_without_its_extra_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UserInputError, match=r"rcdsac-trl\[video\]"):
        make_course(compose("course", given(tmp_path, "baseline=pursuit", "record=true")))


def test_the_picture_is_drawn_from_files_alone(tmp_path: Path) -> None:
    make_course(compose("course", given(tmp_path, "baseline=pursuit", "repetitions=1"))).run()
    text = write_course(tmp_path / "out")
    assert "pursuit" in text
    office = json.loads((tmp_path / "out" / "office.json").read_text())
    assert {shape["kind"] for shape in office["shapes"]} == {"wall", "glass", "known", "unknown"}
    assert office["course"] == OFFICE.course.round(6).tolist()
