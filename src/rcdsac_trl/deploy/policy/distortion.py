"""Fractions of a return's distribution, and the same as a risk measure distorts them, in NumPy.

The measures are those of :mod:`rcdsac_trl.agent.risk`, which defines them; tests hold both equal.
"""

from collections.abc import Callable, Mapping
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.sectors import is_whole_number

Doubles = NDArray[np.float64]

NUM_REPORTED_QUANTILES = 16
"""Quantiles of a return's distribution that an agent reports, unless it is asked for another number."""


def fractions_of(num_quantiles: int) -> NDArray[np.float32]:
    """Return the midpoints of equal parts of [0, 1], float32 [num_quantiles].

    Raises:
        UserInputError: if the number is no whole one of 1 or more.
    """
    if not (is_whole_number(num_quantiles) and num_quantiles >= 1):
        raise UserInputError(f"num_quantiles={num_quantiles} is no whole number of 1 or more: ask for at least one")
    return ((np.arange(num_quantiles) + 0.5) / num_quantiles).astype(np.float32)


def _wang(tau: Doubles, beta: float) -> Doubles:
    normal = NormalDist()
    return np.array([normal.cdf(normal.inv_cdf(fraction) + beta) for fraction in tau.tolist()])


def _cpw(tau: Doubles, beta: float) -> Doubles:
    weighted = tau**beta
    return weighted / (weighted + (1.0 - tau) ** beta) ** (1.0 / beta)


def _power(tau: Doubles, beta: float) -> Doubles:
    return -np.expm1(np.log1p(-tau) / (1.0 - beta))


PSI: Mapping[str, Callable[[Doubles, float], Doubles]] = {
    "neutral": lambda tau, beta: tau,
    "cvar": lambda tau, beta: beta * tau,
    "pow": _power,
    "pow_wide": _power,
    "wang": _wang,
    "cpw": _cpw,
    "var": lambda tau, beta: np.full_like(tau, beta),
}
"""The distorted fractions of each measure, of fractions inside (0, 1) and ``beta``."""


def distorted(measure: str, fractions: NDArray[np.float32], beta: float) -> NDArray[np.float32]:
    r"""Return :math:`\psi(\tau; \beta)`, float32 of the fractions' shape.

    Args:
        measure: a name in :data:`PSI`.
        fractions: :math:`\tau`, each in (0, 1).
        beta: of the measure's domain; not read by ``neutral``.

    Example:
        >>> distorted("cvar", fractions_of(2), 0.5).tolist()
        [0.125, 0.375]
    """
    return PSI[measure](fractions.astype(np.float64), beta).astype(np.float32)
