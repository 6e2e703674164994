"""Who drives the course, and at which betas."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import rcdsac_trl
from rcdsac_trl.config.course_settings import CourseSettings
from rcdsac_trl.deploy import Guard, InputLimits, Policy, shipped_names
from rcdsac_trl.deploy.navigation.static_layer import StaticLayer
from rcdsac_trl.deploy.policy.registry import HANDFUL
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.course.camera_rig import camera_poses, covered
from rcdsac_trl.evaluation.course.course_drive import Pilot
from rcdsac_trl.evaluation.course.pursuit_pilot import PursuitPilot
from rcdsac_trl.robot.robot_settings import PAPER
from rcdsac_trl.rollout.navigation import navigator_of
from rcdsac_trl.world.office.building import make_office

# What the paper's second table sets each measure to.
_PAPER_BETAS = {"cvar": (0.25, 0.75), "pow": (-2.0, -1.0)}


@dataclass(frozen=True)
class Entry:
    """Who drives, and in which context.

    Attributes:
        run: as it was named: a folder, a shipped agent, or ``"pursuit"``.
        agent: row of the paper's table, or ``"pursuit"``.
        beta: how much risk it takes; of an agent that was trained for one, that one; None where there is none.
        context: the beta that it is given; None for none.
        pilot: the driver.
    """

    run: str
    agent: str
    beta: float | None
    context: float | None
    pilot: Pilot

    @property
    def name(self) -> str:
        """Who it is, for people and for file names."""
        return self.agent if self.beta is None else f"{self.agent} beta={self.beta:g}"


def entries_of(settings: CourseSettings) -> list[Entry]:
    """Return who drives: every agent at each of its betas, then the baseline.

    Raises:
        UserInputError: for an agent that is missing or sees what the cameras do not, or a beta outside its range.
    """
    runs = settings.runs
    if not runs and settings.baseline is None:
        runs = tuple(name for name in HANDFUL if name in shipped_names())
        if not runs:
            raise UserInputError(
                "no agent is shipped with this version: name who drives with run=<folder> or baseline=pursuit"
            )
    policies = {run: rcdsac_trl.load(run, guard=None) for run in runs}
    static_layer = _static_layer(settings) if settings.navigation.static_layer else None
    for run, policy in policies.items():
        if policy.robot != PAPER:
            raise UserInputError(
                f"run={run} drives robot={policy.robot.name}, and the course is the paper's robot's: name an agent of "
                "robot=paper"
            )
        policy.guard = None if settings.guard_margin_m is None else Guard(margin_m=settings.guard_margin_m)
        policy.acting = settings.acting.of(policy.acting)
        policy.navigator = navigator_of(settings.navigation, policy.robot, static_layer)
        check_sensor(run, policy, settings.camera.view_deg)
    conditioned = [run for run, policy in policies.items() if policy.config.context == "beta"]
    if settings.beta is not None and not conditioned:
        raise UserInputError(f"beta={list(settings.beta)} means nothing to who drives: leave it out")
    entries = [entry for run, policy in policies.items() for entry in _of_policy(run, policy, settings.beta)]
    if settings.baseline is not None:
        entries.append(Entry("pursuit", "pursuit", None, None, PursuitPilot()))
    return entries


def _static_layer(settings: CourseSettings) -> StaticLayer:
    """Return what the planner's map shows of the office."""
    map_ = make_office(settings.people, settings.hollow).map
    return StaticLayer.of_shapes(map_.segments(mapped_only=True), map_.circles(mapped_only=True))


def _of_policy(run: str, policy: Policy, betas: Sequence[float] | None) -> list[Entry]:
    config = policy.config
    if config.context != "beta" or config.context_range is None:
        return [Entry(run, config.name, config.fixed_beta, None, policy)]
    if betas is None:
        assert policy.default_beta is not None
        betas = _PAPER_BETAS.get(config.measure, (policy.default_beta,))
    if not betas:
        raise UserInputError("beta=[] leaves nothing to drive with: name one or more, or leave it out")
    low, high = config.context_range
    for beta in betas:
        if not low <= beta <= high:
            raise UserInputError(f"beta={beta:g} is outside [{low:g}, {high:g}], where run={run} was trained")
    return [Entry(run, config.name, beta, beta, policy) for beta in betas]


def check_sensor(run: str, policy: Policy, view_deg: float) -> None:
    """Refuse an agent that the cameras leave in the dark; its policy would only stand.

    Raises:
        UserInputError: naming the share of its sectors that they cover.
    """
    mask = policy.config.sensor_mask
    lost = np.count_nonzero(mask & ~covered(camera_poses(view_deg))) / np.count_nonzero(mask)
    if lost > InputLimits().max_lost_share:
        raise UserInputError(
            f"run={run} sees with sensor={policy.config.sensor}, of which the four cameras cover "
            f"{100 * (1 - lost):.0f} %: name an agent of sensor=narrow, or widen camera.view_deg"
        )
