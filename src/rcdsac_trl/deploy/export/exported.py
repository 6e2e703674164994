"""An agent as ONNX and as ``torch.export`` programs, and how far both are from torch.

``actor.onnx`` takes one step of the actor, ``critics.onnx`` one of the critics; memory and ``beta`` go in and memory
comes out, so whoever runs them keeps the memory. The ``.pt2`` files hold the same two programs for ``torch.export``.
"""

import contextlib
import importlib.util
import io
import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from rcdsac_trl.deploy.export.modules import ACTION_SIZE, ActorStep, CriticStep, network_of
from rcdsac_trl.deploy.policy.distortion import fractions_of
from rcdsac_trl.deploy.policy.inference import Actor, Array, Critics, Encoders
from rcdsac_trl.deploy.policy.weights import Weights
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.observation import MAX_RANGE_OBSERVATION, REMEMBERED_SIZE, vector_observations
from rcdsac_trl.robot.range_sensor import NUM_BINS
from rcdsac_trl.system.progress import Work

LIMIT = 1e-5
"""How far results may be from torch's: absolute; of quantiles, relative to the largest if that is beyond 1."""
_EXTRA = ("onnx", "onnxscript", "onnxruntime")
_ACTOR_INPUTS = ("range", "waypoint", "velocity", "context", "memory")
_CRITIC_INPUTS = ("range", "waypoint", "velocity", "context", "action", "memories")
_ACTOR_OUTPUTS = ("action", "next_memory")
_CRITIC_OUTPUTS = ("quantiles", "next_memories")

Runner = Callable[[dict[str, Array]], tuple[Array, Array]]
"""A program of one step: inputs by name to the output and the memory after it."""


def check_extra() -> None:
    """Refuse to export where a package for it is missing.

    Raises:
        UserInputError: with the line that installs it.
    """
    missing = [name for name in _EXTRA if importlib.util.find_spec(name) is None]
    if missing:
        raise UserInputError(f"{', '.join(missing)} is not installed: pip install 'rcdsac-trl[export]'")


@dataclass(frozen=True)
class Exported:
    """The programs of an agent as files, by name, and what runs them."""

    files: dict[str, bytes]
    runners: dict[str, tuple[Runner, Runner]]


def export_agent(weights: Weights, num_quantiles: int) -> Exported:
    """Return an agent's programs for batches of 1, and what runs each pair (actor, critics) of them.

    Args:
        weights: of the agent.
        num_quantiles: at how many fractions the critics tell the return; they are part of the program.
    """
    fractions = fractions_of(num_quantiles)
    modules: tuple[nn.Module, nn.Module] = (
        ActorStep.of_weights(weights).eval(),
        CriticStep(weights, torch.from_numpy(fractions)).eval(),
    )
    inputs = example_inputs(weights)
    more = ("remembered",) if weights.config.memory_s > 0.0 else ()
    names = (_ACTOR_INPUTS + more, _ACTOR_OUTPUTS), (_CRITIC_INPUTS + more, _CRITIC_OUTPUTS)
    files: dict[str, bytes] = {}
    onnx: list[Runner] = []
    programs: list[Runner] = []
    plain: list[Runner] = []
    for module, (given, out), stem in zip(modules, names, ("actor", "critics"), strict=True):
        example = tuple(torch.from_numpy(inputs[name]) for name in given)
        with _quiet():
            program = torch.export.export(module, example)
        buffer = io.BytesIO()
        torch.export.save(program, buffer)
        files[f"{stem}.pt2"] = buffer.getvalue()
        files[f"{stem}.onnx"] = _onnx(program, given, out)
        onnx.append(_onnx_runner(files[f"{stem}.onnx"]))
        programs.append(_torch_runner(torch.export.load(io.BytesIO(files[f"{stem}.pt2"])).module(), given))
        plain.append(_torch_runner(module, given))
    runners = {
        "torch": plain,
        "ONNX Runtime": onnx,
        "torch.export": programs,
        "NumPy": _numpy_runners(weights, fractions),
    }
    return Exported(files, {name: (pair[0], pair[1]) for name, pair in runners.items()})


def betas_of(weights: Weights, num_betas: int = 5) -> list[float]:
    """Return a grid over the trained range of ``beta``, its ends included; one number where there is no range."""
    low, high = weights.config.context_range or (0.0, 0.0)
    grid: list[float] = np.linspace(low, high, num_betas if high > low else 1).tolist()
    return grid


def differences(
    exported: Exported, weights: Weights, *, betas: Sequence[float], steps: int = 1000, work: Work | None = None
) -> dict[str, float]:
    """Return the largest difference of each kind of program from torch, each with a memory of its own.

    Differences count absolutely, those of quantiles relative to the largest of them if that is beyond 1.

    Args:
        exported: from :func:`export_agent`.
        weights: of the agent.
        betas: a whole drive for each.
        steps: of a drive.
        work: is told how far the drives are.
    """
    largest = {name: 0.0 for name in exported.runners if name != "torch"}
    for number, context in enumerate(betas):
        memories = {name: _memory(weights) for name in exported.runners}
        drive = _observations(weights, context, steps, seed=number)
        for observed in drive if work is None else work.within(drive, steps):
            expected: dict[str, Array] = {}
            for name, (actor, critics) in exported.runners.items():
                found, memories[name] = _step(actor, critics, observed, memories[name])
                expected = expected or found
                for key, value in found.items():
                    if name != "torch":
                        # Quantiles are sums of terms as large as the largest of them, rounded as those are.
                        scale = max(1.0, float(np.abs(expected[key]).max()))
                        largest[name] = max(largest[name], float(np.abs(value - expected[key]).max()) / scale)
        if work is not None:
            work.end_unit()
    return largest


def example_inputs(weights: Weights) -> dict[str, Array]:
    """Return one step's inputs of both programs by name, with their shapes: zeros."""
    sizes = {"range": NUM_BINS, "context": 1, "action": ACTION_SIZE} | vector_observations(weights.config.memory_s)
    given = {name: np.zeros((1, size), dtype=np.float32) for name, size in sizes.items()}
    actor, critics = _memory(weights)
    return given | {"memory": actor, "memories": critics}


def _memory(weights: Weights) -> tuple[Array, Array]:
    size = network_of(weights.config).state_size
    return np.zeros((1, size), np.float32), np.zeros((weights.config.num_critics, 1, size), np.float32)


def _observations(weights: Weights, context: float, steps: int, seed: int) -> Iterator[dict[str, Array]]:
    """Yield the observations of a made-up drive: ranges that come and go, waypoints all around."""
    rng = np.random.default_rng(seed)
    mask = weights.config.sensor_mask
    told = np.array([[context]], dtype=np.float32)
    for _ in range(steps):
        bins = rng.uniform(0.5, MAX_RANGE_OBSERVATION, NUM_BINS) * (rng.random(NUM_BINS) < 0.6) * mask
        bearings = rng.uniform(-np.pi, np.pi, 2)
        waypoint = np.stack((rng.uniform(-1.0, 1.0, 2), np.cos(bearings), np.sin(bearings)), axis=1).ravel()
        arrays = {"range": bins, "waypoint": waypoint, "velocity": rng.uniform(-0.6, 0.6, 4)}
        if weights.config.memory_s > 0.0:
            arrays["remembered"] = rng.uniform(0.0, 1.0, REMEMBERED_SIZE)
        yield {name: value.astype(np.float32)[None] for name, value in arrays.items()} | {"context": told}


def _step(
    actor: Runner, critics: Runner, observed: dict[str, Array], memory: tuple[Array, Array]
) -> tuple[dict[str, Array], tuple[Array, Array]]:
    action, after = actor(observed | {"memory": memory[0]})
    values, afters = critics(observed | {"action": action, "memories": memory[1]})
    return {"action": action, "memory": after, "values": values, "memories": afters}, (after, afters)


def _onnx(program: torch.export.ExportedProgram, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> bytes:
    with _quiet():
        made = torch.onnx.export(program, input_names=inputs, output_names=outputs, dynamo=True, verbose=False)
    assert made is not None
    return made.model_proto.SerializeToString()


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep the exporters' notes about themselves, and about a GRU's way of holding its weights, to themselves."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


def _onnx_runner(content: bytes) -> Runner:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    names = {given.name for given in session.get_inputs()}

    def run(inputs: dict[str, Array]) -> tuple[Array, Array]:
        value, memory = session.run(None, {name: array for name, array in inputs.items() if name in names})
        return value, memory

    return run


def _torch_runner(module: Callable[..., tuple[Tensor, Tensor]], names: tuple[str, ...]) -> Runner:
    def run(inputs: dict[str, Array]) -> tuple[Array, Array]:
        with torch.no_grad():
            value, memory = module(*(torch.from_numpy(inputs[name]) for name in names))
        return value.numpy(), memory.numpy()

    return run


def _numpy_runners(weights: Weights, fractions: NDArray[np.float32]) -> list[Runner]:
    config, mask = weights.config, weights.config.sensor_mask
    critic_encoders = [weights.part(f"critics.{number}.encoder") for number in range(config.num_critics)]
    how = config.padding, config.range_code, config.restart_steps, config.foreseen
    own, theirs = Encoders([weights.part("actor.encoder")], mask, *how), Encoders(critic_encoders, mask, *how)
    actor, critics = Actor(weights), Critics(weights, fractions)

    def told(inputs: dict[str, Array]) -> tuple[Array, float | None]:
        context = float(inputs["context"][0, 0])
        vectors = [inputs[name][0] for name in vector_observations(config.memory_s)]
        if config.context == "collision_weight":
            vectors.append(inputs["context"][0])
        slope, offset = config.embedding or (0.0, 0.0)
        return np.concatenate(vectors), slope * context + offset if config.embedding else None

    def act(inputs: dict[str, Array]) -> tuple[Array, Array]:
        vectors, embedded = told(inputs)
        state = own.step(inputs["range"][0], vectors, inputs["memory"])
        return actor.action(own.heads_read(state, vectors)[0], embedded)[None], state

    def judge(inputs: dict[str, Array]) -> tuple[Array, Array]:
        vectors, embedded = told(inputs)
        states = theirs.step(inputs["range"][0], vectors, inputs["memories"][:, 0])
        return critics.values(theirs.heads_read(states, vectors), inputs["action"][0], embedded)[None], states[:, None]

    return [act, judge]
