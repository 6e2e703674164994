"""A training that begins with an agent that is there: what it takes over, and what it begins anew."""

from torch import Tensor

from rcdsac_trl.config.named_folder import find_agent
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.release.named_agent import NamedAgent, named_agent
from rcdsac_trl.release.run_weights import TEMPERATURE
from rcdsac_trl.training.learner import Learner

_CRITICS, _TARGETS = "critic_network_params.", "target_critic_network_params."


def begin_with_agent(learner: Learner, settings: TrainingSettings) -> str:
    """Give a learner the networks of the agent that ``init`` names, and say in a sentence what it was not given.

    A run's are those of its last checkpoint: actor, averaged actor, critics, target critics and temperature. Of an
    exported agent the averaged actor stands for the learning one, and its critics for their targets.

    Raises:
        UserInputError: if there is no such agent, or its networks are not those of the run.
    """
    assert settings.init is not None
    is_run = find_agent(settings.init).is_run
    agent = named_agent(settings.init, "last" if is_run else None)
    has_temperature = is_run or agent.weights().config.provenance.get(TEMPERATURE) is not None
    loss, average = agent.load()
    state: dict[str, Tensor] = (agent.load_critics() if has_temperature else loss).state_dict()
    if not is_run:
        state |= {
            f"{_TARGETS}{name.removeprefix(_CRITICS)}": value
            for name, value in state.items()
            if name.startswith(_CRITICS)
        }
    own = learner.loss.state_dict()
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
    }
    changed = [f"{what} {was} becomes {now}" for what, (was, now) in pairs.items() if was != now]
    return f"begin with {settings.init}; not copied: {', '.join(left)}" + "".join(f"; {change}" for change in changed)
