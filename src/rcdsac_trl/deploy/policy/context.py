"""What an agent is told besides what it sees: a beta or a collision weight, of the range that it was trained with."""

from rcdsac_trl.deploy.policy.agent_config import AgentConfig
from rcdsac_trl.deploy.policy.input_checks import BadInputError
from rcdsac_trl.robot.sectors import is_finite_number


def middle_of_range(config: AgentConfig) -> float | None:
    """Return the middle of the trained range; None for an agent that is told nothing."""
    return None if config.context_range is None else (config.context_range[0] + config.context_range[1]) / 2.0


def context_of(config: AgentConfig, beta: float | None, collision_weight: float | None) -> float | None:
    """Return what an agent is told, the middle of the trained range where that is not given; None: nothing.

    Raises:
        BadInputError: if what is given is no number, means nothing to this agent or is outside the trained range.
    """
    given = {"beta": beta, "collision_weight": collision_weight}
    for name, value in given.items():
        if value is not None and not is_finite_number(value):
            raise BadInputError(f"{name} is no finite number ({type(value).__name__}): give one, as a float")
        if value is None or name == config.context or (name == "beta" and value == config.fixed_beta):
            continue
        raise BadInputError(f"{name}={value:g} means nothing to this agent ({config.name}): leave it out")
    if config.context is None or config.context_range is None:
        return None
    value = given[config.context]
    if value is None:
        value = middle_of_range(config)
    assert value is not None
    low, high = config.context_range
    if not low <= value <= high:
        raise BadInputError(f"{config.context}={value:g} is outside [{low:g}, {high:g}], where this agent was trained")
    return float(value)


def bolder(config: AgentConfig, context: float | None, boldness: float) -> float | None:
    """Return a beta that is turned towards the boldest of training; a collision weight stays.

    Args:
        config: of the agent.
        context: that it is told.
        boldness: how far to turn, from 0, not at all, to 1.
    """
    if context is None or config.context != "beta" or config.context_range is None:
        return context
    return context + boldness * (config.context_range[1] - context)
