"""Environments and workers with everything a policy reads."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from torchrl.envs import EnvBase, InitTracker, StepCounter, TransformedEnv

from rcdsac_trl.agent.actor import recurrent_state_primer
from rcdsac_trl.agent.transforms import EpisodeSampler
from rcdsac_trl.config.algo_settings import AlgoSettings
from rcdsac_trl.config.conditions import Condition
from rcdsac_trl.rollout.worker import RolloutWorker
from rcdsac_trl.world.maps.generator import Split
from rcdsac_trl.world.task.env import NavigationEnv, make_env
from rcdsac_trl.world.task.world_settings import WorldSettings


def environment(
    world: WorldSettings,
    algo: AlgoSettings | None,
    *,
    split: Split,
    seed: int,
    agent_ids: Sequence[int],
    state_size: int,
    conditions: Sequence[Condition] | None = None,
    first_episode: int = 0,
) -> EnvBase:
    """Make an environment with everything a policy reads.

    Args:
        world: what it is made of.
        algo: what the agents are told; None for a baseline, which is told nothing.
        split: training, validation or evaluation maps.
        seed: root seed of maps, starts, goals, movers and of what the agents are told.
        agent_ids: numbers of the agents; equal numbers meet the same starts and goals.
        state_size: size of the policy's recurrent state.
        conditions: tell agent i ``conditions[i]``; None draws what they are told an episode.
        first_episode: number of each agent's first episode.
    """
    base = make_env(
        world,
        split=split,
        seed=seed,
        agent_ids=agent_ids,
        first_episode=first_episode,
        **_weights(algo),
    )
    env = TransformedEnv(base)
    env.append_transform(InitTracker())
    env.append_transform(StepCounter(max_steps=world.task.episode_steps))
    env.append_transform(recurrent_state_primer(state_size))
    sampler = _sampler(algo, seed, agent_ids, conditions, first_episode)
    if sampler is not None:
        env.append_transform(sampler)
    return env


def rollout_worker(
    world: WorldSettings,
    algo: AlgoSettings | None,
    *,
    split: Split,
    seed: int,
    agent_ids: Sequence[int],
    state_size: int,
    conditions: Sequence[Condition] | None = None,
) -> RolloutWorker:
    """Make agents of this process that drive whole episodes; arguments as for :func:`environment`."""
    env = NavigationEnv(
        world,
        split=split,
        seed=seed,
        agent_ids=agent_ids,
        **_weights(algo),
    )
    sampler = _sampler(algo, seed, agent_ids, conditions, 0)
    return RolloutWorker(env, sampler, state_size=state_size, steps=world.task.episode_steps)


def _weights(algo: AlgoSettings | None) -> dict[str, Any]:
    """Return what collisions count in the rewards of the environment."""
    if algo is None:
        return {}
    return {"weighted_collisions": algo.told_weights is not None, "collision_weight": algo.fixed_weight}


def _sampler(
    algo: AlgoSettings | None,
    seed: int,
    agent_ids: Sequence[int],
    conditions: Sequence[Condition] | None,
    first_episode: int,
) -> EpisodeSampler | None:
    """Make what tells the agents their beta or collision weight; None where they are told nothing."""
    if algo is None or algo.context_key is None:
        return None
    asked = conditions or ()
    draw: Callable[[float], float]
    if algo.told_weights is not None:
        draw = partial(_between, *algo.told_weights)
        fixed = [c.collision_weight for c in asked if c.collision_weight is not None]
    else:
        measure = algo.distortion.measure
        draw = measure.from_uniform
        # A controller tells its agents at every step; they must be told something before.
        fixed = [measure.low if c.beta is None else c.beta for c in asked if c.beta is not None or c.controller]
    return EpisodeSampler(
        algo.context_key,
        draw,
        seed=seed,
        agent_ids=agent_ids,
        first_episode=first_episode,
        fixed=None if conditions is None else fixed,
    )


def _between(low: float, high: float, share: float) -> float:
    return low + (high - low) * share


def evaluation_worker(
    world: WorldSettings,
    algo: AlgoSettings | None,
    conditions: Sequence[Condition],
    split: Split,
    seed: int,
    num_agents: int,
    state_size: int,
) -> RolloutWorker:
    """Make a worker in which a block of agents drives under each condition, side by side on the same map."""
    return rollout_worker(
        world,
        algo,
        split=split,
        seed=seed,
        agent_ids=list(range(num_agents)) * len(conditions),
        state_size=state_size,
        conditions=[condition for condition in conditions for _ in range(num_agents)],
    )
