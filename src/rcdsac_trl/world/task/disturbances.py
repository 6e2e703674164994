"""What a real robot has and a simulated one lacks: noise, a pose that is off, actions that come late, slow motors."""

import math
from dataclasses import dataclass

import numpy as np

from rcdsac_trl.world.task.rules import TaskSettings

POSE_ERROR_S = 2.0
"""Time in which a pose error falls to 1/e of what it was: a localisation is off one way for a while."""

Pose = tuple[float, float, float]


@dataclass(frozen=True)
class Disturbances:
    """The disturbances of one episode.

    Attributes:
        stop_zone: whether one stands between agent and wheels; the others are those of
            :class:`~rcdsac_trl.world.task.rules.TaskSettings`.
    """

    range_noise_std_m: float
    range_dropout: float
    odometry_noise_std: tuple[float, float]
    pose_noise_std: tuple[float, float]
    action_delay_steps: int
    motor_slowness: float
    stop_zone: bool


def draw_disturbances(task: TaskSettings, rng: np.random.Generator) -> Disturbances:
    """Return an episode's disturbances: as the task has them, or with ``drawn`` each a uniform share of that.

    Args:
        task: what they are, or may be at most.
        rng: a stream of their own.

    Example:
        >>> task = TaskSettings(range_noise_std_m=0.02, action_delay_steps=2, disturbances="drawn")
        >>> drawn = draw_disturbances(task, np.random.default_rng(0))
        >>> 0.0 <= drawn.range_noise_std_m <= 0.02, drawn.action_delay_steps in (0, 1, 2), drawn.motor_slowness
        (True, True, 0.0)
    """
    if task.disturbances == "fixed":
        shares, delay = [1.0] * 5, task.action_delay_steps
    else:
        shares, delay = rng.random(5).tolist(), int(rng.integers(task.action_delay_steps + 1))
    return Disturbances(
        range_noise_std_m=shares[0] * task.range_noise_std_m,
        range_dropout=shares[1] * task.range_dropout,
        odometry_noise_std=_scaled(task.odometry_noise_std, shares[2]),
        pose_noise_std=_scaled(task.pose_noise_std, shares[3]),
        action_delay_steps=delay,
        motor_slowness=shares[4] * task.motor_slowness,
        stop_zone=bool(rng.random() < task.stop_zone_share),
    )


def _scaled(pair: tuple[float, float], share: float) -> tuple[float, float]:
    return share * pair[0], share * pair[1]


class PoseError:
    """How far a localisation is off: normal at every moment, and about the same a moment later.

    An Ornstein-Uhlenbeck process with :data:`POSE_ERROR_S`; without an error nothing is drawn.

    Args:
        std: standard deviations along x and along y, m, and of the heading, rad.
        rng: the error's own stream.
    """

    def __init__(self, std: tuple[float, float], rng: np.random.Generator) -> None:
        self._std = np.array([std[0], std[0], std[1]])
        self._rng = rng
        # Asked in every step: a plain truth, where a call of NumPy would cost more than the rest.
        self._is_off = any(std)
        self._off = self._drawn() if self._is_off else np.zeros(3)

    def step(self, elapsed_s: float) -> None:
        """Let time pass."""
        if self._is_off:
            kept = math.exp(-elapsed_s / POSE_ERROR_S)
            self._off = kept * self._off + math.sqrt(1.0 - kept * kept) * self._drawn()

    def added_to(self, pose: Pose) -> Pose:
        """Return where the robot believes to be, m and rad."""
        if not self._is_off:
            return pose
        x, y, yaw = self._off.tolist()
        return pose[0] + x, pose[1] + y, pose[2] + yaw

    def _drawn(self) -> np.ndarray:
        return self._std * self._rng.standard_normal(3)
