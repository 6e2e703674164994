"""Whatever is handed to a policy, it answers: with the numbers that are there, or with why the robot stands."""

import copy
import math
import pickle
from dataclasses import asdict
from decimal import Decimal
from fractions import Fraction
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from rcdsac_trl.deploy import CameraPose, Policy, Scan, Sectors, Stamps, Weights, cloud_sectors
from rcdsac_trl.deploy.sensors.arrays import numbers_of
from rcdsac_trl.errors import UserInputError
from robots import AHEAD, OPEN, ROWS, STANDING, agent

ALL = np.ones(180, dtype=bool)
LEFT = np.arange(180) < 90


class Foreign:
    """What another library's array may do: anything."""

    def __init__(self, error: BaseException | None = None, values: Any = 2.0, **attributes: Any) -> None:
        self.error, self.values = error, values
        self.__dict__.update(attributes)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        if self.error is not None:
            raise self.error
        return np.full(180, self.values, dtype)


class Wordless(Exception):
    def __str__(self) -> str:
        raise RuntimeError


class Hostile:
    """Raises whatever it is asked."""

    def __getattribute__(self, name: str) -> Any:
        raise RuntimeError(name)


class Endless(list):
    def __iter__(self) -> Any:
        raise RecursionError


def given(**change: Any) -> dict[str, Any]:
    return {"ranges": OPEN, "waypoints": AHEAD, "velocity": STANDING, "beta": -1.0} | change


def turned(ranges: np.ndarray, **more: Any) -> Scan:
    return Scan(ranges, -math.pi, 2.0 * math.pi / 360, 0.1, 12.0, **more)


# ------------------------------------------------------------------------------------------------ what is read
@pytest.mark.parametrize(
    ("name", "plain", "odd"),
    [
        ("ranges", np.full(180, 2.0), torch.full((180,), 2.0, requires_grad=True)),
        ("ranges", np.full(180, 2.0), torch.full((180,), 2.0, dtype=torch.float16)),
        ("ranges", np.full(180, 2.0), [torch.tensor(2.0)] * 180),
        ("ranges", np.full(180, 2.0), pd.Series(np.full(180, 2.0))),
        ("ranges", np.full(180, 2.0), np.full(180, 2, np.uint8)),
        ("ranges", np.full(180, 2.0), np.full(180, 2.0, ">f4")),
        ("ranges", np.full(180, 2.0), np.ma.array(np.full(180, 2.0), mask=False)),
        ("ranges", np.full(180, 2.0), Foreign(values=2.0)),
        ("ranges", np.full(180, 2.0), turned(torch.full((360,), 2.0, requires_grad=True))),
        ("ranges", np.full(180, 2.0), turned(pd.Series(np.full(360, 2.0)))),
        ("ranges", np.full(180, 2.0), Sectors(torch.full((180,), 2.0), torch.ones(180, dtype=torch.bool))),
        ("waypoints", AHEAD, torch.tensor(AHEAD, requires_grad=True)),
        ("waypoints", AHEAD, pd.DataFrame(AHEAD, columns=["x", "y"])),
        ("waypoints", AHEAD, tuple(map(np.array, AHEAD))),
        ("velocity", [0.25, 0.5], torch.tensor([0.25, 0.5], requires_grad=True)),
        ("velocity", [0.25, 0.5], np.array([0.25, 0.5], np.float16)),
        ("beta", -1.0, np.float32(-1.0)),
        ("beta", -1.0, -1),
        ("beta", -1.0, np.int64(-1)),
    ],
)
def test_numbers_of_any_library_are_read_as_they_are(name: str, plain: Any, odd: Any) -> None:
    expected, found = (Policy(agent()).act(**given(**{name: value})) for value in (plain, odd))
    assert found.reason is None
    assert found.wanted == expected.wanted


def test_read_only_arrays_are_read_and_nothing_given_is_changed() -> None:
    values = given(ranges=np.full(180, 2.0), waypoints=np.array(AHEAD), velocity=np.array(STANDING))
    for value in (values["ranges"], values["waypoints"], values["velocity"]):
        value.flags.writeable = False
    assert Policy(agent()).act(**values).reason is None
    ranges = np.where(np.arange(360) % 3, [5.0, -math.inf, 20.0] * 120, 0.0)
    before = ranges.copy()
    Policy(agent()).act(**given(ranges=turned(ranges, zero_means="far")))
    np.testing.assert_array_equal(ranges, before)


# ------------------------------------------------------------------------------------------------ what is masked
@pytest.mark.parametrize(
    "ranges",
    [
        np.ma.array(np.full(180, 2.0), mask=LEFT),
        np.ma.array(np.full(180, 2, np.int16), mask=LEFT),
        Sectors(np.ma.array(np.full(180, 2.0), mask=LEFT), ALL),
        Sectors(np.full(180, 2.0), np.ma.array(ALL, mask=LEFT)),
        turned(np.ma.array(np.full(360, 2.0), mask=np.arange(360) >= 180)),
    ],
)
def test_what_is_masked_was_not_measured(ranges: Any) -> None:
    command = Policy(agent()).act(**given(ranges=ranges))
    assert command.stopped
    assert "49 % of the range bins this agent sees are not measured" in str(command.reason)


def test_a_few_masked_ranges_read_as_nothing_there() -> None:
    near = np.where(np.arange(180) == 5, 0.3, 2.0)
    found = Policy(agent()).act(**given(ranges=np.ma.array(near, mask=np.arange(180) == 5)))
    expected = Policy(agent()).act(**given(ranges=Sectors(near, np.arange(180) != 5)))
    assert found.wanted == expected.wanted


@pytest.mark.parametrize(
    "change",
    [
        {"velocity": np.ma.array([0.1, 0.0], mask=[False, True])},
        {"velocity": [0.1, np.ma.masked]},
        {"waypoints": np.ma.array(AHEAD, mask=[[False, False], [True, False]])},
        {"waypoints": [np.ma.array([2.0, 0.0], mask=[True, False]), np.ma.array([4.0, 0.0])]},
        {"ranges": [np.ma.array(2.0, mask=True)] * 180},
    ],
)
def test_a_masked_number_among_those_that_must_be_there_stops_the_robot(change: dict[str, Any]) -> None:
    command = Policy(agent()).act(**given(**change))
    assert command.stopped
    assert "finite" in str(command.reason) or "hold NaN" in str(command.reason)


def test_masked_points_of_a_cloud_are_left_out() -> None:
    wall = np.stack(np.meshgrid([1.0], np.linspace(-1, 1, 99), np.linspace(0, 1, 9)), -1)
    wall[0, 0] = 0.5
    cloud = np.ma.array(wall, mask=wall == 0.5)
    assert cloud_sectors([(cloud, CameraPose((0.0, 0.0, 0.0)))]).distances_m.min() == pytest.approx(1.0)


# ------------------------------------------------------------------------------------------------ what is refused
ODD = [
    (Foreign(RuntimeError("device lost\nsecond line")), "a Foreign gives RuntimeError: device lost"),
    (Foreign(Wordless()), "a Foreign gives Wordless"),
    (Foreign(MemoryError()), "a Foreign gives MemoryError"),
    (Foreign(unit="mm"), "carry a unit (mm)"),
    (Foreign(units="millimeter"), "carry a unit (millimeter)"),
    (Foreign(values=1.0 + 1.0j), "are not numbers but complex128"),
    (torch.full((180,), 2.0, dtype=torch.bfloat16), "a Tensor gives TypeError"),
    (torch.full((180,), 2.0, device="meta"), "a Tensor gives"),
    (torch.eye(180).to_sparse(), "a Tensor gives TypeError"),
    (np.full(180, 2.0, object), "are not numbers but object"),
    (np.full(180, Decimal(2)), "are not numbers but object"),
    (np.full(180, Fraction(2)), "are not numbers but object"),
    (np.full(180, None), "are not numbers but object"),
    ([2.0] * 179 + [None], "are not numbers but object"),
    (np.full(180, "2.0"), "are not numbers but <U3"),
    ([b"2.0"] * 180, "are not numbers but |S3"),
    (np.full(180, 2.0 + 0.0j), "are not numbers but complex128"),
    ([True] * 180 + [1.0j], "are not numbers but complex128"),
    (np.zeros(180, [("range", "f8")]), "are not numbers but [('range', '<f8')]"),
    (np.full(180, 2, "m8[s]"), "are not numbers but timedelta64[s]"),
    (np.full(180, np.longdouble("1e400")), "FloatingPointError"),
    ([10**400] * 180, "are not numbers but object"),
    (np.array(250.0), "have shape []"),
    (250.0, "have shape []"),
    (np.full((180, 1), 2.0), "have shape [180, 1]"),
    ([[2.0], [2.0, 2.0]], "a list gives ValueError"),
    (iter([2.0] * 180), "are not numbers but object"),
    ({"ranges": 2.0}, "are not numbers but object"),
    (pd.Series([2.0] * 179 + [None], dtype="Float64"), "hold NaN"),
    (range(10**12), "are 1000000000000, more than 20000000: no sensor gives so many"),
    (np.broadcast_to(np.float32(2.0), (10**9,)), "are 1000000000, more than 20000000"),
    (Endless([2.0]), ""),
    (Hostile(), ""),
    (type, ""),
    (Ellipsis, ""),
]


@pytest.mark.parametrize(("odd", "told"), ODD, ids=[str(number) for number in range(len(ODD))])
def test_what_cannot_be_read_stops_the_robot_and_says_why(odd: Any, told: str) -> None:
    policy = Policy(agent())
    assert told in str(policy.act(**given(ranges=odd)).reason)
    for change in (
        {"ranges": odd},
        {"ranges": turned(odd)},
        {"ranges": Sectors(odd, ALL)},
        {"ranges": Sectors(OPEN, odd)},
        {"waypoints": odd},
        {"velocity": odd},
        {"velocity": [odd, 0.0]},
        {"beta": odd},
        {"beta": None, "collision_weight": odd},
        {"stamps": odd},
        {"stamps": Stamps(odd, 1.0, 1.0, 1.0)},
        {"stamps": Stamps(1.0, odd, 1.0, 1.0)},
    ):
        command = policy.act(**given(**change))
        assert (command.v_m_per_s, command.omega_rad_per_s, command.stopped) == (0.0, 0.0, True)
        assert str(command.reason).isprintable()
    assert policy.act(**given()).reason is None


@pytest.mark.parametrize("change", [{"ranges": ALL}, {"ranges": Sectors(ALL, ALL)}, {"velocity": [False, False]}])
def test_true_is_not_1_m(change: dict[str, Any]) -> None:
    assert "not numbers but bool" in str(Policy(agent()).act(**given(**change)).reason)


@pytest.mark.parametrize(
    "scan",
    [
        turned(np.full(360, 2.0), mount=None),
        turned(np.full(360, 2.0), zero_means=None),
        Scan(np.full(360, 2.0), None, 0.017, 0.1, 12.0),  # type: ignore[arg-type]
        Scan(np.full(360, 2.0), 0.0, "0.017", 0.1, 12.0),  # type: ignore[arg-type]
        Scan(np.full(360, 2.0), 0.0, 0.017, 0.1, np.array([12.0])),  # type: ignore[arg-type]
        Scan(np.full(360, 2.0), 0.0, 0.017, 0.1 + 0.0j, 12.0),  # type: ignore[arg-type]
        Scan(np.full(360, 2.0), True, 0.017, 0.1, 12.0),
    ],
)
def test_a_scan_with_an_odd_field_stops_the_robot(scan: Scan) -> None:
    assert Policy(agent()).act(**given(ranges=scan)).stopped


@pytest.mark.parametrize(
    "beta", [True, np.bool_(1), 1j, np.complex128(-1), np.timedelta64(-1), np.array(-1.0), "-1", []]
)
def test_a_beta_that_is_no_number_is_named_by_its_type(beta: Any) -> None:
    reason = str(Policy(agent()).act(**given(beta=beta)).reason)
    assert f"beta is no finite number ({type(beta).__name__}): give one, as a float" in reason


def test_an_interrupt_is_not_kept_from_the_program() -> None:
    with pytest.raises(KeyboardInterrupt):
        Policy(agent()).act(**given(ranges=Foreign(KeyboardInterrupt())))


def test_stamps_of_another_class_are_read_by_their_names() -> None:
    stamps: Any = SimpleNamespace(now_s=1.0, scan_s=1.0, waypoints_s=1.0, velocity_s=1.0)
    assert Policy(agent()).act(**given(stamps=stamps)).fresh


def test_an_action_to_foresee_may_need_a_gradient_and_must_be_numbers() -> None:
    policy = Policy(agent())
    policy.act(**given())
    expected = policy.foresee(-1.0, action=[0.5, -0.5]).value
    assert policy.foresee(-1.0, action=torch.tensor([0.5, -0.5], requires_grad=True)).value == expected
    for action in (np.ma.array([0.5, 0.5], mask=[True, False]), ["0.5", "0.5"], Foreign(RuntimeError()), [True, False]):
        with pytest.raises(UserInputError, match="action"):
            policy.foresee(-1.0, action=action)


def test_numbers_keep_their_values() -> None:
    for value in ([1, 2], (1.5, 2.5), np.array([1, 2], np.int64), [np.float32(0.1), 2], [[1, 2], [3, 4]], range(3)):
        np.testing.assert_array_equal(numbers_of(value, "numbers"), np.asarray(value, dtype=np.float64))


# ------------------------------------------------------------------------------------------------ copies
@pytest.mark.parametrize("row", ROWS)
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda thing: pickle.loads(pickle.dumps(thing))])
def test_weights_and_policies_are_copied_whole(row: str, copied: Any) -> None:
    weights = agent(**ROWS[row])
    again = copied(weights)
    assert again.config == weights.config
    assert again.tensors.keys() == weights.tensors.keys()
    assert all(np.array_equal(again.tensors[name], value) for name, value in weights.tensors.items())
    assert all(again.tensors[name] is not value for name, value in weights.tensors.items())
    with pytest.raises(TypeError):
        again.tensors["actor.head.output.bias"] = None
    policy = Policy(weights)
    policy.act(OPEN, AHEAD, STANDING)
    twin = copied(policy)
    ranges = np.full(180, 0.8)
    commands = [driver.act(ranges, AHEAD, [0.2, 0.1]) for driver in (policy, twin)]
    assert commands[0].wanted == commands[1].wanted
    assert commands[0].value == commands[1].value
    # From then on they go ways of their own.
    twin.reset()
    assert not policy.act(OPEN, AHEAD, STANDING).forgot
    assert twin.act(OPEN, AHEAD, STANDING).forgot


def test_weights_that_were_changed_on_the_way_are_refused() -> None:
    weights = agent()
    make, (config, tensors, _) = weights.__reduce__()
    assert make is Weights
    tensors.pop("actor.head.output.bias")
    with pytest.raises(UserInputError, match=r"differ in actor\.head\.output\.bias"):
        make(config, tensors)


def test_a_configuration_is_a_plain_dictionary_to_those_who_want_one() -> None:
    assert asdict(agent().config)["name"] == "rcdsac_pow"
