r"""Roll-outs that branch off from one state and action, and what the critics predict of them there.

The simulation is deterministic, so a state is met again by doing the same again: some agents with the same number,
hence the same start, goals and movers, drive as one up to a step and its action, and each by its own noise from there
on. What they earn is a sample of the return whose distribution the critics predicted at that step.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.envs import EnvBase

from rcdsac_trl.agent.actor import STATE_KEY
from rcdsac_trl.agent.kernels import dispatch
from rcdsac_trl.agent.loss.distributional_sac import OVER_CRITICS, DistributionalSACLoss
from rcdsac_trl.agent.loss.functional import call_module, squash
from rcdsac_trl.rollout.evaluation_pool import Rows
from rcdsac_trl.system.interrupts import interruption_point

NUM_READ_QUANTILES = 100
"""Quantiles that are read of every prediction."""


def fractions() -> Tensor:
    """Return the fractions ``[100]`` at which predictions are read: the middles of 100 equal parts of [0, 1]."""
    return (torch.arange(NUM_READ_QUANTILES, dtype=torch.float32) + 0.5) / NUM_READ_QUANTILES


@dataclass(frozen=True)
class Branches:
    """What came of the groups of roll-outs.

    Attributes:
        soft_return: ``[G, M]``, with the entropy bonus of every step but the first, as critics learn it.
        discounted_reward: ``[G, M]``, without it.
        history: observations and actions of each group up to the branch, by key ``[G, T, ..]``.
    """

    soft_return: Tensor
    discounted_reward: Tensor
    history: dict[str, Tensor]


def roll_out(
    env: EnvBase,
    actor: TensorDictSequential,
    *,
    branch_steps: Sequence[int],
    num_rollouts: int,
    num_blocks: int,
    horizon_steps: int,
    gamma: float,
    alpha: float,
    generator: torch.Generator,
    episode: int,
    leaders: Sequence[int] | None = None,
    shared_action: bool = True,
    before_step: Callable[[], None] = interruption_point,
) -> Branches:
    r"""Drive groups of agents that part from each other at a step of their own.

    The soft return from step k is :math:`r_k + \sum_{t=1}^{h-1} \gamma^t (r_{k+t} - \alpha \log\pi(a_{k+t}))`: what is
    beyond the horizon h is missing, a share of about :math:`\gamma^h` of it.

    Args:
        env: G * M agents, those of a group one after the other and with the same number.
        actor: encoder and head; its actions are drawn.
        branch_steps: G numbers k: the group does the same before action k, and nothing together after it.
        num_rollouts: M, agents in a group.
        num_blocks: equal blocks of the groups, whose agents draw the same noise: one a beta, so that no beta's depends
            on which others there are.
        horizon_steps: h.
        gamma: discount.
        alpha: temperature.
        generator: source of the actions' noise.
        episode: number of the episode and its map.
        leaders: for each group the agent whose actions it takes, of a group with the same numbers and the same k;
            None: the first of its own.
        shared_action: whether action k, too, is the leader's, as for what is predicted of a state and an action; else
            each draws its own.
        before_step: called before each step.
    """
    encoder, head = actor[0], actor[1]
    parting = torch.tensor(branch_steps).repeat_interleave(num_rollouts)
    if leaders is None:
        leaders = range(0, len(parting), num_rollouts)
    leader = torch.tensor(leaders).repeat_interleave(num_rollouts)
    num_led = parting + int(shared_action)
    keys = [*encoder.in_keys, "action"]
    history: dict[str, list[Tensor]] = {key: [] for key in keys}
    soft, plain = torch.zeros(len(parting), dtype=torch.float64), torch.zeros(len(parting), dtype=torch.float64)
    tensordict = env.reset(episode=episode)
    for step in range(max(branch_steps) + horizon_steps):
        before_step()
        seen = [tensordict[key] for key in (*encoder.in_keys, "is_init", STATE_KEY)]
        memory, state = dispatch.step(encoder.module, *seen)
        loc, scale = head.module(memory, *[tensordict[key] for key in head.in_keys[1:]])
        noise = torch.empty_like(loc[: len(loc) // num_blocks]).normal_(generator=generator).repeat(num_blocks, 1)
        action, log_prob = squash(loc, scale, noise)
        # Of equal rows a matrix product need not make equal bits.
        action = torch.where((step < num_led).unsqueeze(-1), action[leader], action)
        tensordict = tensordict.set("action", action).set(("next", STATE_KEY), state)
        if step <= max(branch_steps):
            for key in keys:
                history[key].append(tensordict[key][::num_rollouts].clone())
        tensordict = env.step(tensordict)
        since = step - parting
        discount = torch.where((since >= 0) & (since < horizon_steps), gamma ** since.double(), 0.0)
        reward = tensordict["next", "reward"].squeeze(-1).double()
        plain += discount * reward
        soft += discount * (reward - alpha * log_prob.double() * (since > 0))
        tensordict = env.step_mdp(tensordict)
    return Branches(
        soft_return=soft.view(-1, num_rollouts),
        discounted_reward=plain.view(-1, num_rollouts),
        history={key: torch.stack(values, 1) for key, values in history.items()},
    )


def predict(
    loss: DistributionalSACLoss,
    history: dict[str, Tensor],
    *,
    branch_steps: Sequence[int],
    risk: Tensor | None,
    memory_steps: int,
) -> Tensor:
    """Return the quantiles of each critic at the step of each group, ``[critics, G, 100]``.

    Args:
        loss: holds the critics.
        history: of :class:`Branches`.
        branch_steps: step of each group.
        risk: beta of each group, ``[G]``; None for critics that read none.
        memory_steps: observations that the critics look back on, from a zero state; training's sequence length is what
            they have learnt to read.
    """
    predicted = []
    for critic in loss.critics:
        rows = []
        for group, step in enumerate(branch_steps):
            seen = slice(max(0, step + 1 - memory_steps), step + 1)
            window = {key: value[group : group + 1, seen] for key, value in history.items()}
            (memory,) = call_module(critic[0], {key: window[key] for key in critic[0].in_keys})
            entries = {
                critic[0].out_keys[0]: memory[:, -1:],
                "action": window["action"][:, -1:],
                "tau": fractions().view(1, 1, -1),
                "risk": None if risk is None else risk[group].view(1, 1, 1),
            }
            rows.append(call_module(critic[1], entries)[0].flatten())
        predicted.append(torch.stack(rows))
    return torch.stack(predicted)


def measure_states(
    env: EnvBase,
    loss: DistributionalSACLoss,
    *,
    betas: Sequence[float | None],
    conditioned: bool,
    branch_steps: Sequence[int],
    num_rollouts: int,
    horizon_steps: int,
    memory_steps: int,
    gamma: float,
    generator: torch.Generator,
    map_index: int,
    before_step: Callable[[], None] = interruption_point,
) -> Rows:
    """Predict and roll out some states of one map, under each beta.

    Args:
        env: agents beta after beta, state after state, roll-out after roll-out.
        loss: the networks and the temperature.
        betas: one a block of states; None where there is none.
        conditioned: whether the networks read beta.
        branch_steps: step of each state of a block; the same for all betas.
        num_rollouts: agents a state.
        horizon_steps: see :func:`roll_out`.
        memory_steps: see :func:`predict`.
        gamma: discount.
        generator: source of the actions' noise.
        map_index: the map's number.
        before_step: called before each step.

    Returns:
        One row a state: `beta`, `map`, `state`, `step`; `quantiles`, a list of 100, of the critics taken together as
        the targets of training take them; `critic_means`, one a critic; `whole_history_mean`, the mean prediction of
        critics that look back to the episode's start; and the lists `soft_returns` and `discounted_rewards`.
    """
    steps = list(branch_steps) * len(betas)
    risk = torch.tensor([beta for beta in betas for _ in branch_steps], dtype=torch.float32) if conditioned else None
    with torch.no_grad():
        branches = roll_out(
            env,
            loss.actor_network,
            branch_steps=steps,
            num_rollouts=num_rollouts,
            num_blocks=len(betas),
            horizon_steps=horizon_steps,
            gamma=gamma,
            alpha=loss.alpha.item(),
            generator=generator,
            episode=map_index,
            before_step=before_step,
        )
        critics = predict(loss, branches.history, branch_steps=steps, risk=risk, memory_steps=memory_steps)
        whole = predict(loss, branches.history, branch_steps=steps, risk=risk, memory_steps=max(steps) + 1)
        over = OVER_CRITICS[loss.settings.target_over_critics]
        taken, taken_whole = over(list(critics)), over(list(whole))
    return [
        {
            "beta": betas[group // len(branch_steps)],
            "map": map_index,
            "state": group % len(branch_steps),
            "step": step,
            "quantiles": taken[group].tolist(),
            "critic_means": critics[:, group].mean(-1).tolist(),
            "whole_history_mean": taken_whole[group].mean().item(),
            "soft_returns": branches.soft_return[group].tolist(),
            "discounted_rewards": branches.discounted_reward[group].tolist(),
        }
        for group, step in enumerate(steps)
    ]
