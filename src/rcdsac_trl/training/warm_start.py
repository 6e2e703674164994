"""A training that begins with an agent that is there: what it takes over, and what it begins anew."""

from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from rcdsac_trl.config.checkpoint_name import CheckpointName
from rcdsac_trl.config.named_folder import find_agent
from rcdsac_trl.config.run_config import CHECKPOINTS, REPLAY
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.release.named_agent import NamedAgent, named_agent
from rcdsac_trl.release.run_weights import TEMPERATURE
from rcdsac_trl.storage import replay_files, replay_segments
from rcdsac_trl.storage.checkpoint import load_optimizer
from rcdsac_trl.storage.checkpoint_record import Saved, find
from rcdsac_trl.training.learner import Learner

_RANDOM = "_extra_state"  # where a loss keeps its generator
_CRITICS, _TARGETS = "critic_network_params.", "target_critic_network_params."
# What makes the episodes of one run worth as much to another.
_WORLD = ("algo", "sensor", "robot", "task", "map")


@dataclass(frozen=True)
class EndedRun:
    """A run that goes on as another one, in its own world.

    Attributes:
        folder: of the run.
        saved: its last checkpoint.
    """

    folder: Path
    saved: Saved

    @property
    def replay_episodes(self) -> int:
        """Episodes in the files of its replay."""
        return sum(segment.episodes for segment in self.saved.segments)

    @property
    def maps(self) -> int:
        """Maps it has had; the next one is new."""
        return self.saved.progress.iterations + self.saved.progress.skipped_maps


def ended_run(settings: TrainingSettings) -> EndedRun | None:
    """Return the run that a new one goes on from: that of ``init``, if row, sensor, robot, task and maps are its own.

    Raises:
        UserInputError: if there is no such agent, or the run has no checkpoint that is whole.
    """
    if settings.init is None:
        return None
    found = find_agent(settings.init)
    if not found.is_run:
        return None
    then = found.settings()
    if any(getattr(then, name) != getattr(settings, name) for name in _WORLD):
        return None
    return EndedRun(found.path, find(found.path / CHECKPOINTS, "last")[0])


def inherited_steps(settings: TrainingSettings, ended: EndedRun | None) -> int:
    """Return how many steps the replay of a new run begins with: those of the run that it goes on from."""
    return 0 if ended is None else ended.replay_episodes * settings.task.episode_steps


def go_on(learner: Learner, settings: TrainingSettings, ended: EndedRun) -> str:
    """Give a learner all that a run has learnt and learns from, and say in a sentence what it was not given.

    Networks and temperature as :func:`begin_with_agent`, the optimiser's state, and the newest episodes of the replay,
    as many as the learner's holds.

    Raises:
        UserInputError: if the run's networks are others.
    """
    begin_with_agent(learner, settings, ended.saved.progress.iterations)
    load_optimizer(ended.saved.path, learner.optimizer)
    left = ["random streams", "schedule"]
    if (damage := replay_segments.damage(ended.folder / REPLAY, ended.saved.segments)) is not None:
        left.insert(0, f"replay ({damage})")
    elif ended.saved.segments:
        replay_files.inherit(ended.folder / REPLAY, ended.saved.segments, learner.replay)
    return (
        f"go on from {settings.init} after its {ended.saved.progress.iterations} iterations, with "
        f"{learner.replay.episodes_added} episodes in the replay; not copied: {', '.join(left)}"
    )


def begin_with_agent(learner: Learner, settings: TrainingSettings, checkpoint: CheckpointName = "last") -> str:
    """Give a learner the networks of the agent that ``init`` names, and say in a sentence what it was not given.

    A run's are those of a checkpoint: actor, averaged actor, critics, target critics and temperature. Of an
    exported agent the averaged actor stands for the learning one, and its critics for their targets.

    Args:
        learner: that is given them.
        settings: of the new run.
        checkpoint: of a run; an exported agent has no choice.

    Raises:
        UserInputError: if there is no such agent, or its networks are not those of the run.
    """
    assert settings.init is not None
    is_run = find_agent(settings.init).is_run
    agent = named_agent(settings.init, checkpoint if is_run else None)
    has_temperature = is_run or agent.weights().config.provenance.get(TEMPERATURE) is not None
    loss, average = agent.load()
    if has_temperature and not is_run:
        loss = agent.load_critics()
    state: dict[str, Tensor] = loss.state_dict()
    if not is_run:
        state |= {
            f"{_TARGETS}{name.removeprefix(_CRITICS)}": value
            for name, value in state.items()
            if name.startswith(_CRITICS)
        }
    own = learner.loss.state_dict()
    state[_RANDOM] = own[_RANDOM]  # its random numbers follow from its own seed
    if not has_temperature:
        state["log_alpha"] = own["log_alpha"]
    _check_same_shapes(settings.init, own, state)
    learner.loss.load_state_dict(state)
    learner.average.load_state_dict(average.state_dict())
    return _told(settings, agent, is_run=is_run, has_temperature=has_temperature)


def _check_same_shapes(named: str, own: dict[str, Tensor], given: dict[str, Tensor]) -> None:
    for name in sorted(own.keys() | given.keys()):
        here, there = (state[name].shape if name in state else None for state in (own, given))
        if here != there:
            shapes = " and ".join("none" if shape is None else str(list(shape)) for shape in (there, here))
            raise UserInputError(
                f"init={named} has other networks than this run ({name}: {shapes}): leave out +algo, network, "
                "sensor.memory_s and learner.num_critics, which are then the agent's"
            )


def _told(settings: TrainingSettings, agent: NamedAgent, *, is_run: bool, has_temperature: bool) -> str:
    left = ["optimiser state", "replay", "random streams", "schedule"]
    if not is_run:
        left.insert(0, "learning actor and target critics (the averaged actor and the critics stand for them)")
    if not has_temperature:
        left.insert(0, f"temperature (unknown: learner.alpha_init={settings.learner.alpha_init:g})")
    trained = agent.settings
    pairs = {
        "measure": (trained.algo.distortion.name, settings.algo.distortion.name),
        "sensor": (trained.sensor.name, settings.sensor.name),
        "robot": (trained.robot.name, settings.robot.name),
        "what a collision counts": (f"{trained.algo.fixed_weight:g}", f"{settings.algo.fixed_weight:g}"),
    }
    changed = [f"{what} {was} becomes {now}" for what, (was, now) in pairs.items() if was != now]
    return f"begin with {settings.init}; not copied: {', '.join(left)}" + "".join(f"; {change}" for change in changed)
