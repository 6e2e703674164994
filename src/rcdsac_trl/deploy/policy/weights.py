"""A trained agent as files: a folder of weights, what they are, and what is known of how they drive.

A weights folder holds ``weights.safetensors`` (the actor's and every critic's layers), ``config.json``
(:class:`~rcdsac_trl.deploy.policy.agent_config.AgentConfig`, and the SHA-256 of the weights), ``README.md``, the model
card, and, of an agent that was measured, ``measured.json``, which the card is made from; beside them lies
``training.yaml``, the config of its training, which a robot does not read. Nothing in it is code, and reading it needs
neither torch nor the configuration that trained it. ``python -m rcdsac_trl.export`` writes it in single precision,
``python -m rcdsac_trl.publish`` in half.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from hashlib import sha256
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from rcdsac_trl.deploy.policy.acting import BY_MEAN
from rcdsac_trl.deploy.policy.agent_config import AgentConfig
from rcdsac_trl.deploy.policy.measured import MEASURED_NAME, Measured, read_measured
from rcdsac_trl.deploy.policy.model_card import model_card
from rcdsac_trl.deploy.policy.registry import CONFIG_NAME
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.robot_settings import PAPER

FORMAT_VERSION = 6
"""What is written. Earlier formats, which are read as well, do not say what all of their agents have in common."""
_UNSAID_BY_5: dict[str, Any] = {"recalibration": None}
_UNSAID_BY_4: dict[str, Any] = {"acting": BY_MEAN, **_UNSAID_BY_5}
_UNSAID_BY_3: dict[str, Any] = {"restart_steps": None, "look_ahead": False, "robot": PAPER, **_UNSAID_BY_4}
_UNSAID: dict[int, dict[str, Any]] = {
    1: {"padding": "none", "memory_s": 0.0, "range_code": "paper", **_UNSAID_BY_3},
    2: {"memory_s": 0.0, "range_code": "paper", **_UNSAID_BY_3},
    3: _UNSAID_BY_3,
    4: _UNSAID_BY_4,
    5: _UNSAID_BY_5,
    FORMAT_VERSION: {},
}
WEIGHTS_NAME = "weights.safetensors"
CARD_NAME = "README.md"


@dataclass(frozen=True)
class Weights:
    """An agent: what it is, its tensors by name, float32, and what was measured of it, if anything.

    Raises:
        UserInputError: if a tensor is missing, superfluous, of another shape or type, or not finite.
    """

    config: AgentConfig
    tensors: Mapping[str, NDArray[np.float32]]
    measured: Measured | None = None

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
        return Weights, (self.config, dict(self.tensors), self.measured)

    def part(self, prefix: str) -> dict[str, NDArray[np.float32]]:
        """Return the tensors below a prefix, such as ``"actor.encoder"``, without it."""
        return {name[len(prefix) + 1 :]: value for name, value in self.tensors.items() if name.startswith(f"{prefix}.")}


def read_agent_config(folder: Path) -> tuple[AgentConfig, str]:
    """Return what the agent of a weights folder is, and the SHA-256 that its weights have to have.

    Raises:
        UserInputError: if that is damaged, of another version, or says what cannot be.
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
    try:
        return AgentConfig(**values | _UNSAID[version]), digest
    except UserInputError as error:
        raise UserInputError(f"{folder}: {error}") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise UserInputError(f"{folder} cannot be read ({error}): export the agent anew") from error


def checked_weights(folder: Path, digest: str) -> bytes:
    """Return the file of weights of a folder, which must be what its config says.

    Args:
        folder: of the agent.
        digest: SHA-256 that the file has to have.

    Raises:
        UserInputError: if it is missing, or another.
    """
    try:
        content = (folder / WEIGHTS_NAME).read_bytes()
    except OSError as error:
        raise UserInputError(f"{folder} holds no {WEIGHTS_NAME} that can be read: export the agent anew") from error
    if sha256(content).hexdigest() != digest:
        raise UserInputError(
            f"{folder / WEIGHTS_NAME} is not what {CONFIG_NAME} says it is: get the folder again, or export it anew"
        )
    return content


def measured_of_weights(folder: Path, digest: str) -> Measured | None:
    """Return what was measured of the agent of a folder; None where nobody says.

    Args:
        folder: of the agent.
        digest: SHA-256 of its weights.

    Raises:
        UserInputError: if what was measured cannot be read, or was of other weights.
    """
    measured = read_measured(folder)
    if measured is not None and measured.weights_sha256 != digest:
        raise UserInputError(
            f"{folder / MEASURED_NAME} is of other weights than {WEIGHTS_NAME}: publish the agent anew, or "
            "remove the file"
        )
    return measured


def read_weights(folder: Path) -> Weights:
    """Read a weights folder.

    Raises:
        UserInputError: if it is damaged, of another version, or holds what cannot be.
    """
    config, digest = read_agent_config(folder)
    content = checked_weights(folder, digest)
    measured = measured_of_weights(folder, digest)
    try:
        tensors = {name: _single(tensor) for name, tensor in load_tensors(content).items()}
        return Weights(config, tensors, measured)
    except UserInputError as error:
        raise UserInputError(f"{folder}: {error}") from error
    except (TypeError, ValueError, AttributeError, SafetensorError) as error:
        raise UserInputError(f"{folder} cannot be read ({error}): export the agent anew") from error


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
    return Weights(weights.config, tensors)


def stored(weights: Weights, *, half: bool = False) -> bytes:
    """Return the file of an agent's weights.

    Args:
        weights: of the agent.
        half: store them in half precision, as :func:`halved` has them.
    """
    dtype = np.float16 if half else np.float32
    return save_tensors({name: np.ascontiguousarray(value, dtype) for name, value in weights.tensors.items()})


def digest_of(weights: Weights, *, half: bool = False) -> str:
    """Return the SHA-256 of the file that :func:`stored` makes of an agent's weights."""
    return sha256(stored(weights, half=half)).hexdigest()


def card_of(weights: Weights, measured: Measured | None) -> str:
    """Return the card of an agent, Markdown, with what is known of how it drives."""
    return model_card(weights.config, sum(tensor.size for tensor in weights.tensors.values()), measured)


def packed(weights: Weights, *, half: bool = False, measured: Measured | None = None) -> dict[str, bytes]:
    """Return the files of a weights folder: name and content.

    Args:
        weights: of the agent.
        half: store them in half precision, as :func:`halved` has them.
        measured: what is known of how it drives.
    """
    content = stored(weights, half=half)
    config: dict[str, Any] = {"format_version": FORMAT_VERSION, "weights_sha256": sha256(content).hexdigest()}
    config |= asdict(weights.config)
    said = {} if measured is None else {MEASURED_NAME: measured.to_json().encode()}
    return {
        WEIGHTS_NAME: content,
        CARD_NAME: card_of(weights, measured).encode(),
        **said,
        CONFIG_NAME: (json.dumps(config, indent=2) + "\n").encode(),
    }
