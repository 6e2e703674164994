"""The networks of an agent, one observation at a time, in NumPy: what torch computes, without importing it.

One row is too little work for torch, whose operations cost more than what they compute, and whose import takes longer
than everything else on a robot's computer. The layers are those of :mod:`rcdsac_trl.agent.networks`, and
:mod:`rcdsac_trl.deploy.exported` holds this against them.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.weights import Weights
from rcdsac_trl.interface import NUM_BINS

Array = NDArray[np.float32]


class Encoders:
    """One observation and the memories before it to the memories after it, of all encoders of an agent at once.

    Args:
        parts: tensors of each ``rcdsac_trl.agent.networks.Encoder``, by name; all of one shape.
        mask: the bins that the sensor has, bool [180]; the others are always 0.
    """

    def __init__(self, parts: Sequence[Mapping[str, Array]], mask: NDArray[np.bool_]) -> None:
        def stacked(name: str) -> Array:
            return np.stack([tensors[name] for tensors in parts])

        def column(name: str) -> Array:
            return stacked(name)[:, :, None]

        conv_1, conv_2 = stacked("range.conv_1.weight"), stacked("range.conv_2.weight")
        self._conv_1 = np.ascontiguousarray(conv_1[:, :, 0].swapaxes(1, 2))  # [E, tap, channel]
        self._conv_2 = conv_2.transpose(0, 3, 2, 1).reshape(len(parts), -1, conv_2.shape[1])  # [E, tap * channel, out]
        self._conv_biases = stacked("range.conv_1.bias")[:, None], stacked("range.conv_2.bias")[:, None]
        taps_1, taps_2 = conv_1.shape[3], conv_2.shape[3]
        all_1, all_2 = _windows(NUM_BINS, taps_1), _windows((NUM_BINS - taps_1) // 2 + 1, taps_2)
        # Positions that see no bin of the sensor say the same at every step: their part is known beforehand.
        hears: NDArray[np.bool_] = np.any(mask[all_1], axis=1)
        live: NDArray[np.bool_] = np.any(hears[all_2], axis=1)
        self._windows = all_1, all_2
        silent = self._positions(np.zeros(NUM_BINS, dtype=np.float32)) * ~live[:, None]
        weight = stacked("range.linear.weight")
        constant = weight @ silent.reshape(len(parts), -1, 1) + column("range.linear.bias")
        needed, again = np.unique(all_2[live], return_inverse=True)
        self._windows = all_1[needed], again.reshape(-1, taps_2)
        heard = weight.reshape(*weight.shape[:2], len(live), -1)[:, :, live]
        self._linear = np.ascontiguousarray(heard.reshape(*weight.shape[:2], -1)), constant
        self._vectors = _side_by_side(parts)
        self._inputs = stacked("gru.weight_ih_l0"), column("gru.bias_ih_l0")
        self._recurrent = stacked("gru.weight_hh_l0"), column("gru.bias_hh_l0")
        self.number, _, self.size = self._recurrent[0].shape

    def step(self, bins: Array, vectors: Array, memories: Array) -> Array:
        """Return the next memories [E, memory].

        Args:
            bins: range observation, [180].
            vectors: the vector observations, one behind the other, [k].
            memories: [E, memory].
        """
        weight, bias = self._vectors
        from_vectors = np.maximum(weight @ vectors[:, None] + bias, 0)
        weight, bias = self._linear
        from_range = np.maximum(weight @ self._positions(bins).reshape(self.number, -1, 1) + bias, 0)
        features = np.concatenate((from_range, from_vectors), axis=1)
        before = memories[:, :, None]
        weight, bias = self._inputs
        inputs = weight @ features + bias
        weight, bias = self._recurrent
        recurrent = weight @ before + bias
        size = self.size
        gates = np.tanh(0.5 * (inputs[:, : 2 * size] + recurrent[:, : 2 * size]))
        gates = 0.5 * gates + 0.5  # the logistic function, in a form that cannot overflow
        r, z = gates[:, :size], gates[:, size:]
        n = np.tanh(inputs[:, 2 * size :] + r * recurrent[:, 2 * size :])
        return (n + z * (before - n))[:, :, 0]

    def _positions(self, bins: Array) -> Array:
        """Return what both convolutions make of the bins at the live positions, [E, positions, channels]."""
        windows_1, windows_2 = self._windows
        first = np.maximum(bins[windows_1] @ self._conv_1 + self._conv_biases[0], 0)
        seen = first[:, windows_2].reshape(len(first), len(windows_2), -1)
        return np.maximum(seen @ self._conv_2 + self._conv_biases[1], 0)


def _side_by_side(parts: Sequence[Mapping[str, Array]]) -> tuple[Array, Array]:
    """Return the layers of the vector observations as one, block by block: weight [E, n, k] and bias [E, n, 1]."""
    number = sum(name.startswith("vectors.") for name in parts[0]) // 2
    blocks = [np.stack([tensors[f"vectors.{i}.weight"] for tensors in parts]) for i in range(number)]
    biases = [np.stack([tensors[f"vectors.{i}.bias"] for tensors in parts]) for i in range(number)]
    outputs, inputs = (sum(block.shape[axis] for block in blocks) for axis in (1, 2))
    weight = np.zeros((len(parts), outputs, inputs), dtype=np.float32)
    row = column = 0
    for block in blocks:
        weight[:, row : row + block.shape[1], column : column + block.shape[2]] = block
        row, column = row + block.shape[1], column + block.shape[2]
    return weight, np.concatenate(biases, axis=1)[:, :, None]


class Actor:
    """A memory to an action; see ``rcdsac_trl.agent.networks.ActorHead``."""

    def __init__(self, weights: Weights) -> None:
        tensors = weights.part("actor.head")
        self._cosines = weights.config.network["cosines"]
        self._input, self._hidden = _Linear(tensors, "input"), _Linear(tensors, "hidden")
        self._output = _Linear(tensors, "output")
        self._gate = _Linear(tensors, "gate") if "gate.weight" in tensors else None

    def action(self, memory: Array, embedded: float | None) -> Array:
        """Return the deterministic action tanh(mean), [2].

        Args:
            memory: [memory].
            embedded: ``beta`` in [0, 1]; None where the networks read none.
        """
        x = np.maximum(self._input(memory), 0)
        if self._gate is not None and embedded is not None:
            x = x * np.maximum(self._gate(_cosines(embedded, self._cosines)), 0)
        mean = self._output(np.maximum(self._hidden(x), 0))[:2]
        return np.tanh(mean)


class Critic:
    """A memory and an action to quantiles of the return, or to its mean.

    Args:
        weights: of the agent.
        number: which of its critics, from 0.
        fractions: at which quantiles are asked for, [N], in (0, 1); a scalar critic knows none.
    """

    def __init__(self, weights: Weights, number: int, fractions: Array) -> None:
        tensors = weights.part(f"critics.{number}.head")
        self._cosines = weights.config.network["cosines"]
        self._input, self._hidden = _Linear(tensors, "input"), _Linear(tensors, "hidden")
        self._output = _Linear(tensors, "output")
        self._beta = tensors.get("gate_beta.weight")
        self._gate: Array | None = None
        if "gate_tau.weight" in tensors:
            # The fractions never change: neither does their half of the gate, [N, head].
            gate_tau = _Linear(tensors, "gate_tau")
            self._gate = np.stack([gate_tau(_cosines(float(tau), self._cosines)) for tau in fractions])

    def values(self, memory: Array, action: Array, embedded: float | None) -> Array:
        """Return the quantiles [N], or the mean [1] of a scalar critic."""
        x = np.maximum(self._input(np.concatenate((memory, action))), 0)[None]
        if self._gate is not None:
            gate = self._gate
            if self._beta is not None and embedded is not None:
                gate = gate + self._beta @ _cosines(embedded, self._cosines)
            x = x * np.maximum(gate, 0)
        return self._output(np.maximum(self._hidden(x), 0))[:, 0]


class _Linear:
    """``x W^T + b`` for ``x`` [in] or [n, in]."""

    def __init__(self, tensors: Mapping[str, Array], name: str) -> None:
        self._weight, self._bias = tensors[f"{name}.weight"], tensors[f"{name}.bias"]

    def __call__(self, x: Array) -> Array:
        product = self._weight @ x if x.ndim == 1 else x @ self._weight.T
        return product + self._bias


def _windows(positions: int, taps: int) -> NDArray[np.intp]:
    """Return the positions that a convolution of stride 2 reads, [outputs, taps]."""
    return 2 * np.arange((positions - taps) // 2 + 1)[:, None] + np.arange(taps)


def _cosines(x: float, number: int) -> Array:
    # In float32 as torch has it: the last angles are large, and rounding there is seen.
    angles = np.float32(x) * (np.float32(np.pi) * np.arange(1, number + 1, dtype=np.float32))
    return np.cos(angles)
