"""What a policy answers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Command:
    """What the robot should do now, and what the agent expects of it.

    Attributes:
        v_m_per_s: desired linear velocity.
        omega_rad_per_s: desired angular velocity, counter-clockwise.
        stopped: whether the robot stands because it must: bad input, or :meth:`Policy.stop`.
        reason: why this is not what the agent wanted at the beta it was given, and how that ends; None if it is.
        wanted: what the agent wanted, (m/s, rad/s); None where it was not asked.
        quantiles: of the return (the discounted sum of rewards from here on) for what the agent wanted, at
            ``Policy.fractions``, the lower of the critics' each, recalibrated if ``Policy.recalibrated``, float32 [N];
            None where the agent was not asked, or its critics know the mean alone.
        value: mean of the return, of these quantiles; None where the agent was not asked.
        fresh: whether the agent was asked: False when it stopped, and between two of its periods.
        forgot: whether the memory was empty before this call.
        raw_quantiles: as `quantiles`, but as the critics say them: what turns beta reads these, so that it does the
            same whether an agent is recalibrated or not.
    """

    v_m_per_s: float
    omega_rad_per_s: float
    stopped: bool
    reason: str | None
    wanted: tuple[float, float] | None = None
    quantiles: NDArray[np.float32] | None = None
    value: float | None = None
    fresh: bool = False
    forgot: bool = False
    raw_quantiles: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Outlook:
    """What an agent would do where it is, and what it expects of that.

    Attributes:
        action: what it would do, or the action that was asked about, in [-1, 1], float32 [2].
        wanted: the velocities of that action, (m/s, rad/s).
        quantiles: of the return for it, at ``Policy.fractions``, the lower of the critics' each, recalibrated if
            ``Policy.recalibrated``, float32 [N]; None where the critics know the mean alone.
        value: mean of the return, of these quantiles.
        raw_quantiles: as `quantiles`, but as the critics say them.
    """

    action: NDArray[np.float32]
    wanted: tuple[float, float]
    quantiles: NDArray[np.float32] | None
    value: float
    raw_quantiles: NDArray[np.float32] | None
