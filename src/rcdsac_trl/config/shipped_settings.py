"""What a list or a verification of shipped agents may choose: the roots of their files in ``conf/``."""

from dataclasses import dataclass
from typing import Literal

from rcdsac_trl.deploy.policy.measured import MEASURED_NAME
from rcdsac_trl.deploy.policy.registry import HANDFUL, find_weights
from rcdsac_trl.deploy.policy.weights import Weights, read_weights
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.checks import check_least
from rcdsac_trl.world.task.rules import RULES_VERSION

# Fewer maps say nothing of how far another choice of them would change a mean.
_FEWEST_MAPS = 5


@dataclass(frozen=True)
class AgentsSettings:
    """The root of ``conf/agents.yaml``."""

    agents: tuple[str, ...]
    format: Literal["table", "json"]


@dataclass(frozen=True)
class VerificationSettings:
    """The root of ``conf/verify.yaml``.

    Raises:
        UserInputError: a value is below its limit, or an agent is named twice.
    """

    agents: tuple[str, ...]
    seed: int
    num_maps: int
    num_episodes: int
    num_workers: int | Literal["auto"]
    out: str

    def __post_init__(self) -> None:
        """Refuse what is below its limit."""
        check_least("seed", self.seed, 0)
        check_least("num_maps", self.num_maps, _FEWEST_MAPS)
        check_least("num_episodes", self.num_episodes, 1)
        for name in self.agents:
            if self.agents.count(name) > 1:
                raise UserInputError(f"{name} is named more than once: name every agent once")

    def claims(self) -> dict[str, Weights]:
        """Read the agents whose cards are checked, by name.

        Raises:
            UserInputError: for one that is missing, damaged, or of which nothing was measured that this version can
                measure again.
        """
        return {name: _with_claims(name) for name in self.agents or HANDFUL}


def _with_claims(name: str) -> Weights:
    folder = find_weights(name, takes_runs=False)
    weights = read_weights(folder)
    if weights.measured is None:
        raise UserInputError(f"{folder} holds no {MEASURED_NAME}, so that its agent claims nothing: leave {name} out")
    if (version := weights.measured.rules_version) != RULES_VERSION:
        raise UserInputError(
            f"{name} was measured under version {version} of the rules, and this version drives under {RULES_VERSION}, "
            "so that its numbers cannot be measured again: leave it out, or evaluate it anew"
        )
    return weights
