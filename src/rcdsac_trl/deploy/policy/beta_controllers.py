r"""Controllers that turn beta while an agent drives: bolder where there is room, more careful where there is none.

Each is called once in every control period, *before* :meth:`rcdsac_trl.deploy.Policy.act`, with what the sensor says
now and the quantiles of the command before, and returns the beta to drive with: its ``raw_quantiles``, so that an agent
that is recalibrated drives as the same agent without. A smaller beta is more averse, so ``low`` is the most careful one
that a controller uses, and ``high`` the boldest.
"""

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings

Array = NDArray[np.floating]


class BetaController(Protocol):
    """What turns beta."""

    def reset(self) -> None:
        """Begin an episode, or a new task: what was seen before says nothing any more."""

    def __call__(self, distances_m: Array, quantiles: Array | None) -> float:
        """Return the beta of this control period.

        Args:
            distances_m: of the range sensor, by sector, [180], ``inf`` where nothing is.
            quantiles: of the return, as the critics said them of the command before, [N]; None where there are none.
        """


class FixedBeta:
    """Always the same beta.

    Args:
        beta: that one.
    """

    def __init__(self, beta: float) -> None:
        self.beta = beta

    def reset(self) -> None:
        """Do nothing."""

    def __call__(self, distances_m: Array, quantiles: Array | None) -> float:
        """Return it."""
        return self.beta


class ClearanceBeta:
    """Beta by the smallest distance that the sensor sees: `low` at `near_m`, `high` at `far_m`, linear in between.

    Args:
        low: most averse beta.
        high: boldest beta.
        near_m: from the robot's centre; what is this near is answered by `low`.
        far_m: with nothing within it, the answer is `high`.
        sensor: which sectors count, those that the agent sees.
        robot: whose range sensor it is.

    Raises:
        UserInputError: unless low and high are finite, low is at most high, and near_m below far_m, above 0 and within
            the sensor's reach, 3 m.

    Example:
        >>> controller = ClearanceBeta(-2.0, 0.0, near_m=0.4, far_m=1.2)
        >>> controller(np.where(np.arange(180) == 3, 0.8, np.inf), None)
        -1.0
    """

    def __init__(
        self,
        low: float,
        high: float,
        *,
        near_m: float = 0.4,
        far_m: float = 1.2,
        sensor: str = "full",
        robot: RobotSettings = PAPER,
    ) -> None:
        _check_range(low, high)
        if not 0.0 < near_m < far_m:
            raise UserInputError(f"near_m={near_m:g} and far_m={far_m:g} must be above 0, and near_m below far_m")
        if near_m > (reach_m := robot.lidar.max_range_m):
            raise UserInputError(f"near_m={near_m:g} is beyond the {reach_m:g} m that agents see: give metres")
        self._betas = low, high
        self._limits_m = near_m, far_m
        self._mask = robot.sensor_mask(sensor)

    def reset(self) -> None:
        """Do nothing: only what is seen now counts."""

    def __call__(self, distances_m: Array, quantiles: Array | None) -> float:
        """Return beta; see :class:`BetaController`."""
        nearest_m = np.fmin.reduce(np.asarray(distances_m, np.float64)[self._mask], initial=np.inf)  # NaN says nothing
        return float(np.interp(nearest_m, self._limits_m, self._betas))


def lower_tail_variance(quantiles: Array) -> float:
    r"""Return how far a return may fall short: the mean squared distance of its lower half from its median.

    With N quantiles, :math:`\frac{1}{\lfloor N/2 \rfloor} \sum_{i \le N/2} (\theta_i - m)^2`, where m is the median.
    Quantiles that cross are put in order first.

    Args:
        quantiles: at equally spaced fractions, [N], at least 2.

    Raises:
        UserInputError: if they are fewer, or not finite: there is no tail to speak of.

    Example:
        >>> lower_tail_variance(np.array([0.0, 4.0, 6.0, 100.0]))  # median 5
        13.0
    """
    if np.ndim(quantiles) != 1 or len(quantiles) < 2 or not np.isfinite(quantiles).all():
        raise UserInputError(
            f"quantiles of shape {list(np.shape(quantiles))} have no lower half that is finite: ask the policy for at "
            "least 2 (num_quantiles)"
        )
    ordered = np.sort(quantiles)
    half = len(ordered) // 2
    return float(np.mean((ordered[:half] - np.median(ordered)) ** 2))


class TailVarianceBeta:
    r"""Beta by the lower tail of the return that the critics expect: averse where it is long.

    Liu, van Kampen and de Croon (2022), *Adaptive Risk-Tendency: Nano Drone Navigation in Cluttered Environments with
    Distributional Reinforcement Learning*, take the variance of the lower tail as the uncertainty that risk should
    answer; Schubert, Eimer, Rosenhahn and Lindauer (2021), *Automatic Risk Adaptation in Distributional
    Reinforcement Learning*, the novelty of the state. How wide a critic's returns spread differs from agent to agent,
    so here its *rank* decides: with s the share of the last steps whose tail was shorter (ties count half), beta is
    :math:`\beta_{high} - s (\beta_{high} - \beta_{low})`. No threshold has to be tuned, and on the mean beta lies in
    the middle: it is spent where the tail is longer than usual.

    The quantiles are those of the command before, hence of what was done one period ago, and under the beta of then.

    Args:
        low: most averse beta.
        high: boldest beta.
        window_steps: the last steps that a tail is compared with.

    Raises:
        UserInputError: unless low and high are finite, low is at most high, and the window at least 2.

    Example:
        >>> controller = TailVarianceBeta(-2.0, 0.0)
        >>> tails = np.array([[0.0, 2.0], [0.0, 8.0], [0.0, 1.0]])
        >>> [round(controller(np.full(180, np.inf), quantiles), 2) for quantiles in tails]
        [-1.0, -1.5, -0.33]
    """

    def __init__(self, low: float, high: float, *, window_steps: int = 200) -> None:
        _check_range(low, high)
        if window_steps < 2:
            raise UserInputError(f"window_steps={window_steps} is below 2: compare with some steps")
        self._low, self._high = low, high
        self._window = np.empty(window_steps)
        self._steps = 0

    def reset(self) -> None:
        """Forget the tails before."""
        self._steps = 0

    def __call__(self, distances_m: Array, quantiles: Array | None) -> float:
        """Return beta, the middle where no quantiles are known; see :class:`BetaController`."""
        share = 0.5
        if quantiles is not None:
            tail = lower_tail_variance(quantiles)
            self._window[self._steps % len(self._window)] = tail
            self._steps += 1
            known = self._window[: self._steps]
            shorter, equal = np.count_nonzero(known < tail), np.count_nonzero(known == tail)
            share = float(shorter + 0.5 * equal) / len(known)
        return self._high - share * (self._high - self._low)


def _check_range(low: float, high: float) -> None:
    if not (math.isfinite(low) and math.isfinite(high)):
        raise UserInputError(f"low={low:g} and high={high:g} are not both finite: give betas of the trained range")
    if not low <= high:
        raise UserInputError(f"low={low:g} is above high={high:g}: a smaller beta is more averse, swap them")
