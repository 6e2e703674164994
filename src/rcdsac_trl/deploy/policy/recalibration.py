r"""Told quantiles that are true: what critics say of the return, shifted by what they were wrong by on other maps.

Critics learn quantiles that are too close together, of a policy that draws its actions. So for each fraction
:math:`\tau_i` and each of some betas the offset is the empirical :math:`\tau_i`-quantile of :math:`G - Z_{\tau_i}`:
what a robot that drives as the agent acts has really earned less what the critics had said, over many states. A share
:math:`\tau_i` of those returns then lies below the shifted quantile, and about as many of others like them:
conformalised quantile regression (Romano, Patterson and Candes 2019), in the spirit of Kuleshov, Fenner and Ermon
(2018).

An offset is the same for every action of a state, so it changes nothing that is chosen by comparing them.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError


@dataclass(frozen=True)
class Recalibration:
    """Offsets of the quantiles that an agent tells, and what they were fitted on.

    Attributes:
        fractions: of the quantiles, rising in (0, 1), [K].
        betas: under which the offsets were fitted, rising, [B]; empty for an agent that is told none.
        offsets: what is added to the quantiles, in units of the return, a row a beta, [B, K]; without betas [1, K].
        split: of the maps that were driven.
        seed: of these maps.
        num_maps: how many.
        num_episodes: on each map, under each beta.
        num_states: of all episodes, from which returns were taken.
        horizon_steps: a return's length; the rest is missing from it.
        command: drives the same again.

    Raises:
        UserInputError: if fractions, betas and offsets do not fit together.

    Example:
        >>> fit = {"split": "validation", "seed": 0, "num_maps": 12, "num_episodes": 3, "num_states": 3600}
        >>> rows = ((-2.0, 4.0), (0.0, 8.0))
        >>> told = Recalibration((0.25, 0.75), (0.5, 1.0), rows, **fit, horizon_steps=500, command="")
        >>> told.tell(np.array([10.0, 11.0]), 0.5).tolist()  # at a beta of the fit
        [8.0, 15.0]
        >>> told.tell(np.array([10.0, 11.0]), 0.75).tolist()  # between two
        [9.0, 17.0]
        >>> told.at([0.1, 0.5, 0.9]).offsets_of(0.1).tolist()  # at other fractions, below the lowest beta
        [-2.0, 1.0, 4.0]
    """

    fractions: tuple[float, ...]
    betas: tuple[float, ...]
    offsets: tuple[tuple[float, ...], ...]
    split: str
    seed: int
    num_maps: int
    num_episodes: int
    num_states: int
    horizon_steps: int
    command: str

    def __post_init__(self) -> None:
        """Refuse what no offsets can be; files bring lists."""
        for name in ("fractions", "betas"):
            object.__setattr__(self, name, tuple(float(number) for number in getattr(self, name)))
        object.__setattr__(self, "offsets", tuple(tuple(float(offset) for offset in row) for row in self.offsets))
        if not (self.fractions and _rise((0.0, *self.fractions, 1.0)) and _rise(self.betas)):
            raise UserInputError("recalibration: its fractions do not rise within (0, 1), or its betas do not rise")
        if [len(row) for row in self.offsets] != max(1, len(self.betas)) * [len(self.fractions)]:
            raise UserInputError(
                f"recalibration: its offsets are no table of {max(1, len(self.betas))} x {len(self.fractions)} numbers"
            )
        if not all(math.isfinite(number) for row in (self.betas, *self.offsets) for number in row):
            raise UserInputError("recalibration: not all of its numbers are finite")

    def __str__(self) -> str:
        """Say what it was fitted on."""
        at = f", beta = {', '.join(f'{beta:g}' for beta in self.betas)}" if self.betas else ""
        size = f"{self.num_maps} {self.split} maps x {self.num_episodes} episodes"
        return f"recalibrated on {size} (seed {self.seed}{at})"

    def at(self, fractions: Sequence[float] | NDArray[np.floating]) -> "Recalibration":
        """Return it for quantiles at other fractions, rising in (0, 1): linear in between, constant beyond the ends."""
        asked = tuple(float(fraction) for fraction in fractions)
        rows = tuple(tuple(np.interp(asked, self.fractions, row).tolist()) for row in self.offsets)
        return replace(self, fractions=asked, offsets=rows)

    def offsets_of(self, beta: float | None) -> NDArray[np.float32]:
        """Return the offsets for a beta, float32 [K]: linear between those of the fit, constant beyond the ends.

        Args:
            beta: that the agent is told; None where it is told none.
        """
        rows = np.array(self.offsets)
        if beta is None or len(rows) == 1:
            return rows[0].astype(np.float32)
        place = float(np.interp(beta, self.betas, np.arange(len(rows))))
        low = min(int(place), len(rows) - 2)
        between: NDArray[np.float64] = rows[low] + (place - low) * (rows[low + 1] - rows[low])
        return between.astype(np.float32)

    def tell(self, quantiles: NDArray[np.floating], beta: float | None) -> NDArray[np.floating]:
        """Return what is told where critics say some quantiles, [.., K], in rising order: shifted ones may cross.

        Args:
            quantiles: as critics say them at :attr:`fractions`, [.., K].
            beta: as in :meth:`offsets_of`.
        """
        return np.sort(quantiles + self.offsets_of(beta), axis=-1)


def _rise(numbers: Sequence[float]) -> bool:
    """Tell whether numbers rise; with a NaN among them they do not."""
    return all(low < high for low, high in itertools.pairwise(numbers))
