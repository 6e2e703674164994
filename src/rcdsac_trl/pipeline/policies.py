"""Policies: the agent's, made lean, the pursuit baseline, the warm-up, and a policy on another device."""

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules.distributions.utils import safetanh_noeps

from rcdsac_trl.agent.actor import STATE_KEY
from rcdsac_trl.pipeline.interrupts import interruption_point
from rcdsac_trl.seeding import torch_seed
from rcdsac_trl.world.pursuit import pursuit_action

# Autocorrelation of the warm-up's noise from one agent step (about 0.14 s) to the next: it lasts some 10 steps.
PERSISTENCE = 0.9


class LeanPolicy(TensorDictModuleBase):
    """What :func:`rcdsac_trl.agent.actor.build_policy` returns, with the same keys and the same bits, but faster.

    On a handful of agents the modules and distributions that a ``ProbabilisticActor`` goes through cost more than the
    networks; here the two networks are called as they are.

    Args:
        actor: an encoder and a head, from :func:`rcdsac_trl.agent.actor.build_actor`; it shares its weights.
        generator: source of the action noise, on the actor's device.
    """

    def __init__(self, actor: TensorDictSequential, generator: torch.Generator) -> None:
        super().__init__()
        encoder, head = actor[0], actor[1]
        self.encoder = encoder.module
        self.head = head.module
        self.generator = generator
        self._encoder_keys = [*encoder.in_keys, "is_init", STATE_KEY]
        self._head_keys = head.in_keys[1:]  # behind the encoder's memory
        self.in_keys = [*self._encoder_keys, *self._head_keys]
        self.out_keys = ["loc", "scale", ("next", STATE_KEY), "action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `loc`, `scale`, `action` and the next recurrent state."""
        state = self.encoder.step(*[tensordict.get(key) for key in self._encoder_keys])
        loc, scale = self.head(state, *[tensordict.get(key) for key in self._head_keys])
        before_tanh = loc
        if exploration_type() is not ExplorationType.DETERMINISTIC:
            before_tanh = loc + torch.empty_like(loc).normal_(generator=self.generator) * scale
        tensordict.set("loc", loc)
        tensordict.set("scale", scale)
        tensordict.set("action", safetanh_noeps(before_tanh))
        return tensordict.set(("next", STATE_KEY), state)


class PursuitPolicy(TensorDictModuleBase):
    """Drives straight to the next waypoint; see :mod:`rcdsac_trl.world.pursuit`."""

    in_keys = ["waypoint"]  # noqa: RUF012 (TensorDictModuleBase's own form)
    out_keys = ["action"]  # noqa: RUF012

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action`."""
        return tensordict.set("action", pursuit_action(tensordict["waypoint"]))


class CollectionPolicy(TensorDictModuleBase):
    """The agent's policy, preceded by some iterations of noisy pursuit.

    Random actions press the robot against walls most of the time. A pursuit controller under noise that keeps its
    sign for a second or two shows the critics driving, turning, backing out, goals and collisions from the first
    update.

    Args:
        policy: the agent's policy.
        generator: source of all exploration noise, seeded anew for each iteration.
        seed: root seed; iteration i uses the stream ``("exploration", i)``.
        pursuit_iterations: first iterations driven by pursuit.
        pursuit_noise: standard deviation of the noise on its actions, a first-order autoregressive process.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        *,
        generator: torch.Generator,
        seed: int,
        pursuit_iterations: int,
        pursuit_noise: float,
    ) -> None:
        super().__init__()
        self.in_keys = policy.in_keys
        self.out_keys = policy.out_keys
        self.policy = policy
        self.generator = generator
        self.seed = seed
        self.pursuit_iterations = pursuit_iterations
        self.pursuit_noise = pursuit_noise
        self._pursuing = False
        self._noise = torch.zeros(())

    def set_iteration(self, iteration: int) -> None:
        """Choose the driver and the noise of an iteration."""
        self._pursuing = iteration < self.pursuit_iterations
        self.generator.manual_seed(torch_seed(self.seed, "exploration", iteration))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` and the agent's other outputs, which stay the agent's own while pursuit drives."""
        interruption_point()
        tensordict = self.policy(tensordict)
        if self._pursuing:
            action = pursuit_action(tensordict["waypoint"])
            noise = self._next_noise(action, tensordict["is_init"])
            tensordict["action"] = (action + self.pursuit_noise * noise).clamp(-1.0, 1.0)
        return tensordict

    def _next_noise(self, action: Tensor, is_init: Tensor) -> Tensor:
        fresh = torch.empty(action.shape, device=self.generator.device).normal_(generator=self.generator)
        fresh = fresh.to(action.device)
        kept = PERSISTENCE * self._noise + (1 - PERSISTENCE**2) ** 0.5 * fresh
        self._noise = torch.where(is_init, fresh, kept)
        return self._noise


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
