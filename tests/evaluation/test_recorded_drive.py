"""Replays: an agent over recordings of one drive, its numbers worked out by hand, its page, and what is refused."""

import json
import math
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("rosbags", reason="bags need rosbags: pip install 'rcdsac-trl[replay]'")
from recordings import FORMATS, GOAL_M, START_M, TOLD, drive, pose, write_bag, write_carmen

from rcdsac_trl import replay
from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.replay_settings import ReplaySettings
from rcdsac_trl.config.run_config import read_config
from rcdsac_trl.deploy import Policy
from rcdsac_trl.deploy.policy.weights import packed
from rcdsac_trl.deploy.recordings.open_recording import open_recording
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.film.replay_film import frames
from rcdsac_trl.evaluation.recorded_drive import RecordedDrive, row_of, seen_from
from rcdsac_trl.evaluation.recording_survey import survey
from rcdsac_trl.evaluation.replay_run import make_replay
from rcdsac_trl.report.replay_report import causes_table, summary_table, write_replay
from rcdsac_trl.robot.range_sensor import LidarSettings
from rcdsac_trl.robot.robot_settings import PAPER
from robots import agent

PERIOD_S = 0.14


def settings(path: Path, *overrides: str) -> ReplaySettings:
    return read_config(compose("replay", [f"recording={path}", *overrides]), ReplaySettings)


def replayed(path: Path, *overrides: str) -> pd.DataFrame:
    """Return the table of a replay, with an agent of a few weights."""
    recording, chosen = open_recording(path), settings(path, *overrides)
    found = survey(recording, chosen)
    return pd.DataFrame(map(row_of, RecordedDrive(recording, found, Policy(agent()), chosen).periods()))


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("bags")
    return {form: write_bag(folder / form, form, drive()) for form in FORMATS}


# ------------------------------------------------------------------------------------------------ numbers
def test_every_period_is_what_the_recording_was_then(bags: dict[str, Path]) -> None:
    table = replayed(bags["mcap"])
    # Scans and odometry are there from 0.012 s on, and the last message comes at 10.913 s.
    assert len(table) == math.ceil((10.913 - 0.012) / PERIOD_S) + 1
    assert table["time_s"].to_numpy() == pytest.approx(PERIOD_S * np.arange(len(table)), abs=1e-6)
    assert set(table["stopped"]) == {0}
    # The newest transform is at most a tenth of a second old: at the 40th period, of 5.51 s.
    row = table.iloc[40]
    assert row["time_s"] == pytest.approx(5.6)
    assert (row["x_m"], row["y_m"], row["yaw_rad"]) == pytest.approx((START_M[0] + 0.4 * 5.61, START_M[1], 0.0))
    assert (row["waypoint_ahead_m"], row["waypoint_left_m"]) == pytest.approx((GOAL_M[0] - row["x_m"], 0.0), abs=1e-6)
    assert row["nearest_m"] == pytest.approx(1.5, abs=0.002)  # the wall to the right
    assert (row["measured_v_m_per_s"], row["measured_omega_rad_per_s"]) == (0.4, 0.0)
    assert (row["recorded_v_m_per_s"], row["recorded_omega_rad_per_s"]) == TOLD
    assert table["measured_v_m_per_s"].iloc[-1] == 0.0
    assert math.isnan(table["recorded_v_m_per_s"].iloc[0])  # nobody had told it anything yet
    assert table["q0"].notna().all()
    assert table["value"].to_numpy() == pytest.approx(table.filter(regex=r"^q\d+$").mean(axis=1), abs=1e-4)


@pytest.mark.parametrize("form", ["bag1", "sqlite", "mcap_folder"])
def test_all_formats_give_one_table(form: str, bags: dict[str, Path]) -> None:
    pd.testing.assert_frame_equal(replayed(bags[form]), replayed(bags["mcap"]))


def test_a_recorder_with_another_clock_changes_nothing(bags: dict[str, Path], tmp_path: Path) -> None:
    """As bags of simulations: stamps from 0, recorded at wall time."""
    ahead = write_bag(tmp_path / "ahead", "mcap", drive(), ahead_s=1e6)
    columns = ["v_m_per_s", "omega_rad_per_s", "reason", "x_m", "nearest_m"]
    found, expected = replayed(ahead)[columns], replayed(bags["mcap"])[columns]
    assert set(found["reason"]) == {""}
    pd.testing.assert_frame_equal(found.iloc[:-1], expected.iloc[: len(found) - 1], atol=0.02, rtol=0.05)


def test_the_way_that_was_driven_gives_the_waypoints_where_there_is_no_plan(tmp_path: Path) -> None:
    for odometry_lines in (True, False):
        table = replayed(write_carmen(tmp_path / "drive.log", odometry_lines=odometry_lines))
        driving = table[table["stopped"] == 0]
        row = driving.iloc[40]
        assert (row["x_m"], row["y_m"]) == pytest.approx((0.4 * 5.6, 0.0), abs=1e-6)
        assert row["waypoint_ahead_m"] == pytest.approx(4.0 - row["x_m"], abs=0.051)
        assert row["measured_v_m_per_s"] == pytest.approx(0.4, abs=1e-3)
        assert set(table.loc[table["stopped"] == 1, "cause"]) == {
            "the goal is reached; it stands until good input comes"
        }
        # Within 15 cm of 4 m, where odometry had its last point.
        assert table.loc[table["stopped"] == 1, "time_s"].iloc[0] == pytest.approx((4.0 - 0.15) / 0.4, abs=0.2)


def test_where_tf_and_odometry_differ_the_trajectory_is_that_of_odometry(tmp_path: Path) -> None:
    def drifting() -> Any:
        for time_s, topic, kind, values in drive():
            for part in values.get("transforms", []):
                if part["child_frame_id"] == "base_link":
                    part["transform"]["translation"]["y"] = 5.0
            yield time_s, topic, kind, values

    bag = write_bag(tmp_path / "bag", "mcap", drifting())
    assert replayed(bag, "waypoints=trajectory")["waypoint_left_m"].abs().max() < 1e-6
    assert replayed(bag)["y_m"].iloc[0] == pytest.approx(START_M[1] + 5.0)


def test_a_goal_is_gone_straight_to(tmp_path: Path) -> None:
    def with_goal() -> Any:
        for time_s, topic, kind, values in drive():
            if topic != "/plan":
                yield time_s, topic, kind, values
            else:
                yield time_s, "/goal_pose", "geometry_msgs/msg/PoseStamped", pose(0.0, 8.0, 4.5)

    row = replayed(write_bag(tmp_path / "bag", "mcap", with_goal())).iloc[0]
    assert (row["waypoint_ahead_m"], row["waypoint_left_m"]) == pytest.approx((8.0 - row["x_m"], 3.0), abs=1e-6)


def test_what_zeros_mean_is_what_the_agent_sees(tmp_path: Path) -> None:
    """The scanner looks backwards: its first rays look ahead of the robot, where it is said to sit here."""
    bag = write_bag(tmp_path / "bag", "mcap", drive(zeros=4))
    ahead = ["laser=[0.2,0,3.141592653589793]"]
    nearest = {
        meaning: replayed(bag, f"zero_means={meaning}", *ahead).iloc[20]["nearest_m"]
        for meaning in ("far", "near", "invalid")
    }
    assert nearest["far"] == nearest["invalid"] == pytest.approx(1.5, abs=0.002)
    assert nearest["near"] == pytest.approx(0.3, abs=0.002)  # range_min of 0.1 m before a scanner at 0.2 m


def test_a_sensor_is_read_as_far_as_the_agents_robot_sees(bags: dict[str, Path]) -> None:
    recording, chosen = open_recording(bags["mcap"]), settings(bags["mcap"])
    far = replace(PAPER, lidar=LidarSettings(max_range_m=6.0))
    farthest = []
    for robot in (PAPER, far):
        run = RecordedDrive(recording, survey(recording, chosen), Policy(agent(robot=robot)), chosen)
        seen = [period.sectors.distances_m for period in run.periods() if period.sectors is not None]
        farthest.append(max(distances[np.isfinite(distances)].max() for distances in seen))
    assert farthest[0] < 3.0 < farthest[1] < 6.0


def test_what_is_seen_lies_where_the_walls_are(bags: dict[str, Path]) -> None:
    recording, chosen = open_recording(bags["mcap"]), settings(bags["mcap"])
    run = RecordedDrive(recording, survey(recording, chosen), Policy(agent()), chosen)
    periods = list(run.periods())
    seen = seen_from(periods[0])
    behind, beside = np.abs(seen[:, 0]) < 0.1, np.abs(seen[:, 1]) < 0.1
    assert len(seen) > 50
    assert (behind | beside).all()
    pictures = list(frames(periods))
    assert len(pictures) == len(periods)
    assert {picture.shape for picture in pictures} == {(640, 640, 3)}
    assert (pictures[0] != pictures[-1]).any()


# ------------------------------------------------------------------------------------------------ refusals
def cut(*topics: str, **odd: int) -> Any:
    return (message for message in drive(**odd) if message[1] not in topics)


@pytest.mark.parametrize(
    ("messages", "overrides", "told"),
    [
        (cut("/scan"), [], r"has no topic with sensor_msgs/msg/LaserScan: there are /tf_static"),
        (cut("/odom"), [], r"has no topic with nav_msgs/msg/Odometry: there are /tf_static"),
        (
            drive(zeros=36),
            [],
            r"10\.0% of the readings on /scan are 0, .* zero_means=far .*, zero_means=near .* or zero_means=invalid",
        ),
        (drive(zeros=36, nans=18), ["zero_means=far"], r"5\.0% of the readings on /scan are NaN, .* say nan_means=far"),
        (cut("/tf_static"), [], r"where the scanner's frame 'laser' sits on 'base_link': give laser=\[<x in m>"),
        (cut("/tf"), [], r"the plan of .* is in frame 'map', and no transform there connects it with 'odom'"),
        (cut("/plan"), ["waypoints=plan"], "has no plan: leave waypoints=plan out"),
        (drive(), ["waypoints=goal"], "has no goal: leave waypoints=goal out"),
        (drive(), ["command=/told"], "command=/told is no topic of .*: there are /cmd_vel"),
    ],
)
def test_what_cannot_be_replayed_is_told_before_work_starts(
    messages: Any, overrides: list[str], told: str, tmp_path: Path
) -> None:
    bag = write_bag(tmp_path / "bag", "mcap", messages)
    out = tmp_path / "out"
    with pytest.raises(UserInputError, match=told):
        make_replay(compose("replay", [f"recording={bag}", f"out={out}", *overrides]))
    assert not out.exists()


def test_a_wrong_stamp_is_told_before_it_makes_millions_of_periods(tmp_path: Path) -> None:
    stamps_s = (0.0, 0.2, 3.0e6, 3.0e6 + 0.2)
    path = tmp_path / "jump.log"
    path.write_text("".join(f"FLASER 2 1 1 0 0 0 {at} 0 0 {stamp} host 0\n" for at, stamp in enumerate(stamps_s)))
    with pytest.raises(UserInputError, match=r"says nothing for 3000000 s, from 0\.2 s on, .* is a stamp wrong there"):
        make_replay(compose("replay", [f"recording={path}"]))


def test_a_robot_that_stood_has_no_way(tmp_path: Path) -> None:
    path = tmp_path / "still.log"
    path.write_text("".join(f"FLASER 2 1 1 0 0 0 0 0 0 {at}.0 host 0\n" for at in range(5)))
    with pytest.raises(UserInputError, match=r"moved by 0\.00 m, less than 0\.5 m, and there is no plan or goal"):
        make_replay(compose("replay", [f"recording={path}"]))


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        ([], "name what was recorded: recording="),
        (["recording=nothing.bag"], "recording=nothing.bag does not exist"),
        (["recording=x.bag", "zero_means=open"], "zero_means=open must be one of invalid, far, near"),
        (["recording=x.bag", "laser=[150,0,0]"], "more than 1 m from the robot's centre: give metres"),
        (["recording=x.bag", "waypoints=straight"], "waypoints=straight must be one of auto, plan, goal, trajectory"),
    ],
)
def test_settings_that_cannot_be_are_refused(overrides: list[str], told: str) -> None:
    with pytest.raises(UserInputError, match=told):
        make_replay(compose("replay", overrides))


# ------------------------------------------------------------------------------------------------ the verb
@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "agent").mkdir()
    for name, content in packed(agent()).items():
        (tmp_path / "agent" / name).write_bytes(content)
    return tmp_path


def test_the_command_writes_tables_and_a_page(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    write_carmen(folder / "a drive.log")
    monkeypatch.setenv("MALLOC_MMAP_MAX_", "0")  # set, the program need not start itself anew
    monkeypatch.setattr(sys, "argv", ["replay", "a drive.log", "run=agent", "beta=-1", "out=there"])
    replay.main()
    assert {path.name for path in (folder / "there").iterdir()} == {
        "commands.csv",
        "seen.csv",
        "replay.json",
        "replay.png",
        "replay.html",
    }
    printed = capsys.readouterr().out
    assert re.search(r"control periods +79\n", printed)
    assert "the goal is reached" in printed
    html = (folder / "there" / "replay.html").read_text()
    assert "what it would have done" in html.lower()
    assert html.count("data:image/png;base64,") == 1
    assert "http" not in html.replace("http-equiv", "")
    described = json.loads((folder / "there" / "replay.json").read_text())
    assert (described["recording"], described["waypoints"], described["beta"]) == ("a drive.log", "trajectory", -1.0)
    assert described["max_range_m"] == 3.0


def test_a_film_is_written_where_it_is_asked_for(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("imageio_ffmpeg")
    path = folder / "short.log"
    path.write_text("".join(f"FLASER 181 {'2 ' * 181}0 0 0 {0.2 * at} 0 0 {0.2 * at} host 0\n" for at in range(5)))
    given = [f"recording={path}", f"run={folder / 'agent'}", f"out={folder / 'out'}", "record=true"]
    make_replay(compose("replay", given)).run(write_replay)
    assert (folder / "out" / "replay.mp4").stat().st_size > 1000


# ------------------------------------------------------------------------------------------------ the report
def commands(**columns: Any) -> pd.DataFrame:
    table = {
        "time_s": [0.0, 0.14, 0.28, 0.42],
        "v_m_per_s": [0.5, 0.3, 0.0, 0.5],
        "omega_rad_per_s": [0.0, 0.5, 0.0, -0.5],
        "measured_v_m_per_s": [0.4] * 4,
        "measured_omega_rad_per_s": [0.0] * 4,
        "recorded_v_m_per_s": [math.nan] * 4,
        "recorded_omega_rad_per_s": [math.nan] * 4,
        "stopped": [0, 0, 1, 0],
        "cause": ["", "limited by the stop zone", "scan is  s old", ""],
        "reason": ["", "limited by the stop zone", "scan is 0.4 s old", ""],
    }
    return pd.DataFrame(table | columns)


def test_the_summary_counts_what_was_and_compares_with_what_is_known() -> None:
    rows: Callable[[pd.DataFrame], dict[str, str]] = lambda table: dict(summary_table(table).to_numpy().tolist())  # noqa: E731
    found = rows(commands())
    assert found["control periods"] == "4"
    assert found["stands because it must"] == "25.0%"
    assert found["limited by the guard"] == "33.3% of those in which it drives"
    assert found["would have driven, mean"] == "0.43 m/s, 0.33 rad/s either way"
    assert "was told, mean" not in found
    assert found["within 0.1 m/s and 0.2 rad/s of what was measured"] == "33.3%"  # the first of three alone
    told = rows(commands(recorded_v_m_per_s=[math.nan, 0.3, 0.3, 0.0], recorded_omega_rad_per_s=[math.nan, 0.4, 0, 0]))
    assert told["within 0.1 m/s and 0.2 rad/s of what was told"] == "50.0%"


def test_causes_are_told_once_each_the_commonest_first() -> None:
    table = commands(
        cause=["", "scan is  s old", "scan is  s old", "near"],
        reason=["", "scan is 0.4 s old", "scan is 0.5 s old", "near"],
        stopped=[0, 1, 1, 0],
    )
    assert causes_table(table).to_numpy().tolist() == [
        ["scan is 0.4 s old", "stands", "2", "50.0%", "0.1"],
        ["near", "is limited", "1", "25.0%", "0.4"],
    ]
    assert len(causes_table(commands(cause=[""] * 4, reason=[""] * 4))) == 0
