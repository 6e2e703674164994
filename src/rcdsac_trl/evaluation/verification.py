"""A verification: agents that ship are measured again on maps of another seed, as their cards were."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.run_config import read_config
from rcdsac_trl.config.shipped_settings import VerificationSettings
from rcdsac_trl.deploy.policy.measured import MEASURED_NAME
from rcdsac_trl.deploy.policy.registry import find_weights
from rcdsac_trl.deploy.policy.weights import Weights
from rcdsac_trl.errors import FaultError
from rcdsac_trl.evaluation.evaluation import make_evaluation
from rcdsac_trl.evaluation.measured_run import MeasuredRun
from rcdsac_trl.storage import atomic
from rcdsac_trl.system.resources import check_writable

VERIFICATION_NAME = "verification.csv"


@dataclass(frozen=True)
class Claim:
    """An agent whose card is about to be checked.

    Attributes:
        name: of the agent.
        card: what the card was made from, a file.
        evaluation: what measures it again.
    """

    name: str
    card: Path
    evaluation: MeasuredRun


Verdict = tuple[str, str, Sequence[str]]
"""What measuring again says: for people; a table as CSV, a row a number; and which numbers do not hold, in words."""


@dataclass(frozen=True)
class Verification:
    """Agents whose cards are about to be checked.

    Attributes:
        claims: one an agent.
        out: folder that takes :data:`VERIFICATION_NAME`.
    """

    claims: Sequence[Claim]
    out: Path

    def run(self, describe: Callable[[Sequence[tuple[str, Path, Path]]], Verdict]) -> None:
        """Measure every agent, and hold all cards' numbers against that at once.

        Args:
            describe: takes name, card and results of each agent.

        Raises:
            FaultError: if a number of a card does not hold.
        """
        print(f"weights as their SHA-256 says: {', '.join(claim.name for claim in self.claims)}")
        for claim in self.claims:
            claim.evaluation.measure_and_write()
        text, table, refuted = describe([(c.name, c.card, c.evaluation.results.path) for c in self.claims])
        print(text)
        atomic.write(self.out / VERIFICATION_NAME, table.encode())
        print(f"written to {self.out}")
        if refuted:
            raise FaultError(f"{len(refuted)} of the cards' numbers do not hold: {'; '.join(refuted)}")


def make_verification(cfg: DictConfig) -> Verification:
    """Make a verification; refuses before anything is written.

    Raises:
        UserInputError: for an agent that is missing, damaged, or of which nothing was measured that this version can
            measure again.
    """
    settings = read_config(cfg, VerificationSettings)
    out = Path(settings.out)
    check_writable(out)
    return Verification([_claim(name, weights, settings, out) for name, weights in settings.claims().items()], out)


def _claim(name: str, weights: Weights, settings: VerificationSettings, out: Path) -> Claim:
    folder = find_weights(name, takes_runs=False)
    assert weights.measured is not None
    measured = weights.measured
    size = f"seed{settings.seed}-{settings.num_maps}x{settings.num_episodes}"
    chosen = {
        "run": str(folder),
        "out": str(out / f"{name}-{size}"),
        "seed": settings.seed,
        "num_maps": settings.num_maps,
        "num_episodes": settings.num_episodes,
        "num_workers": settings.num_workers,
        **{key: measured.protocol[key] for key in ("split", "map", "task")},
    }
    if (context := weights.config.context) is not None:
        chosen[context] = [getattr(condition, context) for condition in measured.conditions]
    cfg = compose("evaluate", [])
    for key, value in chosen.items():
        OmegaConf.update(cfg, key, value, force_add=True)
    return Claim(name, folder / MEASURED_NAME, make_evaluation(cfg))
