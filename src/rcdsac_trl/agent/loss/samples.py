"""Every random number of one call of the loss, drawn before anything is computed.

So whoever computes the loss in parts gives each sequence the numbers that it has in the whole.
"""

from typing import NamedTuple

import torch
from torch import Tensor


class LossSamples(NamedTuple):
    """Random numbers of a batch; all fractions are None for scalar critics.

    Attributes:
        next_noise: of the policy's next action, standard normal, ``[B, L, A]``.
        next_tau: fractions of the target, ``[B, L | 1, N']``.
        tau: fractions of the prediction, ``[B, L | 1, N]``.
        noise: of the policy's action, standard normal, ``[B, L, A]``.
        risk_tau: fractions of the risk-adjusted value before distortion, ``[B, L | 1, K]``.
    """

    next_noise: Tensor
    next_tau: Tensor | None
    tau: Tensor | None
    noise: Tensor
    risk_tau: Tensor | None

    def rows(self, sequences: slice) -> "LossSamples":
        """Return the numbers of some sequences."""
        tau, next_tau, risk_tau = (
            None if fractions is None else fractions[sequences]
            for fractions in (self.tau, self.next_tau, self.risk_tau)
        )
        return LossSamples(self.next_noise[sequences], next_tau, tau, self.noise[sequences], risk_tau)


def draw_samples(
    action: Tensor,
    numbers: tuple[int, int, int] | None,
    fractions_per: str,
    fraction_sampling: str,
    generator: torch.Generator,
) -> LossSamples:
    """Draw what a batch needs, on the generator's device, and bring it to the batch's.

    Args:
        action: ``[B, L, A]``; gives sizes, device and type.
        numbers: of the fractions of target, prediction and risk-adjusted value; None for scalar critics.
        fractions_per: anew for every ``"transition"``, or once a ``"sequence"``.
        fraction_sampling: ``"uniform"`` on [0, 1), or ``"stratified"``: one in each of as many equal parts of [0, 1).
        generator: source of all numbers.
    """

    def noise() -> Tensor:
        return torch.randn(action.shape, generator=generator, device=generator.device, dtype=torch.float32).to(action)

    def fractions(which: int) -> Tensor | None:
        if numbers is None:
            return None
        shape = (len(action), 1 if fractions_per == "sequence" else action.shape[1], numbers[which])
        drawn = torch.rand(shape, generator=generator, device=generator.device, dtype=torch.float32).to(action.device)
        if fraction_sampling == "stratified":
            drawn = (drawn + torch.arange(numbers[which], device=action.device)) / numbers[which]
        return drawn

    return LossSamples(noise(), fractions(0), fractions(1), noise(), fractions(2))
