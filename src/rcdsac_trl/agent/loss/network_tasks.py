"""Losses and their gradients of a small mini-batch: a task for each step of each network, on a few threads.

A mini-batch as small as the laptop's gains nothing from being cut (:mod:`rcdsac_trl.agent.loss.batch_threads`): every
part calls every operation. But most of what its networks do does not wait for one another.
"""

from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.objectives.utils import _reduce

from rcdsac_trl.agent.loss.batch_parts import useful_threads
from rcdsac_trl.agent.loss.batch_threads import Gradients, gradients_of, thread_pool, with_gradients
from rcdsac_trl.agent.loss.samples import LossSamples

if TYPE_CHECKING:
    from rcdsac_trl.agent.loss.distributional_sac import DistributionalSACLoss


def backward_in_tasks(
    loss: "DistributionalSACLoss", tensordict: TensorDictBase, samples: LossSamples
) -> dict[str, Tensor]:
    """Return the reduced losses, with gradients that are computed already, and the diagnostics' means.

    All are to the last bit what the methods of the loss give one after the other on one thread, gradients where the
    losses are weighed by powers of two, as their sum does: others are rounded behind the sums here.
    """
    sequences, steps = samples.noise.shape[:2]
    tasks = _Tasks(useful_threads(sequences, steps, len(loss.critics), loss.threads))
    _ = loss.target_critic_network_params  # TorchRL warns here where nothing updates them
    # The actor's gradient takes longest, and is begun first.
    actor_memory = tasks.add(loss.encode_actor, tensordict)
    memories = [tasks.add(loss.encode_critic, critic, tensordict) for critic in loss.critics]
    policy = tasks.add(loss.policy_action, tensordict, actor_memory, samples)
    judged = [
        tasks.add(_judge, loss, critic, tensordict, memory, policy, samples)
        for critic, memory in zip(loss.frozen_critics, memories, strict=True)
    ]
    actor = tasks.add(_differentiate_actor, loss, policy, *judged)
    following = tasks.add(loss.next_action, tensordict, actor_memory, samples)
    next_values = [tasks.add(_next_value, loss, each, tensordict, following, samples) for each in loss.target_critics]
    values = [
        tasks.add(loss.predict, critic, tensordict, memory, samples)
        for critic, memory in zip(loss.critics, memories, strict=True)
    ]
    target = tasks.add(_target, loss, tensordict, following, *next_values)
    critics = [
        tasks.add(_differentiate_critic, loss, critic, value, target, samples)
        for critic, value in zip(loss.critics, values, strict=True)
    ]
    tasks.wait()

    loss_actor, actor_gradients = actor.result()
    errors, critic_gradients = zip(*(critic.result() for critic in critics), strict=True)
    log_prob = policy.result()[1].detach()
    losses = {
        "loss_actor": loss_actor,
        "loss_qvalue": torch.stack(errors).sum(0),
        "loss_alpha": loss.alpha_objective(log_prob),
    }
    diagnostics = loss.diagnose([value.result() for value in values], target.result())
    reduced = loss.reduce_all(losses, diagnostics | {"alpha": loss.alpha, "entropy": -log_prob})
    alpha_gradients = gradients_of([reduced["loss_alpha"]], [loss.log_alpha])
    gradients = (*actor_gradients, *sum(critic_gradients, ()), *alpha_gradients)
    return reduced | with_gradients({name: reduced[name].detach() for name in losses}, loss.trained, gradients)


class _Tasks:
    """Tasks that threads take in the order in which they were added; each waits for its inputs.

    A task's inputs come from tasks before it, so of those that are under way the first never waits.

    Args:
        threads: their number.
    """

    def __init__(self, threads: int) -> None:
        self._pool = thread_pool(threads, 1)
        self._added: list[Future] = []

    def add(self, function: Callable[..., Any], *inputs: Any) -> Future:
        """Let a thread call a function; inputs that are tasks are replaced by what these return."""

        def work() -> Any:
            return function(*(each.result() if isinstance(each, Future) else each for each in inputs))

        self._added.append(self._pool.submit(work))
        return self._added[-1]

    def wait(self) -> None:
        """Wait for all: where one fails nothing of the others goes on."""
        wait(self._added)


def _judge(
    loss: "DistributionalSACLoss",
    critic: TensorDictSequential,
    tensordict: TensorDictBase,
    memory: Tensor,
    policy: tuple[Tensor, Tensor],
    samples: LossSamples,
) -> tuple[Tensor, Tensor]:
    """Return a critic's value of the policy's action, and the action, from which alone the value's graph begins."""
    action = policy[0].detach().requires_grad_()
    return loss.policy_value(critic, tensordict, memory, action, samples), action


def _differentiate_actor(
    loss: "DistributionalSACLoss", policy: tuple[Tensor, Tensor], *judged: tuple[Tensor, Tensor]
) -> tuple[Tensor, Gradients]:
    """Return the actor loss ``[B, L - burn_in]``, detached, and its gradients.

    Autograd adds up what reaches the action from several critics in the order in which their operations were called,
    and knows none across threads: here it is the order of one thread, from the last critic to the first.
    """
    action, log_prob = policy
    density = log_prob.detach().requires_grad_()
    values = [value.detach().requires_grad_() for value, _ in judged]
    entries = loss.actor_objective(values, density)
    slope, *slopes = torch.autograd.grad(_reduce(entries, loss.reduction), [density, *values])
    through_action = torch.zeros_like(action)
    for (value, leaf), value_slope in reversed(list(zip(judged, slopes, strict=True))):
        (of_one,) = torch.autograd.grad(value, leaf, value_slope)
        through_action = through_action + of_one
    gradients = gradients_of([action, log_prob], loss.trained["loss_actor"], [through_action, slope])
    return entries.detach(), gradients


def _next_value(
    loss: "DistributionalSACLoss",
    critic: TensorDictSequential,
    tensordict: TensorDictBase,
    following: tuple[Tensor, Tensor],
    samples: LossSamples,
) -> Tensor:
    return loss.next_value(critic, tensordict, following[0], samples)


def _target(
    loss: "DistributionalSACLoss", tensordict: TensorDictBase, following: tuple[Tensor, Tensor], *values: Tensor
) -> Tensor:
    return loss.combine_target(tensordict, list(values), following[1])


def _differentiate_critic(
    loss: "DistributionalSACLoss", critic: TensorDictSequential, value: Tensor, target: Tensor, samples: LossSamples
) -> tuple[Tensor, Gradients]:
    """Return a critic's share of the critic loss ``[B, L - burn_in]``, detached, and the gradients of its weights."""
    error = loss.critic_error(value, target, samples)
    return error.detach(), gradients_of([_reduce(error, loss.reduction)], list(critic.parameters()))
