"""The policy object: the networks' numbers are torch's, bad input stops the robot, and it recovers as it says."""

import copy
import math
from dataclasses import asdict, replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rcdsac_trl.deploy import Guard, InputLimits, Mount, Policy, Scan, Sectors, Stamps
from rcdsac_trl.deploy.export.modules import ActorStep, CriticStep
from rcdsac_trl.deploy.sensors.scan import scan_sectors
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.action import desired_velocities
from rcdsac_trl.robot.observation import range_observation, waypoint_observation
from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.robot.remembered_ranges import RememberedRanges
from robots import AHEAD, OPEN, ROWS, STANDING, agent, full_size

PERIOD_S = 0.14


def at(now_s: float, age_s: float = 0.05) -> Stamps:
    return Stamps(now_s, now_s - age_s, now_s - age_s, now_s - age_s)


def row(tensor_like: Any) -> torch.Tensor:
    return torch.tensor(np.asarray(tensor_like, dtype=np.float32)).reshape(1, -1)


# ------------------------------------------------------------------------------------------------ the numbers
@pytest.mark.parametrize("name", ROWS)
@pytest.mark.parametrize(("sensor", "memory_s"), [("narrow", 0.0), ("narrow", 9.0), ("sparse", 0.0), ("full", 0.0)])
def test_it_drives_as_torch_and_the_world_say(name: str, sensor: str, memory_s: float) -> None:
    weights = full_size(**ROWS[name], sensor=sensor, memory_s=memory_s)
    remembered = RememberedRanges(sensor_mask(sensor), memory_s)
    policy = Policy(weights, guard=None)
    actor, critics = ActorStep.of_weights(weights), CriticStep(weights, torch.from_numpy(policy.fractions))
    memory, memories = torch.zeros(1, 128), torch.zeros(2, 1, 128)
    rng = np.random.default_rng(1)
    commanded = (0.0, 0.0)
    low, high = weights.config.context_range or (0.0, 0.0)
    for step in range(60):
        distances = np.where(rng.random(180) < 0.7, rng.uniform(0.1, 4.0, 180), np.inf)
        waypoints, velocity = rng.uniform(-5, 5, (2, 2)), rng.uniform(-0.5, 0.5, 2)
        told = low + (high - low) * rng.random()
        # Observations as the simulated world makes them.
        bins = row(range_observation(distances, sensor_mask(sensor)))
        waypoint = row(waypoint_observation((0.0, 0.0, 0.0), *map(tuple, waypoints.tolist())))
        vector, context = row([*velocity, *commanded]), row([told])
        seen = row(remembered.observe(distances, *velocity, PERIOD_S if step else 0.0)) if memory_s else None
        with torch.no_grad():
            action, memory = actor(bins, waypoint, vector, context, memory, seen)
            values, memories = critics(bins, waypoint, vector, context, action, memories, seen)
        keywords = {} if weights.config.context is None else {weights.config.context: told}
        command = policy.act(distances, waypoints, velocity, **keywords)
        commanded = desired_velocities(action[0].tolist())
        assert (command.v_m_per_s, command.omega_rad_per_s) == pytest.approx(commanded, abs=1e-5)
        assert command.wanted == (command.v_m_per_s, command.omega_rad_per_s)
        assert (command.reason, command.stopped, command.fresh, command.forgot) == (None, False, True, step == 0)
        if weights.config.critic == "quantile":
            np.testing.assert_allclose(command.quantiles, values[0], rtol=1e-5, atol=1e-5)
        assert command.value == pytest.approx(float(values.mean()), abs=1e-5)


def test_beta_may_change_at_every_call_and_matters() -> None:
    policies = [Policy(full_size(), guard=None) for _ in range(2)]
    first = [policy.act(OPEN, AHEAD, STANDING, beta).wanted for policy, beta in zip(policies, (-2.0, 0.0), strict=True)]
    assert first[0] != first[1]
    # What the networks remember does not depend on beta: equal commands lead to equal memories.
    a, b = (Policy(full_size(), guard=Guard(0.0, 0.0, 0.0)) for _ in range(2))
    a.act(OPEN, AHEAD, STANDING, -2.0)
    b.act(OPEN, AHEAD, STANDING, 0.0)
    assert a.act(OPEN, AHEAD, STANDING, -1.0).value == b.act(OPEN, AHEAD, STANDING, -1.0).value


def test_a_copy_remembers_for_itself() -> None:
    policy = Policy(full_size(memory_s=9.0), guard=None)
    policy.act(np.full(180, 1.0), AHEAD, STANDING)
    kept = copy.copy(policy)
    policy.act(np.full(180, 0.5), AHEAD, STANDING)
    wanted = kept.act(OPEN, AHEAD, STANDING).wanted
    assert wanted != policy.act(OPEN, AHEAD, STANDING).wanted
    again = Policy(full_size(memory_s=9.0), guard=None)
    again.act(np.full(180, 1.0), AHEAD, STANDING)
    assert again.act(OPEN, AHEAD, STANDING).wanted == wanted


def test_it_foresees_what_it_would_do_and_expect_at_another_beta() -> None:
    policies = [Policy(full_size(), guard=None) for _ in range(2)]
    commands = [policy.act(OPEN, AHEAD, STANDING, beta) for policy, beta in zip(policies, (-2.0, -0.5), strict=True)]
    foreseen = policies[0].foresee(-0.5)
    assert foreseen.wanted == commands[1].wanted != commands[0].wanted
    assert foreseen.quantiles is not None
    assert np.array_equal(foreseen.quantiles, commands[1].quantiles)
    assert foreseen.value == commands[1].value
    # Another action's return is another one, and its own action's the same.
    assert policies[0].foresee(-0.5, action=foreseen.action).value == foreseen.value
    assert policies[0].foresee(-0.5, action=[-1.0, 1.0]).value != foreseen.value
    # It has changed nothing, and a copy keeps the situation while the robot drives on.
    kept = copy.copy(policies[0])
    policies[0].act(OPEN, AHEAD, [0.5, 0.0], -2.0)
    assert kept.foresee(-2.0).value == commands[0].value != policies[0].foresee(-2.0).value


@pytest.mark.parametrize("row", ROWS)
def test_many_actions_at_once_are_expected_what_each_is_alone(row: str) -> None:
    policy = Policy(agent(**ROWS[row]))
    policy.act(OPEN, AHEAD, STANDING)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (7, 2)).astype(np.float32)
    many = policy.outlooks(actions)
    if row == "rcwr":  # foresee() does not answer for a weight that may be another one
        assert many.shape == (7, 1)
        return
    for expected, action in zip(many, actions, strict=True):
        alone = policy.foresee(action=action)
        assert expected.mean() == pytest.approx(alone.value, abs=1e-5)
        if alone.quantiles is not None:
            assert expected == pytest.approx(alone.quantiles, abs=1e-5)
    assert len(np.unique(many.mean(axis=1))) == 7


@pytest.mark.parametrize("actions", [[[0.0, 0.0, 0.0]], [0.0, 0.0], [[0.0, 1.5]], [[0.0, np.nan]], None])
def test_what_are_no_actions_is_refused(actions: Any) -> None:
    policy = Policy(agent())
    policy.act(OPEN, AHEAD, STANDING)
    with pytest.raises(UserInputError, match=r"^actions"):
        policy.outlooks(actions)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"navigator": "x"}, "^navigator='x' is none: give Navigator"),
        ({"acting": "x"}, "^acting='x' is none: give ActingSettings"),
        ({"limits": None}, "^limits=None are none: give InputLimits"),
    ],
)
def test_what_is_none_of_what_it_should_be_is_refused(given: dict[str, Any], told: str) -> None:
    with pytest.raises(UserInputError, match=told):
        Policy(agent(), **given)


def test_nothing_is_expected_of_actions_before_anything_was_seen() -> None:
    with pytest.raises(UserInputError, match="nothing was seen"):
        Policy(agent()).outlooks(np.zeros((1, 2), np.float32))


@pytest.mark.parametrize(
    ("row", "arguments", "reason"),
    [
        ("rcdsac_pow", {"beta": -3.0}, "beta=-3 is outside"),
        ("sac", {"beta": -1.0}, "beta=-1 means nothing"),
        ("rcwr", {}, "depends on its collision weight"),
        ("rcdsac_pow", {"action": [0.0]}, "is not two numbers"),
        ("rcdsac_pow", {"action": [0.0, np.nan]}, "is not two numbers"),
    ],
)
def test_what_cannot_be_foreseen_is_refused(row: str, arguments: dict[str, Any], reason: str) -> None:
    policy = Policy(agent(**ROWS[row]))
    with pytest.raises(UserInputError, match="call act"):
        policy.foresee()
    policy.act(OPEN, AHEAD, STANDING)
    with pytest.raises(UserInputError, match=reason):
        policy.foresee(**arguments)


def test_the_default_beta_of_the_power_law_is_the_paper_s_middle() -> None:
    assert Policy(agent()).default_beta == -1.0
    wanted = [Policy(agent(), guard=None).act(OPEN, AHEAD, STANDING, beta).wanted for beta in (None, -1.0)]
    assert wanted[0] == wanted[1]


def test_the_networks_are_told_the_limited_velocities() -> None:
    free, slow = Policy(full_size(), guard=None), Policy(full_size(), guard=Guard(max_speed_m_per_s=0.05))
    first = slow.act(OPEN, AHEAD, STANDING)
    assert abs(first.v_m_per_s) <= 0.05 < abs(first.wanted[0])
    assert first.reason == "limited by the speed limit; it ends when the cause does"
    assert free.act(OPEN, AHEAD, STANDING).wanted == first.wanted
    assert free.act(OPEN, AHEAD, STANDING).wanted != slow.act(OPEN, AHEAD, STANDING).wanted


def test_reset_begins_anew() -> None:
    policy = Policy(agent())
    first = policy.act(OPEN, AHEAD, STANDING)
    second = policy.act(OPEN, AHEAD, STANDING)
    policy.reset()
    again = policy.act(OPEN, AHEAD, STANDING)
    assert (again.wanted, again.value, again.forgot) == (first.wanted, first.value, True)
    assert (second.value, second.forgot) != (first.value, True)


def test_a_memory_is_not_carried_over_a_gap() -> None:
    weights = agent()
    fresh = Policy(weights).act(OPEN, AHEAD, STANDING)
    policy = Policy(weights)
    policy.act(OPEN, AHEAD, STANDING, stamps=at(10.0))
    assert not policy.act(OPEN, AHEAD, STANDING, stamps=at(10.14)).forgot
    late = policy.act(OPEN, AHEAD, STANDING, stamps=at(11.0))
    assert late.forgot
    assert late.wanted == fresh.wanted


def test_a_refusal_before_a_gap_does_not_carry_the_memory_over_it() -> None:
    policy = Policy(agent())
    policy.act(OPEN, AHEAD, STANDING, stamps=at(10.0))
    assert policy.act(None, AHEAD, STANDING, stamps=at(10.14)).stopped
    assert policy.act(OPEN, AHEAD, STANDING, stamps=at(1000.0)).forgot


def test_a_refusal_makes_no_new_scan_of_one_that_was_seen() -> None:
    policy = Policy(agent())
    first = policy.act(OPEN, AHEAD, STANDING, stamps=at(10.0))
    assert policy.act(OPEN, AHEAD, [math.nan, 0.0], stamps=replace(at(10.05), scan_s=9.95)).stopped
    again = policy.act(OPEN, AHEAD, STANDING, stamps=replace(at(10.1), scan_s=9.95))
    assert (again.reason, again.fresh, again.wanted) == (None, False, first.wanted)


def test_stamps_that_the_caller_fills_anew_are_not_those_of_before() -> None:
    policy = Policy(agent())
    stamps: Any = SimpleNamespace(**asdict(at(10.0)))
    for _ in range(3):
        assert policy.act(OPEN, AHEAD, STANDING, stamps=stamps).fresh
        for name, value in vars(stamps).items():
            setattr(stamps, name, value + PERIOD_S)


def test_sectors_that_say_nothing_clear_nothing_that_is_remembered() -> None:
    weights = full_size(memory_s=9.0)
    near = np.where(np.arange(180) < 4, 1.0, np.inf)
    lost = Sectors(np.full(180, np.inf), np.arange(180) >= 4)
    remembers, sees_through = Policy(weights), Policy(weights)
    for policy in (remembers, sees_through):
        policy.act(near, AHEAD, STANDING)
    assert remembers.act(lost, AHEAD, STANDING).wanted != sees_through.act(OPEN, AHEAD, STANDING).wanted


def test_time_passes_for_what_is_remembered_while_calls_without_stamps_are_refused() -> None:
    """Of one that drives at 0.6 m/s and is refused twice, 3 periods of the middle 0.14 s later."""
    policy = Policy(agent(memory_s=9.0))
    policy.act(OPEN, AHEAD, [0.6, 0.0])
    for _ in range(2):
        policy.act(None, AHEAD, [0.6, 0.0])
    with patch.object(RememberedRanges, "observe", return_value=np.zeros(90, np.float32)) as observe:
        policy.act(OPEN, AHEAD, [0.6, 0.0])
    assert observe.call_args.args[3] == pytest.approx(3 * 0.14)


# ------------------------------------------------------------------------------------------------ bad input
GOOD: dict[str, Any] = {"ranges": OPEN, "waypoints": AHEAD, "velocity": STANDING, "beta": -1.0}
NAN, TURN = math.nan, 2 * math.pi
LOST = Sectors(OPEN, np.arange(180) >= 10)
BAD: list[tuple[dict[str, Any], str]] = [
    ({"ranges": None}, "^ranges are missing: give numbers"),
    ({"ranges": "far"}, "ranges are not numbers"),
    ({"ranges": OPEN[:179]}, r"ranges have shape \[179\]"),
    ({"ranges": np.where(np.arange(180) == 3, NAN, OPEN)}, "hold NaN"),
    ({"ranges": np.zeros(180)}, "below 0.01 m is no measurement"),
    ({"ranges": -OPEN}, "below 0.01 m is no measurement"),
    ({"ranges": np.full(180, 1500.0)}, "not in metres"),
    ({"ranges": LOST}, "23 % of the range bins this agent sees are not measured, more than 10 %"),
    ({"ranges": Scan(np.full(360, 1.0), 0.0, TURN / 360, 0.1, 2.0)}, "reaches so far"),
    ({"ranges": Scan(np.full(360, NAN), 0.0, TURN / 360, 0.1, 5.0)}, "100 % of the range bins"),
    ({"waypoints": None}, "^waypoints are missing: give numbers"),
    ({"velocity": None}, "^velocity is missing: give numbers"),
    ({"waypoints": []}, r"waypoints have shape \[0\]"),
    ({"waypoints": [[1.0, NAN], [1.0, 1.0]]}, "waypoints are not all finite"),
    ({"waypoints": [[1500.0, 0.0], [1.0, 1.0]]}, "out of sight"),
    ({"velocity": [0.1]}, r"velocity has shape \[1\]"),
    ({"velocity": [math.inf, 0.0]}, "velocity is not finite"),
    ({"velocity": [0.0, 45.0]}, "not in m/s and rad/s"),
    ({"beta": NAN}, "beta is no finite number"),
    ({"beta": "averse"}, "beta is no finite number"),
    ({"beta": 10**400}, "beta is no finite number"),
    ({"beta": 0.5}, r"beta=0.5 is outside \[-2, 0\]"),
    ({"collision_weight": 1.0}, "collision_weight=1 means nothing to this agent"),
    ({"stamps": at(20.0, 0.5)}, "scan_s is 0.50 s old, more than 0.35 s"),
    ({"stamps": replace(at(20.0), velocity_s=19.0)}, "velocity_s is 1.00 s old"),
    ({"stamps": replace(at(20.0), waypoints_s=21.0)}, "waypoints_s is 1.00 s in the future"),
    ({"stamps": at(NAN)}, "now_s is no finite number"),
]


@pytest.mark.parametrize(("change", "reason"), BAD)
def test_bad_input_stops_the_robot(change: dict[str, Any], reason: str) -> None:
    policy = Policy(agent())
    assert not policy.act(**GOOD).stopped
    command = policy.act(**(GOOD | change))
    assert (command.v_m_per_s, command.omega_rad_per_s, command.stopped) == (0.0, 0.0, True)
    assert command.quantiles is None
    with pytest.raises(AssertionError, match=reason):
        raise AssertionError(command.reason)
    assert command.reason.endswith("; it stands until good input comes")
    assert not policy.act(**GOOD).stopped


def test_agents_without_beta_refuse_one_that_is_not_theirs() -> None:
    dsac, sac = (Policy(agent(**ROWS[name])) for name in ("dsac_pow", "sac"))
    assert dsac.act(OPEN, AHEAD, STANDING, -1.0).fresh
    assert "means nothing to this agent" in str(dsac.act(OPEN, AHEAD, STANDING, -0.5).reason)
    assert "means nothing to this agent" in str(sac.act(OPEN, AHEAD, STANDING, -1.0).reason)


def test_a_few_lost_bins_read_as_nothing_there() -> None:
    lost = np.where(np.arange(180) == 5, 1.0, OPEN)
    command = Policy(agent()).act(Sectors(lost, np.arange(180) != 5), AHEAD, STANDING)
    assert command.wanted == Policy(agent()).act(OPEN, AHEAD, STANDING).wanted
    strict = Policy(agent(), limits=InputLimits(max_lost_share=0.0))
    assert strict.act(Sectors(lost, np.arange(180) != 5), AHEAD, STANDING).stopped


@pytest.mark.parametrize(("increment", "turned_deg", "drives"), [(1, -18, True), (1, -40, False), (-1, 18, True)])
def test_what_a_turning_scanner_leaves_out_ahead_is_no_blindness(increment: int, turned_deg: int, drives: bool) -> None:
    """A sweep that begins ahead, on a robot that turns against it: at 5 Hz and 90 degrees/s 18 degrees are left out."""
    turned = Mount(yaw_rad=math.radians(turned_deg))
    scan = Scan(np.full(360, 2.0), 0.0, math.radians(increment), 0.1, 10.0, end_mount=turned)
    lost = np.count_nonzero(~scan_sectors(scan).covered)
    assert lost == pytest.approx(abs(turned_deg) / 2.0, abs=1.0)
    assert lost > 0.1 * 43
    command = Policy(agent()).act(scan, AHEAD, STANDING)
    assert command.stopped is not drives
    still = Scan(np.where(np.arange(360) < 18, np.nan, 2.0), 0.0, math.radians(increment), 0.1, 10.0)
    assert "not measured" in str(Policy(agent()).act(still, AHEAD, STANDING).reason)


def test_one_waypoint_stands_for_both() -> None:
    goal = [1.0, 0.5]
    wanted = [Policy(agent(), guard=None).act(OPEN, w, STANDING).wanted for w in (goal, [goal], [goal, goal])]
    assert wanted[0] == wanted[1] == wanted[2]


def test_three_refusals_clear_the_memory_and_the_clock() -> None:
    policy = Policy(agent())
    policy.act(**GOOD, stamps=at(100.0))
    for number in range(3):
        back = policy.act(**GOOD, stamps=at(10.0 + PERIOD_S * number))
        assert "goes back by" in str(back.reason)
    again = policy.act(**GOOD, stamps=at(10.5))
    assert again.fresh
    assert again.forgot


def test_stop_holds_until_resume() -> None:
    policy = Policy(agent())
    policy.stop()
    command = policy.act(**GOOD)
    assert command.stopped
    assert command.reason == "stop() was called; resume() ends it"
    policy.reset()
    assert policy.act(**GOOD).stopped
    policy.resume()
    assert not policy.act(**GOOD).stopped


def test_a_repeated_scan_holds_the_command_and_is_guarded_anew() -> None:
    policy = Policy(full_size())
    first = policy.act(**GOOD, stamps=at(10.0))
    wall = np.full(180, 0.26)
    same_scan = replace(at(10.14), scan_s=9.95)
    held = policy.act(**(GOOD | {"ranges": wall}), stamps=same_scan)
    assert (held.fresh, held.wanted, held.v_m_per_s) == (False, first.wanted, 0.0)
    early = policy.act(**GOOD, stamps=at(10.15, 0.0))  # its scan is new, and the last one that was seen is 0.15 s old
    assert early.fresh
    assert not policy.act(**GOOD, stamps=at(10.17, 0.0)).fresh


numbers = st.floats(allow_nan=True, allow_infinity=True, width=32)
anything = st.one_of(
    st.none(),
    st.text(max_size=5),
    numbers,
    st.integers(),
    st.lists(numbers, max_size=5),
    st.lists(st.lists(numbers, min_size=2, max_size=2), max_size=3),
    st.lists(st.one_of(st.text(max_size=2), st.lists(numbers, max_size=2)), max_size=3),
    st.dictionaries(st.text(max_size=2), numbers, max_size=2),
    st.binary(max_size=4),
)
ranges = st.one_of(
    anything,
    st.lists(numbers, min_size=180, max_size=180),
    st.builds(Scan, st.lists(numbers, max_size=50), numbers, numbers, numbers, numbers),
    st.builds(Sectors, st.just(OPEN), st.lists(st.booleans(), min_size=180, max_size=180).map(np.array)),
)
stamps = st.one_of(st.none(), st.builds(Stamps, numbers, numbers, numbers, numbers))


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(ranges, anything, anything, anything, stamps), min_size=1, max_size=6))
def test_garbage_never_raises_and_never_drives_wildly(calls: list[tuple]) -> None:
    policy = Policy(agent())
    for ranges, waypoints, velocity, beta, stamp in calls:
        command = policy.act(ranges, waypoints, velocity, beta, stamps=stamp)
        assert -0.2 <= command.v_m_per_s <= 0.6
        assert abs(command.omega_rad_per_s) <= math.pi / 2 + 1e-12
        if command.stopped:
            assert (command.v_m_per_s, command.omega_rad_per_s) == (0.0, 0.0)
            assert command.reason
    assert not policy.act(**GOOD).stopped


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(["good", "dropped", "late", "repeated", "swapped"]), st.floats(0.0, 0.3))))
def test_trouble_on_the_way_stops_or_holds_and_good_input_drives_on(events: list[tuple[str, float]]) -> None:
    policy = Policy(agent())
    now, scan = 50.0, 50.0
    last = policy.act(**GOOD, stamps=Stamps(now, scan, now, now))
    for event, wait in events:
        now += 0.1 + wait
        if event == "dropped":
            command = policy.act(**(GOOD | {"ranges": None}), stamps=at(now, 0.0))
            assert command.stopped
            continue
        if event == "late":
            assert policy.act(**GOOD, stamps=Stamps(now, now - 0.4, now, now)).stopped
            continue
        before = scan
        scan = scan if event == "repeated" else now
        stamp = Stamps(now, before - 1.0 if event == "swapped" else scan, now, now)
        command = policy.act(**GOOD, stamps=stamp)
        if event == "swapped":
            scan = before
            assert command.stopped
        elif event == "good":
            assert not command.stopped
        elif not command.stopped and not command.fresh:
            assert command.wanted == last.wanted
        last = command if not command.stopped else last


def test_wrong_options_are_refused() -> None:
    for odd in (0, -3, 2.5, True, math.nan, "8", None):
        with pytest.raises(UserInputError, match=f"num_quantiles={odd}"):
            Policy(agent(), num_quantiles=odd)  # type: ignore[arg-type]
    assert len(Policy(agent(), num_quantiles=np.int64(3)).fractions) == 3  # type: ignore[arg-type]
    with pytest.raises(UserInputError, match="max_age_s=0"):
        InputLimits(max_age_s=0.0)
    with pytest.raises(UserInputError, match="max_lost_share=1"):
        InputLimits(max_lost_share=1.0)


def test_the_quantiles_that_are_told_never_cross() -> None:
    """Those of these drawn networks do: as they are, the lower ones of two critics do not rise."""
    weights = full_size(seed=3)
    policy, module = Policy(weights, guard=None), CriticStep(weights, torch.from_numpy(Policy(weights).fractions))
    told = policy.act(np.full(180, 1.0), AHEAD, STANDING, -1.0).quantiles
    assert told is not None
    assert (np.diff(told) >= 0.0).all()
    head, memory = module.heads[0], torch.zeros(1, 1, 128)
    raw = head(memory, torch.zeros(1, 1, 2), module.fractions, torch.full((1, 1, 1), -1.0))
    assert (raw.diff() < 0.0).any()
