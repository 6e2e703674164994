"""What one has to know of an agent to drive with it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.policy.acting import BY_MEAN, ActingSettings
from rcdsac_trl.deploy.policy.recalibration import Recalibration
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.look_ahead import foreseen_among, read_by_heads, told_of_action
from rcdsac_trl.robot.observation import RangeCode, vector_observations
from rcdsac_trl.robot.range_sensor import SENSORS, check_memory
from rcdsac_trl.robot.ring import KERNELS, RING_ENDS, Padding, num_positions
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings

Context = Literal["beta", "collision_weight"]

_WIDTHS = ("conv", "range", "vector", "memory", "head", "cosines")
_ACTION_SIZE = 2
# Beyond these, a file holds milliseconds and millimetres.
_LONGEST_PERIOD_S, _LARGEST_RADIUS_M = 10.0, 20.0


@dataclass(frozen=True)
class AgentConfig:
    """What one has to know of an agent to drive with it.

    Attributes:
        name: row of the paper's table that trained it, such as ``"rcdsac_pow"``.
        sensor: the range sensor it was trained with; see :func:`rcdsac_trl.robot.range_sensor.sensor_mask`.
        critic: ``"quantile"`` knows the distribution of the return, ``"scalar"`` its mean.
        num_critics: number of critics.
        context: what the networks are told besides observations; None for nothing.
        context_range: smallest and largest value of it in training; None without one.
        measure: the risk measure that it was trained for.
        embedding: slope and offset that bring ``beta`` into [0, 1]; None where the networks read no ``beta``.
        fixed_beta: the one ``beta`` it was trained for; None for a range, or for none.
        network: layer widths, as ``network`` in ``conf/train.yaml``.
        period_s: shortest and longest time between two actions in training, s.
        waypoint_radius_m: a waypoint nearer than this gives way to the next.
        goal_radius_m: a goal nearer than this is reached.
        provenance: where it comes from, for people: run, commit, checkpoint, steps.
        padding: how its convolutions read the ring of range bins; see :mod:`rcdsac_trl.robot.ring`.
        memory_s: for how long it is told of points that it saw, s; 0: not at all. See
            :class:`~rcdsac_trl.robot.remembered_ranges.RememberedRanges`.
        range_code: how its convolutions read a range bin; see :data:`rcdsac_trl.robot.observation.RangeCode`.
        restart_steps: its recurrent states restart every so many observations; None: never. See
            :class:`~rcdsac_trl.deploy.policy.inference.Encoders`.
        look_ahead: its heads read the foreseen clearances, and critics those of their action; see
            :mod:`rcdsac_trl.robot.look_ahead`.
        robot: that it was trained to drive; plain values of one, as files have them, are read.
        acting: how it acts, by tanh(mean) or by its critics' choice; plain values are read, too.
        recalibration: by what it tells the quantiles of the return, fitted while it acted so; plain values are read,
            too. None: it tells them as its critics say them.

    Raises:
        UserInputError: if values do not fit together.
    """

    name: str
    sensor: str
    critic: Literal["quantile", "scalar"]
    num_critics: int
    context: Context | None
    context_range: tuple[float, float] | None
    measure: str
    embedding: tuple[float, float] | None
    fixed_beta: float | None
    network: Mapping[str, int]
    period_s: tuple[float, float]
    waypoint_radius_m: float
    goal_radius_m: float
    provenance: Mapping[str, str | int | float | None]
    padding: Padding = "circular"
    memory_s: float = 0.0
    range_code: RangeCode = "paper"
    restart_steps: int | None = None
    look_ahead: bool = False
    robot: RobotSettings = PAPER
    acting: ActingSettings = BY_MEAN
    recalibration: Recalibration | None = None

    def __post_init__(self) -> None:
        """Refuse what no agent can be."""
        if not isinstance(self.robot, RobotSettings):
            object.__setattr__(self, "robot", RobotSettings.from_mapping(self.robot))
        if not isinstance(self.acting, ActingSettings):
            object.__setattr__(self, "acting", ActingSettings(**self.acting))
        if not isinstance(self.recalibration, Recalibration | None):
            object.__setattr__(self, "recalibration", Recalibration(**self.recalibration))
        for name in ("context_range", "embedding", "period_s"):
            value = getattr(self, name)
            if value is None:
                continue
            pair = tuple(float(number) for number in value)
            if len(pair) != 2 or not all(math.isfinite(number) for number in pair):
                raise UserInputError(f"{name}={value} is not two finite numbers")
            object.__setattr__(self, name, pair)
        if not 0.0 <= self.period_s[0] <= self.period_s[1] <= _LONGEST_PERIOD_S:
            raise UserInputError(
                f"period_s={self.period_s} does not rise within [0, {_LONGEST_PERIOD_S:g}]: give seconds"
            )
        for name in ("waypoint_radius_m", "goal_radius_m"):
            if not 0.0 < getattr(self, name) <= _LARGEST_RADIUS_M:
                raise UserInputError(
                    f"{name}={getattr(self, name)} is not above 0 and at most {_LARGEST_RADIUS_M:g}: give metres"
                )
        if self.sensor not in SENSORS:
            raise UserInputError(f"sensor={self.sensor!r} does not exist; choose one of {', '.join(sorted(SENSORS))}")
        self.robot.sensor_mask(self.sensor)
        check_memory(self.memory_s)
        if self.range_code not in get_args(RangeCode):
            raise UserInputError(f"range_code={self.range_code!r} is none of {', '.join(get_args(RangeCode))}")
        if self.restart_steps is not None and (type(self.restart_steps) is not int or self.restart_steps < 1):
            raise UserInputError(f"restart_steps={self.restart_steps} is neither a number of steps nor null")
        if type(self.look_ahead) is not bool or (self.look_ahead and self.memory_s == 0.0):
            raise UserInputError(
                f"look_ahead={self.look_ahead} with memory_s={self.memory_s:g}: it is true or false, and an agent "
                "without a memory foresees nothing"
            )
        self.acting.check_heads(self.look_ahead)
        if self.critic not in ("quantile", "scalar"):
            raise UserInputError(f"critic={self.critic!r} is neither 'quantile' nor 'scalar'")
        if self.critic == "scalar" and self.recalibration is not None:
            raise UserInputError("critic='scalar' knows no quantiles that recalibration could shift")
        if set(self.network) != set(_WIDTHS) or not all(type(w) is int and w >= 1 for w in self.network.values()):
            raise UserInputError(f"network={dict(self.network)} does not give a positive width for each of {_WIDTHS}")
        if self.padding not in RING_ENDS:
            raise UserInputError(f"padding={self.padding!r} is neither 'circular' nor 'none'")
        if type(self.num_critics) is not int or self.num_critics < 1:
            raise UserInputError(f"num_critics={self.num_critics} is no positive number")
        if self.context not in ("beta", "collision_weight", None):
            raise UserInputError(f"context={self.context!r} is neither 'beta' nor 'collision_weight' nor null")
        if (self.context is None) != (self.context_range is None) or (self.context == "beta") != bool(self.embedding):
            raise UserInputError("context, context_range and embedding do not fit together")

    @property
    def sensor_mask(self) -> NDArray[np.bool_]:
        """Which of the 180 range bins it is told, bool [180]."""
        return self.robot.sensor_mask(self.sensor)

    @property
    def vectors(self) -> dict[str, int]:
        """Name and size of the vector observations, in the order in which the encoders read them."""
        weighted = self.context == "collision_weight"
        return vector_observations(self.memory_s) | ({"collision_weight": 1} if weighted else {})

    @property
    def foreseen(self) -> slice | None:
        """Where in all vector observations the foreseen clearances stand that its heads read; None: they do not."""
        if not self.look_ahead:
            return None
        return foreseen_among(self.vectors)

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of every tensor of the agent, by name."""
        parts = {"actor.encoder": self._encoder(), "actor.head": self._actor_head()}
        for number in range(self.num_critics):
            parts[f"critics.{number}.encoder"] = self._encoder()
            parts[f"critics.{number}.head"] = self._critic_head()
        return {f"{part}.{name}": shape for part, shapes in parts.items() for name, shape in shapes.items()}

    def _encoder(self) -> dict[str, tuple[int, ...]]:
        n = self.network
        inputs = n["range"] + n["vector"] * len(self.vectors)
        shapes: dict[str, tuple[int, ...]] = {
            "range.conv_1.weight": (n["conv"], 1, KERNELS[0]),
            "range.conv_1.bias": (n["conv"],),
        }
        shapes |= {"range.conv_2.weight": (n["conv"], n["conv"], KERNELS[1]), "range.conv_2.bias": (n["conv"],)}
        shapes |= _linear("range.linear", num_positions(self.padding) * n["conv"], n["range"])
        for index, size in enumerate(self.vectors.values()):
            shapes |= _linear(f"vectors.{index}", size, n["vector"])
        for side, size in (("ih", inputs), ("hh", n["memory"])):
            shapes |= {f"gru.weight_{side}_l0": (3 * n["memory"], size), f"gru.bias_{side}_l0": (3 * n["memory"],)}
        return shapes

    def _read(self) -> int:
        """Return how many numbers of the encoder's a head reads."""
        return read_by_heads(self.network["memory"], self.look_ahead)

    def _actor_head(self) -> dict[str, tuple[int, ...]]:
        n = self.network
        gate = _linear("gate", n["cosines"], n["head"]) if self.context == "beta" else {}
        return (
            _linear("input", self._read(), n["head"])
            | gate
            | _linear("hidden", n["head"], n["head"])
            | _linear("output", n["head"], 2 * _ACTION_SIZE)
        )

    def _critic_head(self) -> dict[str, tuple[int, ...]]:
        n = self.network
        told = told_of_action(_ACTION_SIZE, self.look_ahead)
        shapes = _linear("input", self._read() + told, n["head"])
        if self.critic == "quantile":
            shapes |= _linear("gate_tau", n["cosines"], n["head"])
            if self.context == "beta":
                shapes |= {"gate_beta.weight": (n["head"], n["cosines"])}
        return shapes | _linear("hidden", n["head"], n["head"]) | _linear("output", n["head"], 1)


def _linear(name: str, inputs: int, outputs: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}
