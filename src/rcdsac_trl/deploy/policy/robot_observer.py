"""What an agent's networks read of a robot: what it senses now, what it saw before, and what it was told last."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.policy.agent_config import AgentConfig
from rcdsac_trl.robot.latency import Ahead, Latency, at_once, check_latency
from rcdsac_trl.robot.observation import AT_ORIGIN, range_observation, waypoint_observation
from rcdsac_trl.robot.sectors import Sectors

if TYPE_CHECKING:
    from rcdsac_trl.robot.remembered_ranges import RememberedRanges


def _memory_of(config: AgentConfig) -> "RememberedRanges | None":
    """Make what remembers for an agent, if anything does; alone of all that drives a robot, that needs numba."""
    if config.memory_s == 0.0:
        return None
    from rcdsac_trl.robot.remembered_ranges import RememberedRanges

    return RememberedRanges(config.sensor_mask, config.memory_s, config.robot)


class RobotObserver:
    """Makes an agent's observations of what a robot measures; environments make their own.

    Args:
        config: of the agent.
        latency_s: from a measurement until the command that follows it acts, s: waypoints, velocities and what is
            remembered are then told as they will be; the range bins stay as they are.

    Attributes:
        mask: which range bins the agent is told, bool [180].
        commanded: what the robot was told last, m/s and rad/s.
    """

    def __init__(self, config: AgentConfig, latency_s: float = 0.0) -> None:
        check_latency(latency_s, config.memory_s)
        self.mask, self._robot = config.sensor_mask, config.robot
        self._latency = Latency(latency_s, config.robot) if latency_s else None
        self._remembered = _memory_of(config)
        self.forget()

    def forget(self) -> None:
        """Forget what was seen before; the robot stands."""
        if self._remembered is not None:
            self._remembered.reset()
        if self._latency is not None:
            self._latency.reset()
        self.commanded = (0.0, 0.0)

    def note(self, command: tuple[float, float], at_s: float) -> None:
        """Take down what the robot is told, m/s and rad/s, on what was measured at a time."""
        self.commanded = command
        if self._latency is not None:
            self._latency.note(command, at_s)

    def ahead(self, measured: tuple[float, float], at_s: float) -> Ahead:
        """Return where the robot will be when the command that follows a measurement begins to act.

        Args:
            measured: velocities, m/s and rad/s.
            at_s: when they were measured, s; read where there is a latency.
        """
        return at_once(measured) if self._latency is None else self._latency.ahead(measured, at_s)

    def observe(
        self,
        sectors: Sectors,
        waypoints: tuple[tuple[float, float], tuple[float, float]],
        measured: tuple[float, float],
        elapsed_s: float,
        ahead: Ahead,
    ) -> tuple[NDArray[np.float32], list[float]]:
        """Return the range observation, float32 [180], and all vector observations, one behind the other.

        Args:
            sectors: what the range sensor says.
            waypoints: the next two, x and y in m, robot's frame.
            measured: velocities, m/s and rad/s.
            elapsed_s: since the last observation, 0 at the first, s.
            ahead: where the robot will be, as :meth:`ahead` says.
        """
        bins = range_observation(sectors.distances_m, self.mask, self._robot.lidar.max_range_m)
        if self._latency is not None:
            first, second = ahead.seen(np.array(waypoints)).tolist()
            waypoints = tuple(first), tuple(second)
        vectors = [*waypoint_observation(AT_ORIGIN, *waypoints), *ahead.velocities, *self.commanded]
        if self._remembered is not None:
            distances_m, covered = sectors.distances_m, sectors.covered
            told = None if self._latency is None else ahead
            vectors += self._remembered.observe(distances_m, *measured, elapsed_s, covered, told).tolist()
        return bins, vectors
