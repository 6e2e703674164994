r"""Does beta do what it says? The policy of every beta drives on from the same states, every beta's measure judges it.

A policy conditioned on beta promises to be the best one by the risk measure of that beta. From one state, agents drive
on at each :math:`\beta'`; each beta's measure of the discounted reward that they earn should be largest where
:math:`\beta' = \beta`. Only :math:`\beta'` tells the roll-outs of a state apart: up to it they have one history, hence
one recurrent memory (the actor's encoder does not read beta), and after it every :math:`\beta'` draws the same noise.
"""

from collections.abc import Callable, Sequence

import pandas as pd
import torch
from tensordict.nn import TensorDictSequential
from torchrl.envs import EnvBase

from rcdsac_trl.agent.risk import RiskMeasure
from rcdsac_trl.evaluation.branches import roll_out
from rcdsac_trl.rollout.evaluation_pool import Rows
from rcdsac_trl.system.interrupts import interruption_point


def cross_evaluate(
    env: EnvBase,
    actor: TensorDictSequential,
    *,
    betas: Sequence[float | None],
    branch_steps: Sequence[int],
    num_rollouts: int,
    horizon_steps: int,
    gamma: float,
    generator: torch.Generator,
    map_index: int,
    before_step: Callable[[], None] = interruption_point,
) -> Rows:
    """Roll out the policy of each beta from the same states of one map.

    The betas take turns at driving up to a state, so that the states are those of no beta alone. Actions are drawn, as
    the actor was trained: with its mean actions the world, which is deterministic, would give one return a state. What
    is judged is the reward without the entropy bonus, which pays for what an agent tries and not for what it does.

    Args:
        env: agents beta after beta, state after state, roll-out after roll-out.
        actor: encoder and head.
        betas: one a block of states.
        branch_steps: step of each state of a block, the first at which a beta of its own drives.
        num_rollouts: agents a state and a beta.
        horizon_steps: steps that count.
        gamma: discount.
        generator: source of the actions' noise.
        map_index: the map's number.
        before_step: called before each step.

    Returns:
        One row a beta and a state: `beta`, which drives; `map`, `state`, `step`; `history_beta`, which drove up to the
        state; and the list `discounted_rewards`.
    """
    num_states = len(branch_steps)
    turns = [(map_index + state) % len(betas) for state in range(num_states)]
    leaders = [(turn * num_states + state) * num_rollouts for state, turn in enumerate(turns)]
    with torch.no_grad():
        branches = roll_out(
            env,
            actor,
            branch_steps=list(branch_steps) * len(betas),
            num_rollouts=num_rollouts,
            num_blocks=len(betas),
            horizon_steps=horizon_steps,
            gamma=gamma,
            alpha=0.0,  # of the soft return alone, which is not judged
            generator=generator,
            episode=map_index,
            leaders=leaders * len(betas),
            shared_action=False,
            before_step=before_step,
        )
    return [
        {
            "beta": betas[group // num_states],
            "map": map_index,
            "state": group % num_states,
            "step": branch_steps[group % num_states],
            "history_beta": betas[turns[group % num_states]],
            "discounted_rewards": rewards,
        }
        for group, rewards in enumerate(branches.discounted_reward.tolist())
    ]


def cross_tables(rows: Rows, measure: RiskMeasure) -> dict[str, str]:
    """Make ``cross_returns.csv``, one row a roll-out, and ``cross_distortion.csv``, how each beta weighs them.

    The latter holds :math:`g(u) = \\psi^{-1}(u)` at u = 0, 1/N, .., 1, where N is the number of all roll-outs of a
    beta: with it a reader can judge all of them, or those of one state, and needs no risk measure.

    Args:
        rows: of all maps, from :func:`cross_evaluate`.
        measure: family of the measures that judge.
    """
    keys = ("beta", "map", "state", "step", "history_beta")
    returns = pd.DataFrame(
        {key: row[key] for key in keys} | {"rollout": number, "discounted_reward": reward}
        for row in rows
        for number, reward in enumerate(row["discounted_rewards"])
    )
    betas = sorted(returns["beta"].unique())
    number = len(returns) // len(betas)
    u = torch.arange(number + 1, dtype=torch.float64) / number
    g = [measure.inverse_psi(u, torch.tensor(beta, dtype=torch.float64)) for beta in betas]
    distortion = pd.concat(
        pd.DataFrame({"beta": beta, "u": u.numpy(), "g": of.numpy()}) for beta, of in zip(betas, g, strict=True)
    )
    return {
        "cross_returns.csv": returns.to_csv(index=False, float_format="%.9g"),
        "cross_distortion.csv": distortion.to_csv(index=False, float_format="%.9g"),
    }
