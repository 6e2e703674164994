"""What may be chosen about the networks; without torch, so that a mistake in it is told at once."""

from dataclasses import dataclass

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.observation import RangeCode
from rcdsac_trl.robot.ring import Padding
from rcdsac_trl.system.checks import one_of


@dataclass(frozen=True)
class NetworkSettings:
    """Layers of encoders and heads; the defaults are the paper's as far as it states them.

    Args:
        conv: channels of both convolutions.
        range: features of the range observation.
        vector: features of each vector observation.
        memory: size of the recurrent state.
        head: size of every fully-connected layer after the recurrent one, and of the risk gates.
        cosines: number of cosine features of ``beta`` and of a quantile fraction.
        padding: how the convolutions read the ring of range bins; see :mod:`rcdsac_trl.robot.ring`.
        range_code: how they read a bin; see :data:`rcdsac_trl.robot.observation.RangeCode`.
        encoder: an encoder of yours as ``package.module.Class``; see
            :class:`~rcdsac_trl.agent.networks.HistoryEncoder`. None for :class:`~rcdsac_trl.agent.networks.Encoder`.
        restart_steps: our encoder's recurrent state restarts every so many observations, while the one before is read;
            see :class:`~rcdsac_trl.agent.networks.Encoder`. None: it never does.
        look_ahead: heads read how near what is remembered says that ways lead, critics that of their action as well;
            see :mod:`rcdsac_trl.robot.look_ahead`.

    Raises:
        UserInputError: if a width or ``restart_steps`` is below 1, there is no such padding, code or encoder, or an
            encoder that is not ours is to look ahead.
    """

    conv: int = 32
    range: int = 128
    vector: int = 32
    memory: int = 128
    head: int = 128
    cosines: int = 64
    padding: Padding = "circular"
    range_code: RangeCode = "paper"
    encoder: str | None = None
    restart_steps: int | None = None
    look_ahead: bool = False

    def __post_init__(self) -> None:
        """Refuse widths below 1, other readings of the bins, and an encoder that cannot be imported."""
        for name, width in self.widths.items():
            if width < 1:
                raise UserInputError(f"network width {name} = {width} is below 1: give a positive integer")
        if self.restart_steps is not None and self.restart_steps < 1:
            raise UserInputError(
                f"network.restart_steps={self.restart_steps} is below 1: give a number of steps or null"
            )
        one_of("network.padding", self.padding, Padding)
        one_of("network.range_code", self.range_code, RangeCode)
        if self.encoder is not None:
            if self.look_ahead:
                raise UserInputError(
                    "network.look_ahead=true needs our encoder, which hands on what it is told: set it to false with "
                    f"network.encoder={self.encoder}"
                )
            from rcdsac_trl.agent.networks import imported_encoder  # late, since it imports torch

            imported_encoder(self.encoder)

    @property
    def widths(self) -> dict[str, int]:
        """The sizes of the layers, by name."""
        return {name: value for name, value in vars(self).items() if type(value) is int and name != "restart_steps"}

    @property
    def state_size(self) -> int:
        """How many numbers an encoder carries from step to step."""
        restarts = self.encoder is None and self.restart_steps is not None
        return 2 * self.memory + 1 if restarts else self.memory
