"""Baselines by name: what ``baseline=`` of an evaluation may be."""

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from rcdsac_trl.config.baseline_name import PURSUIT, OwnClass, own_class
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.limits import MEAN_PERIOD_S
from rcdsac_trl.robot.observation import AT_ORIGIN, waypoint_observation
from rcdsac_trl.robot.range_sensor import NUM_BINS
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.rollout.planners.controller import Controller, ControllerPolicy
from rcdsac_trl.rollout.planners.dwa import Dwa, DwaSettings
from rcdsac_trl.rollout.planners.mppi import Mppi, MppiSettings
from rcdsac_trl.rollout.policies import PursuitPolicy

_PLANNERS: Mapping[str, Callable[[RobotSettings], Controller]] = {
    "dwa": lambda robot: Dwa(robot=robot),
    "mppi": lambda robot: Mppi(robot=robot),
}
_SETTINGS: Mapping[str, Callable[[], Any]] = {"dwa": DwaSettings, "mppi": MppiSettings}


def baseline_policy(
    name: str, *, sensor: str, agent_ids: Sequence[int], seed: int, robot: RobotSettings = PAPER
) -> TensorDictModuleBase:
    """Return the policy of a baseline.

    Args:
        name: ``pursuit``, ``dwa``, ``mppi``, or ``<module>:<class>``, a class as
            :class:`rcdsac_trl.rollout.planners.controller.Controller` describes it.
        sensor: one of :data:`rcdsac_trl.robot.range_sensor.SENSORS`.
        agent_ids: numbers of the agents.
        seed: root seed of what is random.
        robot: that it drives.

    Raises:
        UserInputError: if there is no such baseline.
    """
    if name == PURSUIT:
        return PursuitPolicy(robot)
    own = own_class(name)
    make = partial(_PLANNERS[name], robot) if own is None else _imported(name, own)
    return ControllerPolicy(make, name, robot.sensor_mask(sensor), agent_ids, seed, robot)


def check_baseline(name: str, sensor: str, robot: RobotSettings = PAPER) -> None:
    """Refuse a baseline that cannot drive: let it drive one step with nothing around.

    Raises:
        UserInputError: if there is no such baseline, it cannot be made, or it answers no two velocities.
    """
    policy = baseline_policy(name, sensor=sensor, agent_ids=[0], seed=0, robot=robot)
    if not isinstance(policy, ControllerPolicy) or own_class(name) is None:
        return
    policy.set_periods([MEAN_PERIOD_S])
    ahead = waypoint_observation(AT_ORIGIN, (5.0, 0.0), (5.0, 0.0))
    seen = {
        "range": torch.zeros(1, NUM_BINS),
        "waypoint": torch.tensor([ahead]),
        "velocity": torch.zeros(1, 4),
        "is_init": torch.ones(1, 1, dtype=torch.bool),
    }
    try:
        policy(TensorDict(seen, [1]))
    except UserInputError:
        raise
    except Exception as error:
        raise _failed(name, "drive a first step", error) from error


def settings_of(name: str) -> dict[str, Any]:
    """Return what one of our planners looks at and what counts for it; empty for others."""
    return {"baseline": asdict(_SETTINGS[name]())} if name in _SETTINGS else {}


def _imported(name: str, own: OwnClass) -> Callable[[], Controller]:
    """Return what makes a user's controller, after it has made one."""
    try:
        module = importlib.import_module(own.module)
    except Exception as error:
        raise _failed(name, f"import {own.module}", error) from error
    make: Any = getattr(module, own.name, None)
    if make is None:
        raise UserInputError(f"baseline={name}: module {own.module} has no {own.name}")
    try:
        made = make()
    except Exception as error:
        raise _failed(name, f"call {own.name}() without arguments", error) from error
    lacking = [method for method in ("reset", "act") if not callable(getattr(made, method, None))]
    if lacking:
        raise UserInputError(
            f"baseline={name} has no {lacking[0]}(): a controller has reset(sensed, rng, period_s) and "
            "act(ranges_m, waypoints_m, velocity)"
        )
    return make


def _failed(name: str, tried: str, error: Exception) -> UserInputError:
    return UserInputError(f"baseline={name}: cannot {tried}: {type(error).__name__}: {error}")
