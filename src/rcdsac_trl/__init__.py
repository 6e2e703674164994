"""Risk-conditioned distributional soft actor-critic for risk-sensitive navigation, on TorchRL.

Maps become a world (:mod:`rcdsac_trl.world`), the world a TorchRL environment; rollouts
(:mod:`rcdsac_trl.rollout`) fill a replay (:mod:`rcdsac_trl.storage`), a loss (:mod:`rcdsac_trl.agent`) trains a
risk-conditioned agent (:mod:`rcdsac_trl.training`), an evaluation (:mod:`rcdsac_trl.evaluation`) measures it on
unseen maps, and a policy object (:mod:`rcdsac_trl.deploy`) carries it onto a robot. World and agent do not know
each other: they meet in these keys, each with the shape of one agent's entry.

| key | shape, type | unit, values | written by | read by |
|---|---|---|---|---|
| `range` | 180 f32 | 2.5 + log10 m: 0, or 0.5 to 2.98 | env | encoders, planners |
| `waypoint` | 6 f32 | log10 m, cos, sin; of the next two | env | encoders, pursuit, planners |
| `velocity` | 4 f32 | m/s, rad/s measured; m/s, rad/s desired | env | encoders, planners, metrics |
| `remembered` | 90 f32 | what it saw before; with `sensor.memory_s` | env | encoders |
| `action` | 2 f32 | -1 to 1 | actor | env, critics |
| `risk` | 1 f32 | raw beta | EpisodeSampler, Relabel | actor, critics, psi |
| `collision_weight` | 1 f32 | w_coll, RCWR only | EpisodeSampler | encoders, env, replay |
| `reward` | 1 f32 | below "next" only | env, replay | loss |
| `reward_components` | 5 f32 | base, goal, waypoint, angular, collision | env | metrics, replay |
| `contact`, `goal_reached` | 1 bool | in the step before | env | metrics |
| `pose` | 3 f32 | m, m, rad; map frame | env | drawing only |
| `terminated` | 1 bool | never true | env, replay | loss |
| `truncated`, `done` | 1 bool | true after the last step | StepCounter | collector |
| `step_count` | 1 i64 | agent steps | StepCounter | StepCounter |
| `is_init` | 1 bool | true at the first step | InitTracker | actor |
| `recurrent_state` | 128 f32 | zero at reset, not in the replay; 257 with `network.restart_steps` | actor | actor |
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rcdsac_trl.config.gymnasium_id import register_with_gymnasium
from rcdsac_trl.errors import UserInputError

if TYPE_CHECKING:
    from rcdsac_trl.deploy import Policy
    from rcdsac_trl.world.task.world_settings import WorldSettings

__version__ = "0.1.0"


def load(name_or_folder: str | Path, **options: Any) -> "Policy":
    """Return a trained agent that drives a robot.

    Args:
        name_or_folder: an agent of those that ``python -m rcdsac_trl.agents`` lists (they come with the package, or lie
            in the folder that the environment variable ``RCDSAC_TRL_WEIGHTS`` names), a folder that ``python -m
            rcdsac_trl.export`` wrote, or a run folder, whose best checkpoint it is then; every command takes the same
            three. Only the last needs TorchRL, and takes seconds to import.
        options: keywords of :class:`rcdsac_trl.deploy.Policy`.

    Raises:
        rcdsac_trl.errors.UserInputError: if there is no such agent, it cannot be read, or a package is missing for it.
    """
    if not isinstance(name_or_folder, str | Path):
        raise UserInputError(
            f"an agent is no {type(name_or_folder).__name__}: give its name, such as 'rcdsac_pow-narrow', or a folder"
        )
    try:
        return _loaded(name_or_folder, options)
    except ModuleNotFoundError as error:  # of a robot that has the package without all that it trains with
        raise UserInputError(
            f"{error.name} is not installed: shipped and exported agents need `pip install numpy safetensors numba`, a "
            "run folder all that rcdsac-trl depends on"
        ) from error


def _loaded(name_or_folder: str | Path, options: dict[str, Any]) -> "Policy":
    # Imported late, so that importing the package stays instant.
    from rcdsac_trl.deploy import Policy, find_weights, read_weights

    if (Path(name_or_folder) / "checkpoints").is_dir():
        from rcdsac_trl.release.named_agent import named_agent

        return Policy(named_agent(name_or_folder).weights(), **options)
    return Policy(read_weights(find_weights(name_or_folder)), **options)


def world_settings(**options: Any) -> "WorldSettings":
    """Return what an environment is made of, by the names of ``conf/``.

    Args:
        options: `map` (a name of ``conf/map``, or a file that maps are read from),
            `robot` (a name of ``conf/robot``) and fields of
            :class:`~rcdsac_trl.world.task.world_settings.WorldSettings`.

    Raises:
        rcdsac_trl.errors.UserInputError: for a name that does not exist, and values that do not fit together.

    Example:
        >>> world_settings(map="easy", sensor="sparse", num_agents=2).map_settings.num_movers
        0
    """
    from rcdsac_trl.config.named_world import named_world

    return named_world(**options)


register_with_gymnasium()
