"""Policies: the agent's, made lean, the pursuit baseline, the warm-up, and a policy on another device."""

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules.distributions.utils import safetanh_noeps

from rcdsac_trl.agent.actor import STATE_KEY
from rcdsac_trl.agent.kernels.compiled_actor import CompiledActor
from rcdsac_trl.agent.kernels.dispatch import has_compiled_actor
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.rollout.planners.pursuit import pursuit_action
from rcdsac_trl.seeding import stream
from rcdsac_trl.system.interrupts import interruption_point
from rcdsac_trl.world.task.spaces import ACTION_SIZE

# Autocorrelation of the warm-up's noise from one agent step (about 0.14 s) to the next: it lasts some 10 steps.
PERSISTENCE = 0.9
# Steps whose noise is drawn together.
_BLOCK = 256


class AgentNoise:
    """Standard normal numbers for the actions of some agents: a stream of its own for each of them.

    So an agent's noise does not depend on which others there are, nor on who holds it.

    Args:
        agent_ids: numbers of the agents, in the order of the flattened batch; equal numbers draw equal noise.

    Example:
        >>> noise = AgentNoise([3, 4])
        >>> noise.begin(0, "exploration", 7)
        >>> noise.draw().shape
        torch.Size([2, 2])
    """

    def __init__(self, agent_ids: Sequence[int]) -> None:
        self.agent_ids = tuple(agent_ids)
        self._streams: list[np.random.Generator] = []
        self._block = torch.empty(0, len(self.agent_ids), ACTION_SIZE, dtype=torch.float32)
        self._used = 0

    def begin(self, seed: int, purpose: str, *index: int) -> None:
        """Begin the streams (seed, purpose, *index, agent)."""
        self._streams = [stream(seed, purpose, *index, agent) for agent in self.agent_ids]
        self._used = len(self._block)

    def draw(self) -> Tensor:
        """Return the next numbers, ``[N, action]``."""
        if self._used == len(self._block):
            drawn = [each.standard_normal((_BLOCK, ACTION_SIZE), np.float32) for each in self._streams]
            self._block = torch.from_numpy(np.stack(drawn, axis=1))
            self._used = 0
        self._used += 1
        return self._block[self._used - 1]


class LeanPolicy(TensorDictModuleBase):
    """What :func:`rcdsac_trl.agent.actor.build_policy` returns, with the same keys, to rounding, but faster.

    On a handful of agents the modules and distributions that a ``ProbabilisticActor`` goes through cost more than the
    networks. Here the CPU does a step in one compiled pass, in which an agent's numbers do not depend on the others;
    another device, and networks that the pass does not know, run their layers.

    Args:
        actor: an encoder and a head, from :func:`rcdsac_trl.agent.actor.build_actor`; its weights are shared.
        noise: of the agents' actions.
    """

    def __init__(self, actor: TensorDictSequential, noise: AgentNoise) -> None:
        super().__init__()
        encoder, head = actor[0], actor[1]
        self.encoder = encoder.module
        self.head = head.module
        self.noise = noise
        self._compiled = CompiledActor(actor) if has_compiled_actor(self.encoder, self.head) else None
        self._vector_keys = encoder.in_keys[1:]  # behind the range
        self._head_keys = head.in_keys[1:]  # behind the encoder's memory
        self.in_keys = [*encoder.in_keys, "is_init", STATE_KEY, *self._head_keys]
        self.out_keys = ["loc", "scale", ("next", STATE_KEY), "action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `loc`, `scale`, `action` and the next recurrent state."""

        def rows(key: str) -> Tensor:
            value = tensordict.get(key)
            return value.reshape(-1, value.shape[-1])

        noise = None if exploration_type() is ExplorationType.DETERMINISTIC else self.noise.draw()
        range_, is_init, state = rows("range"), rows("is_init"), rows(STATE_KEY)
        vectors = [rows(key) for key in self._vector_keys]
        risk = rows(self._head_keys[0]) if self._head_keys else None
        if self._compiled is not None and range_.device.type == "cpu":
            outputs = self._compiled.step(range_, vectors, risk, is_init, state, noise)
        else:
            with torch.no_grad():
                memory, state = self.encoder.step(range_, *vectors, is_init, state)
                loc, scale = self.head(memory, *([] if risk is None else [risk]))
                before_tanh = loc if noise is None else loc + noise.to(loc.device) * scale
                outputs = loc, scale, safetanh_noeps(before_tanh), state
        for key, value in zip(("loc", "scale", "action", ("next", STATE_KEY)), outputs, strict=True):
            tensordict.set(key, value.view(*tensordict.batch_size, -1))
        return tensordict


class PursuitPolicy(TensorDictModuleBase):
    """Drives straight to the next waypoint; see :mod:`rcdsac_trl.rollout.planners.pursuit`."""

    in_keys = ["waypoint"]  # noqa: RUF012 (TensorDictModuleBase's own form)
    out_keys = ["action"]  # noqa: RUF012

    def __init__(self, robot: RobotSettings = PAPER) -> None:
        super().__init__()
        self._robot = robot

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action`."""
        return tensordict.set("action", pursuit_action(tensordict["waypoint"], self._robot))


class CollectionPolicy(TensorDictModuleBase):
    """The agent's policy, preceded by some iterations of noisy pursuit.

    Random actions press the robot against walls most of the time. A pursuit controller under noise that keeps its
    sign for a second or two shows the critics driving, turning, backing out, goals and collisions from the first
    update.

    Args:
        policy: the agent's policy.
        noise: of the policy's actions; agent j's in iteration i is the stream ``("exploration", i, j)``.
        seed: root seed.
        pursuit_iterations: first iterations driven by pursuit.
        pursuit_noise: standard deviation of the noise on its actions, a first-order autoregressive process.
        robot: that is driven.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        *,
        noise: AgentNoise,
        seed: int,
        pursuit_iterations: int,
        pursuit_noise: float,
        robot: RobotSettings = PAPER,
    ) -> None:
        super().__init__()
        self.in_keys = policy.in_keys
        self.out_keys = policy.out_keys
        self.policy = policy
        self.noise = noise
        self.seed = seed
        self.pursuit_iterations = pursuit_iterations
        self.pursuit_noise = pursuit_noise
        self._robot = robot
        self._pursuing = False
        self._pursuit_draws = AgentNoise(noise.agent_ids)
        self._lasting = torch.zeros((), dtype=torch.float32, device="cpu")

    def set_iteration(self, iteration: int) -> None:
        """Choose the driver and the noise of an iteration."""
        self._pursuing = iteration < self.pursuit_iterations
        self.noise.begin(self.seed, "exploration", iteration)
        self._pursuit_draws.begin(self.seed, "pursuit noise", iteration)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` and the agent's other outputs, which stay the agent's own while pursuit drives."""
        interruption_point()
        tensordict = self.policy(tensordict)
        if self._pursuing:
            action = pursuit_action(tensordict["waypoint"], self._robot)
            noise = self._next_noise(tensordict["is_init"])
            tensordict["action"] = (action + self.pursuit_noise * noise).clamp(-1.0, 1.0)
        return tensordict

    def _next_noise(self, is_init: Tensor) -> Tensor:
        fresh = self._pursuit_draws.draw().view(*is_init.shape[:-1], ACTION_SIZE)
        kept = PERSISTENCE * self._lasting + (1 - PERSISTENCE**2) ** 0.5 * fresh
        self._lasting = torch.where(is_init, fresh, kept)
        return self._lasting


class OnDevice(TensorDictModuleBase):
    """Runs a policy on its device for an environment on the CPU."""

    def __init__(self, policy: TensorDictModuleBase, device: torch.device | str) -> None:
        super().__init__()
        self.in_keys = policy.in_keys
        self.out_keys = policy.out_keys
        self.policy = policy
        self.device = torch.device(device)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the policy's outputs on the CPU."""
        out = self.policy(tensordict.select(*self.in_keys).to(self.device))
        return tensordict.update(out.select(*self.out_keys).to("cpu"))
