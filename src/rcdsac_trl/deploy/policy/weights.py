"""A trained agent as files: a folder of weights, what they are, and a model card.

A weights folder holds ``weights.safetensors`` (the actor's and every critic's layers, float32), ``config.json``
(:class:`AgentConfig`, and the SHA-256 of the weights) and ``README.md``; beside them lies ``training.yaml``, the config
of its training, which a robot does not read. Nothing in it is code, and reading it needs
neither torch nor the configuration that trained it. ``python -m rcdsac_trl.export`` writes it.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from hashlib import sha256
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from rcdsac_trl.deploy.policy.acting import BY_MEAN, ActingSettings
from rcdsac_trl.deploy.policy.driving_record import DrivingRecord, driving_record
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.look_ahead import foreseen_among, read_by_heads, told_of_action
from rcdsac_trl.robot.observation import RangeCode, vector_observations
from rcdsac_trl.robot.range_sensor import NUM_BINS, SENSORS, check_memory
from rcdsac_trl.robot.ring import KERNELS, RING_ENDS, Padding, num_positions
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings

FORMAT_VERSION = 5
"""What is written. Earlier formats, which are read as well, do not say what all of their agents have in common."""
_UNSAID_BY_4: dict[str, Any] = {"acting": BY_MEAN}
_UNSAID_BY_3: dict[str, Any] = {"restart_steps": None, "look_ahead": False, "robot": PAPER, **_UNSAID_BY_4}
_UNSAID: dict[int, dict[str, Any]] = {
    1: {"padding": "none", "memory_s": 0.0, "range_code": "paper", **_UNSAID_BY_3},
    2: {"memory_s": 0.0, "range_code": "paper", **_UNSAID_BY_3},
    3: _UNSAID_BY_3,
    4: _UNSAID_BY_4,
    FORMAT_VERSION: {},
}
CONFIG_NAME = "config.json"
WEIGHTS_NAME = "weights.safetensors"
CARD_NAME = "README.md"
SHIPPED = Path(__file__).resolve().parents[2] / "weights"
"""The folder of the agents that come with the package; one folder each, which may be none."""

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

    def __post_init__(self) -> None:
        """Refuse what no agent can be."""
        if not isinstance(self.robot, RobotSettings):
            object.__setattr__(self, "robot", RobotSettings.from_mapping(self.robot))
        if not isinstance(self.acting, ActingSettings):
            object.__setattr__(self, "acting", ActingSettings(**self.acting))
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
        if self.critic not in ("quantile", "scalar"):
            raise UserInputError(f"critic={self.critic!r} is neither 'quantile' nor 'scalar'")
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


@dataclass(frozen=True)
class Weights:
    """An agent: what it is, its tensors by name, float32, and what its card says of how it drives, if anything.

    Raises:
        UserInputError: if a tensor is missing, superfluous, of another shape or type, or not finite.
    """

    config: AgentConfig
    tensors: Mapping[str, NDArray[np.float32]]
    record: tuple[DrivingRecord, ...] = ()

    def __post_init__(self) -> None:
        """Compare the tensors with what the configuration says, and make them read-only."""
        expected = self.config.shapes()
        if missing := sorted(expected.keys() ^ self.tensors.keys()):
            raise UserInputError(f"the weights and their {CONFIG_NAME} differ in {missing[0]}: export the agent anew")
        for name, shape in expected.items():
            tensor = self.tensors[name]
            if tensor.shape != shape or tensor.dtype != np.float32:
                raise UserInputError(
                    f"{name} is {tensor.dtype} {list(tensor.shape)}, its {CONFIG_NAME} says float32 {list(shape)}: "
                    "export the agent anew"
                )
            if not np.isfinite(tensor).all():
                raise UserInputError(f"{name} holds numbers that are not finite: this agent cannot drive")
        object.__setattr__(self, "tensors", MappingProxyType(dict(self.tensors)))

    def __reduce__(self) -> tuple[type["Weights"], tuple[Any, ...]]:
        """Pickle and copy what the views of mappings are of: they themselves cannot be."""
        return Weights, (self.config, dict(self.tensors), self.record)

    def part(self, prefix: str) -> dict[str, NDArray[np.float32]]:
        """Return the tensors below a prefix, such as ``"actor.encoder"``, without it."""
        return {name[len(prefix) + 1 :]: value for name, value in self.tensors.items() if name.startswith(f"{prefix}.")}


def _linear(name: str, inputs: int, outputs: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}


def shipped_names(folder: Path = SHIPPED) -> list[str]:
    """List the agents that come with the package."""
    return sorted(path.parent.name for path in folder.glob(f"*/{CONFIG_NAME}"))


def find_weights(name_or_folder: str | Path, shipped: Path = SHIPPED) -> Path:
    """Return the weights folder of that path, or of the shipped agent of that name.

    Raises:
        UserInputError: if there is neither; the sentence lists the shipped agents.
    """
    folder = Path(name_or_folder)
    for candidate in (folder, shipped / str(name_or_folder)):
        if (candidate / CONFIG_NAME).is_file():
            return candidate
    names = shipped_names(shipped)
    there = f"shipped are {', '.join(names)}" if names else "none is shipped with this version"
    others = "or name a run folder or one that rcdsac_trl.export wrote"
    if folder.is_dir():
        raise UserInputError(f"{folder} holds neither checkpoints nor {CONFIG_NAME}: {there}; {others}")
    raise UserInputError(f"there is no agent {str(name_or_folder)!r}: {there}; {others}")


def read_weights(folder: Path) -> Weights:
    """Read a weights folder.

    Raises:
        UserInputError: if it is damaged, of another version, or holds what cannot be.
    """
    path = folder / CONFIG_NAME
    try:
        values = json.loads(path.read_bytes())
        version, digest = values.pop("format_version"), values.pop("weights_sha256")
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        raise UserInputError(f"{path} cannot be read ({type(error).__name__}): export the agent anew") from error
    if not isinstance(version, int) or version not in _UNSAID:
        raise UserInputError(
            f"{folder} is of format {version}, this version reads 1 to {FORMAT_VERSION}: export it anew"
        )
    if set(values) != {field.name for field in fields(AgentConfig)} - _UNSAID[version].keys():
        raise UserInputError(f"{path} does not have the keys of format {version}: export the agent anew")
    values |= _UNSAID[version]
    try:
        content = (folder / WEIGHTS_NAME).read_bytes()
    except OSError as error:
        raise UserInputError(f"{folder} holds no {WEIGHTS_NAME} that can be read: export the agent anew") from error
    if sha256(content).hexdigest() != digest:
        raise UserInputError(f"{folder / WEIGHTS_NAME} is not what {CONFIG_NAME} says it is: export the agent anew")
    try:
        tensors = {name: _single(tensor) for name, tensor in load_tensors(content).items()}
        return Weights(AgentConfig(**values), tensors, _record(folder))
    except UserInputError as error:
        raise UserInputError(f"{folder}: {error}") from error
    except (TypeError, ValueError, AttributeError, SafetensorError) as error:
        raise UserInputError(f"{folder} cannot be read ({error}): export the agent anew") from error


def _record(folder: Path) -> tuple[DrivingRecord, ...]:
    """Read the card; an agent drives without one."""
    try:
        return driving_record((folder / CARD_NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return ()


def _single(tensor: NDArray[Any]) -> NDArray[Any]:
    """Return what was stored in half precision in single precision, and anything else as it is."""
    return tensor.astype(np.float32) if tensor.dtype == np.float16 else tensor


def halved(weights: Weights) -> Weights:
    """Return the agent as it is after having been stored in half precision, which halves its file.

    Raises:
        UserInputError: if a number is too large for half precision.
    """
    with np.errstate(over="ignore"):  # a number that is not finite is refused
        tensors = {name: _single(value.astype(np.float16)) for name, value in weights.tensors.items()}
    return Weights(weights.config, tensors, weights.record)


def packed(weights: Weights, *, half: bool = False, results: str = "") -> dict[str, bytes]:
    """Return the files of a weights folder: name and content.

    Args:
        weights: of the agent.
        half: store them in half precision, as :func:`halved` has them.
        results: what the card says of how the agent drives, Markdown.
    """
    stored = np.float16 if half else np.float32
    content = save_tensors({name: np.ascontiguousarray(value, stored) for name, value in weights.tensors.items()})
    config: dict[str, Any] = {"format_version": FORMAT_VERSION, "weights_sha256": sha256(content).hexdigest()}
    config |= asdict(weights.config)
    return {
        WEIGHTS_NAME: content,
        CARD_NAME: model_card(weights, results).encode(),
        CONFIG_NAME: (json.dumps(config, indent=2) + "\n").encode(),
    }


def model_card(weights: Weights, results: str = "") -> str:
    """Return what a person should know before driving with an agent, as Markdown.

    Args:
        weights: of the agent.
        results: what is known of how it drives, Markdown.
    """
    config = weights.config
    parameters = sum(tensor.size for tensor in weights.tensors.values())
    told = "nothing besides observations"
    if config.context is not None and config.context_range is not None:
        told = f"`{config.context}` in [{config.context_range[0]:g}, {config.context_range[1]:g}]"
    if config.fixed_beta is not None:
        told += f"; it was trained for beta = {config.fixed_beta:g} alone"
    origin = "\n".join(f"| {key} | {value} |" for key, value in config.provenance.items() if value is not None)
    remembered = f", what it saw in the last {config.memory_s:g} s" if config.memory_s > 0.0 else ""
    driving = f"\n{results.strip()}\n" if results else ""
    return f"""# {config.name}, {config.sensor} sensor

A navigation agent of rcdsac_trl: recurrent actor and {config.num_critics}
{config.critic} critic(s), {parameters:,} parameters.

```python
import rcdsac_trl

policy = rcdsac_trl.load("this/folder")
```

| | |
|---|---|
| drives | `{config.robot.name}`, {_described(config.robot)} |
| reads | {NUM_BINS} range bins of which the `{config.sensor}` sensor has some, two waypoints, velocities{remembered} |
| is told | {told} |
| risk measure | {config.measure} |
| acts every | {config.period_s[0]:g} to {config.period_s[1]:g} s |
| acts by | {config.acting} |
| gives | linear velocity in m/s, angular velocity in rad/s |
{origin}
{driving}
## Limits

Trained in simulation only, on a differential-drive robot of {config.robot.circumradius_m:.3g} m radius. It has driven
no real robot: keep the speed limit and the stop zone on, and a hand on the emergency stop.
"""


def _described(robot: RobotSettings) -> str:
    """Say of a robot what somebody compares with the own one."""
    shape = f"{robot.length_m:g} x {robot.width_m:g} m" if robot.shape == "rectangle" else f"{robot.radius_m:g} m"
    return (
        f"{robot.shape} of {shape}, {robot.min_linear_velocity:g} to {robot.max_speed_m_per_s:g} m/s, "
        f"{robot.max_turn_deg_per_s:g} degrees/s, range sensor up to {robot.lidar.max_range_m:g} m"
    )
