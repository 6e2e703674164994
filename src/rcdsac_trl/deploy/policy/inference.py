"""The networks of an agent, one observation at a time, in NumPy: what torch computes, without importing it.

One row is too little work for torch, whose operations cost more than what they compute, and whose import takes longer
than everything else on a robot's computer. The layers are those of :mod:`rcdsac_trl.agent.networks`, and
:mod:`rcdsac_trl.deploy.export.exported` holds this against them.

At this size a call of NumPy costs as much as what it computes, too, so equal layers of several networks are one product
of stacked matrices, and what does not depend on the observation is computed once. Every product has the form
``x @ weight`` with the weight stored as [in, out], in which BLAS reads it row by row.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.policy.weights import Weights
from rcdsac_trl.robot.action import LOG_STD_RANGE
from rcdsac_trl.robot.look_ahead import look_ahead
from rcdsac_trl.robot.observation import MAX_RANGE_OBSERVATION, RangeCode
from rcdsac_trl.robot.range_sensor import NUM_BINS
from rcdsac_trl.robot.ring import RING_ENDS, Padding

Array = NDArray[np.float32]
Tensors = Mapping[str, Array]

# Arrays, since NumPy takes longer to make one of a Python number than to compute a whole row with it.
_ZERO, _HALF = np.array(0.0, dtype=np.float32), np.array(0.5, dtype=np.float32)


class Encoders:
    """One observation and the states before it to the states after it, of all encoders of an agent at once.

    A state begins with the memory that the heads read. With ``restart_steps`` another one follows that takes its place
    in turn, and how many observations that one has read: so a memory has read about as many as in training, however
    long the robot drives.

    Args:
        parts: tensors of each ``rcdsac_trl.agent.networks.Encoder``, by name; all of one shape.
        mask: the bins that the sensor has, bool [180]; the others are always 0.
        padding: how the convolutions read the ring of bins; see :mod:`rcdsac_trl.robot.ring`.
        range_code: how they read a bin; see :data:`rcdsac_trl.robot.observation.RangeCode`.
        restart_steps: a state restarts every so many observations; None: never.
        foreseen: where in the vector observations the foreseen clearances stand, which heads read; None: they do not.

    Attributes:
        number: of encoders, E.
        memory_size: numbers of a memory.
        state_size: numbers of a state.
    """

    def __init__(
        self,
        parts: Sequence[Tensors],
        mask: NDArray[np.bool_],
        padding: Padding,
        range_code: RangeCode,
        restart_steps: int | None = None,
        foreseen: slice | None = None,
    ) -> None:
        self._foreseen = foreseen
        self._reads_nearness = range_code == "nearness"
        self._restart_steps = restart_steps
        self.number, self.memory_size = len(parts), parts[0]["gru.weight_hh_l0"].shape[1]
        self.state_size = self.memory_size if restart_steps is None else 2 * self.memory_size + 1
        self._convolve(parts, RING_ENDS[padding])
        self._select(parts, mask)
        self._vectors = _side_by_side(parts)
        self._gates = _recurrence(parts)

    def _convolve(self, parts: Sequence[Tensors], ends: tuple[int, int]) -> None:
        """Lay out the convolutions as products with all that one position reads, [E, tap * channel, channel]."""
        convolutions = [_stacked(parts, f"range.conv_{number}.weight") for number in (1, 2)]
        self._convolutions = [
            (weight.transpose(0, 3, 2, 1).reshape(len(parts), -1, weight.shape[1]), _row(parts, bias))
            for weight, bias in zip(convolutions, ("range.conv_1.bias", "range.conv_2.bias"), strict=True)
        ]
        taps_1, taps_2 = (weight.shape[3] for weight in convolutions)
        before, read = ends[0], NUM_BINS + sum(ends)
        windows = (_windows(read, taps_1) - before) % NUM_BINS, _windows((read - taps_1) // 2 + 1, taps_2)
        self._windows: tuple[NDArray[np.intp], NDArray[np.intp]] = windows

    def _select(self, parts: Sequence[Tensors], mask: NDArray[np.bool_]) -> None:
        """Keep of the positions those that see a bin of the sensor: the others say the same at every step."""
        all_1, all_2 = self._windows
        sees: NDArray[np.bool_] = np.any(mask[all_1], axis=1)
        live: NDArray[np.bool_] = np.any(sees[all_2], axis=1)
        inactive = self._positions(np.zeros(NUM_BINS, dtype=np.float32)) * ~live[:, None]
        weight = _transposed(parts, "range.linear.weight")
        constant = inactive.reshape(len(parts), 1, -1) @ weight + _row(parts, "range.linear.bias")
        needed, again = np.unique(all_2[live], return_inverse=True)
        self._windows = all_1[needed], again.reshape(-1, all_2.shape[1])
        active = weight.reshape(len(parts), len(live), -1, weight.shape[2])[:, live]
        self._linear = active.reshape(len(parts), -1, weight.shape[2]), constant

    def step(self, bins: Array, vectors: Array, states: Array) -> Array:
        """Return the next states [E, state].

        Args:
            bins: range observation, [180].
            vectors: the vector observations, one behind the other, [k].
            states: [E, state], zeros at the start.
        """
        if self._reads_nearness:
            bins = np.where(bins > _ZERO, np.float32(MAX_RANGE_OBSERVATION) - bins, _ZERO)
        weight, bias = self._linear
        from_range = self._positions(bins).reshape(self.number, 1, -1) @ weight
        from_range += bias
        weight, bias = self._vectors
        from_vectors = vectors[None] @ weight
        from_vectors += bias
        features = np.concatenate((from_range, from_vectors), axis=2)
        np.maximum(features, _ZERO, out=features)
        if self._restart_steps is None:
            return self._remember(features, states[:, None])[:, 0]
        size, age = self.memory_size, states[0, -1]  # of all encoders alike
        before = states[:, :-1].reshape(self.number, 2, size)
        if age >= self._restart_steps:
            before, age = np.stack((before[:, 1], np.zeros_like(before[:, 1])), axis=1), _ZERO
        after = np.empty_like(states)
        after[:, :-1] = self._remember(features, before).reshape(self.number, 2 * size)
        after[:, -1] = age + 1
        return after

    def heads_read(self, states: Array, vectors: Array) -> Array:
        """Return what each encoder's head reads, [E, n], of the states after an observation and its vectors."""
        memories = states[:, : self.memory_size]
        if self._foreseen is None:
            return memories
        foreseen = vectors[self._foreseen]
        return np.concatenate((memories, np.broadcast_to(foreseen, (self.number, len(foreseen)))), axis=1)

    def _positions(self, bins: Array) -> Array:
        """Return what both convolutions make of the bins at the live positions, [E, positions, channels]."""
        (weight_1, bias_1), (weight_2, bias_2) = self._convolutions
        windows_1, windows_2 = self._windows
        first = bins[windows_1] @ weight_1
        first += bias_1
        np.maximum(first, _ZERO, out=first)
        second = first.take(windows_2, axis=1).reshape(self.number, len(windows_2), -1) @ weight_2
        second += bias_2
        return np.maximum(second, _ZERO, out=second)

    def _remember(self, features: Array, before: Array) -> Array:
        """Return the next memories [E, m, memory], of features [E, 1, n] and the memories before [E, m, memory]."""
        weight_x, bias_x, weight_h, bias_h = self._gates
        inputs = features @ weight_x
        inputs += bias_x
        recurrent = before @ weight_h
        size = self.memory_size
        gates = inputs[..., : 2 * size] + recurrent[..., : 2 * size]
        # The logistic function of twice that (see _recurrence), in a form that cannot overflow.
        np.tanh(gates, out=gates)
        gates *= _HALF
        gates += _HALF
        r, z = gates[..., :size], gates[..., size:]
        proposed = recurrent[..., 2 * size :] + bias_h
        proposed *= r
        proposed += inputs[..., 2 * size :]
        np.tanh(proposed, out=proposed)
        after = before - proposed
        after *= z
        after += proposed
        return after


class Actor:
    """What its encoder hands on to an action; see ``rcdsac_trl.agent.heads.ActorHead``."""

    def __init__(self, weights: Weights) -> None:
        parts = [weights.part("actor.head")]
        self._angles = _angles(weights)
        self._input, self._hidden, self._output = (_linear(parts, name) for name in ("input", "hidden", "output"))
        self._gate = _linear(parts, "gate") if "gate.weight" in parts[0] else None

    def action(self, read: Array, embedded: float | None, noise: Array | None = None) -> Array:
        """Return an action, [2]: tanh(mean), or one beside it; or several of these, [K, 2].

        Args:
            read: [n], see :meth:`Encoders.heads_read`.
            embedded: ``beta`` in [0, 1]; None where the networks read none.
            noise: added to the mean, in standard deviations of the policy, [2] or [K, 2]: an action is drawn with
                standard normal numbers. None: the mean is meant.
        """
        x = _rectified(read[None], self._input)
        if self._gate is not None and embedded is not None:
            x *= _rectified(_cosines(embedded, self._angles), self._gate)
        weight, bias = self._output
        outputs = (_rectified(x, self._hidden) @ weight + bias)[0, 0]
        if noise is None:
            return np.tanh(outputs[:2])
        return np.tanh(outputs[:2] + noise * np.exp(np.clip(outputs[2:], *LOG_STD_RANGE)))


class Critics:
    """What their encoders hand on and an action to quantiles of the return, or its mean: of all critics' the lower.

    Args:
        weights: of the agent.
        fractions: at which quantiles are asked for, [N], in (0, 1); scalar critics know none.
    """

    def __init__(self, weights: Weights, fractions: Array) -> None:
        parts = [weights.part(f"critics.{number}.head") for number in range(weights.config.num_critics)]
        self._looks_ahead = weights.config.look_ahead
        self._angles = _angles(weights)
        self._input, self._hidden, self._output = (_linear(parts, name) for name in ("input", "hidden", "output"))
        told = "gate_beta.weight" in parts[0]
        self._beta = _transposed(parts, "gate_beta.weight") if told else None
        self._tau = _linear(parts, "gate_tau") if "gate_tau.weight" in parts[0] else None
        # The fractions never change: neither does their half of the gates.
        self._of_fractions = self.of_fractions(fractions)

    def values(self, read: Array, action: Array, embedded: float | None) -> Array:
        """Return the lower of the critics' quantiles each, [N], or of scalar critics' means, [1].

        Quantiles rise: those of each critic are rearranged (Chernozhukov, Fernandez-Val and Galichon 2010).

        Args:
            read: of each critic, [C, n], see :meth:`Encoders.heads_read`.
            action: u, [2].
            embedded: ``beta`` in [0, 1]; None where the networks read none.
        """
        return self.of_actions(read, action[None], embedded)[0]

    def of_actions(self, read: Array, actions: Array, embedded: float | None) -> Array:
        """Return what :meth:`values` says of each of several actions, [K, N], or [K, 1] of scalar critics.

        Args:
            read: of each critic, [C, n].
            actions: [K, 2].
            embedded: ``beta`` in [0, 1]; None where the networks read none.
        """
        values = self._values(read, actions, self.gate(self._of_fractions, embedded))
        # Networks may cross their quantiles a little; in rising order they are never farther from the true ones.
        return np.minimum.reduce(np.sort(values, axis=2))

    def means(self, read: Array, actions: Array, gate: Array | None) -> Array:
        """Return the mean that each critic expects of several actions over the fractions of its gate, [C, K].

        Args:
            read: of each critic, [C, n].
            actions: [K, 2].
            gate: from :meth:`gate`.
        """
        return self._values(read, actions, gate).mean(axis=2)

    def of_fractions(self, fractions: Array) -> Array | None:
        """Return the half of critics' gates that fractions [N] in [0, 1] make, [C, N, head]; None of scalar ones."""
        if self._tau is None:
            return None
        weight, bias = self._tau
        of_fractions: Array = np.concatenate([_cosines(float(tau), self._angles) for tau in fractions]) @ weight + bias
        return of_fractions

    def gate(self, of_fractions: Array | None, embedded: float | None) -> Array | None:
        """Return each critic's gates at some fractions, [C, N, head]; None of scalar critics.

        Args:
            of_fractions: from :meth:`of_fractions`.
            embedded: ``beta`` in [0, 1]; None where the networks read none.
        """
        if of_fractions is None:
            return None
        gate = of_fractions
        if self._beta is not None and embedded is not None:
            gate = gate + _cosines(embedded, self._angles) @ self._beta
        return np.maximum(gate, _ZERO)

    def _values(self, read: Array, actions: Array, gate: Array | None) -> Array:
        """Return each critic's quantiles of several actions as they come, [C, K, N], or [C, K, 1] of scalar critics."""
        told = np.concatenate((actions, look_ahead(read[0], actions)), axis=1) if self._looks_ahead else actions
        weight, bias = self._input
        size = read.shape[1]
        # What was read is the same for all actions.
        x = read[:, None] @ weight[:, :size] + told @ weight[:, size:]
        x += bias
        x = np.maximum(x, _ZERO, out=x)[:, :, None]
        if gate is not None:
            x = x * gate[:, None]
        # A product an action, as far as BLAS goes: it would share a larger one among threads, which on a busy computer
        # wait for each other much longer than they multiply.
        hidden, output = ((weight[:, None], bias[:, None]) for weight, bias in (self._hidden, self._output))
        values = _rectified(x, hidden) @ output[0]
        values += output[1]
        return values[..., 0]


def _rectified(x: Array, layer: tuple[Array, Array]) -> Array:
    """Return max(0, x W + b), [E, .., n, out], for x [n, in] or [E, .., n, in]."""
    weight, bias = layer
    y = x @ weight
    y += bias
    return np.maximum(y, _ZERO, out=y)


def _linear(parts: Sequence[Tensors], name: str) -> tuple[Array, Array]:
    """Return weight [E, in, out] and bias [E, 1, out] of a layer."""
    return _transposed(parts, f"{name}.weight"), _row(parts, f"{name}.bias")


def _stacked(parts: Sequence[Tensors], name: str) -> Array:
    return np.stack([tensors[name] for tensors in parts])


def _transposed(parts: Sequence[Tensors], name: str) -> Array:
    return np.ascontiguousarray(_stacked(parts, name).swapaxes(1, 2))


def _row(parts: Sequence[Tensors], name: str) -> Array:
    return _stacked(parts, name)[:, None]


def _side_by_side(parts: Sequence[Tensors]) -> tuple[Array, Array]:
    """Return the layers of the vector observations as one, block by block: weight [E, k, n] and bias [E, 1, n]."""
    number = sum(name.startswith("vectors.") for name in parts[0]) // 2
    layers = [_linear(parts, f"vectors.{i}") for i in range(number)]
    inputs, outputs = (sum(weight.shape[axis] for weight, _ in layers) for axis in (1, 2))
    joined = np.zeros((len(parts), inputs, outputs), dtype=np.float32)
    row = column = 0
    for weight, _ in layers:
        joined[:, row : row + weight.shape[1], column : column + weight.shape[2]] = weight
        row, column = row + weight.shape[1], column + weight.shape[2]
    return joined, np.concatenate([bias for _, bias in layers], axis=2)


def _recurrence(parts: Sequence[Tensors]) -> tuple[Array, Array, Array, Array]:
    """Return the recurrent layer's weights and biases for what comes in, and for what is remembered.

    Both biases of the gates are in the first; what is left of the second is that of the proposed memory. Weights and
    biases of the gates are halved, exactly, since the logistic function of x is (1 + tanh(x / 2)) / 2.
    """
    weight_x, weight_h = (_transposed(parts, f"gru.weight_{side}_l0") for side in ("ih", "hh"))
    bias_x, bias_h = (_row(parts, f"gru.bias_{side}_l0") for side in ("ih", "hh"))
    gates = 2 * weight_h.shape[1]
    bias_x[..., :gates] += bias_h[..., :gates]
    for tensor in (weight_x, bias_x, weight_h):
        tensor[..., :gates] *= _HALF
    return weight_x, bias_x, weight_h, np.ascontiguousarray(bias_h[..., gates:])


def _windows(positions: int, taps: int) -> NDArray[np.intp]:
    """Return the positions that a convolution of stride 2 reads, [outputs, taps]."""
    return 2 * np.arange((positions - taps) // 2 + 1)[:, None] + np.arange(taps)


def _angles(weights: Weights) -> Array:
    """Return pi, 2 pi, ..., one for each cosine, [cosines]."""
    # In float32 as torch has it: the last angles are large, and rounding there is seen.
    return np.float32(np.pi) * np.arange(1, weights.config.network["cosines"] + 1, dtype=np.float32)


def _cosines(x: float, angles: Array) -> Array:
    """Return the cosines that stand for a number in [0, 1], [1, cosines]."""
    return np.cos(np.float32(x) * angles)[None]
