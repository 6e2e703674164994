"""Draw ways.png: one episode in which beta matters, driven at every beta of an agent.

    python docs/images/ways.py [agent, such as rcdsac_cvar-narrow]

Which episode it is, nobody chooses: the first one, validation map by validation map, in which the most averse beta
collides less often than the most neutral one. What it prints belongs below the picture: how many episodes were looked
at, and in how many it was the other way round.
"""

import sys
from pathlib import Path

import pandas as pd
from PIL import Image

from rcdsac_trl.evaluation.film.episode_film import Track
from rcdsac_trl.evaluation.film.filming import recorded
from rcdsac_trl.evaluation.film.trajectories import trajectories
from rcdsac_trl.release.named_agent import named_agent
from rcdsac_trl.rollout.make_agent import packed, packed_loss
from rcdsac_trl.rollout.map_evaluator import Agent, EvaluationSpec, map_evaluator
from rcdsac_trl.rollout.measurement import table_of

AGENT = "rcdsac_cvar-narrow"
EPISODES_A_MAP, MOST_MAPS = 5, 50


def spec_of(name: str) -> tuple[EvaluationSpec, Agent]:
    """Return an agent, and how it is driven: as it was trained, at every beta that it is evaluated at."""
    named = named_agent(name)
    trained = named.settings
    conditions = trained.algo.conditions(None, None)
    if len({condition.beta for condition in conditions}) < 2:
        raise SystemExit(f"{name} is not driven at two betas: name an agent that is risk-conditioned")
    spec = EvaluationSpec(
        trained=trained,
        world=trained.world_for(EPISODES_A_MAP * len(conditions)),
        conditions=conditions,
        split="validation",
        seed=0,
        num_episodes=EPISODES_A_MAP,
        sampled=False,
        device="cpu",
        threads=1,
    )
    loss, average = named.load()
    return spec, Agent(packed(average.module), packed_loss(loss))


def compared(collisions: pd.DataFrame) -> tuple[int | None, int, int]:
    """Compare the ends of beta on a map.

    Args:
        collisions: a row an episode, a column a beta in rising order.

    Returns:
        The first episode in which the averse end collides less often, None for none; in how many it does; and in how
        many more often.
    """
    averse, neutral = collisions.iloc[:, 0], collisions.iloc[:, -1]
    fewer = averse < neutral
    return (int(fewer.idxmax()) if fewer.any() else None), int(fewer.sum()), int((averse > neutral).sum())


def chosen(spec: EvaluationSpec, agent: Agent) -> tuple[int, int, str]:
    """Return map and episode of the first one in which beta matters, and what was seen of all until then."""
    fewer = more = looked_at = 0
    with map_evaluator(spec, agent.actor, agent.loss) as drive:
        for map_index in range(MOST_MAPS):
            episodes = table_of([drive(map_index, lambda: None)])
            collisions = episodes.pivot(index="episode", columns="beta", values="collisions")
            episode, *counts = compared(collisions)
            fewer, more, looked_at = fewer + counts[0], more + counts[1], looked_at + len(collisions)
            if episode is not None:
                seen = (
                    f"Validation map {map_index}, episode {episode}: the first in which β = {collisions.columns[0]:g} "
                    f"collides less often than β = {collisions.columns[-1]:g}. Of the {looked_at} episodes driven to "
                    f"find it, it does so in {fewer}, and more often in {more}."
                )
                return map_index, episode, seen
    raise SystemExit(f"on {MOST_MAPS} maps no episode has fewer collisions at the averse end: name another agent")


def main() -> None:
    """Choose, drive once more, and draw."""
    name = sys.argv[1] if len(sys.argv) > 1 else AGENT
    spec, agent = spec_of(name)
    map_index, episode, seen = chosen(spec, agent)
    tracks = recorded(spec, agent, map_index, episode)
    named = [Track(c.heading, track) for c, track in zip(spec.conditions, tracks, strict=True)]
    Image.fromarray(trajectories(named, name)).save(Path(__file__).with_suffix(".png"), optimize=True)
    print(f"{seen} Agent: `{name}`.")


if __name__ == "__main__":
    main()
