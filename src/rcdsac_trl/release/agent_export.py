"""An export from its config."""

from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from rcdsac_trl.config.release_settings import ExportSettings
from rcdsac_trl.config.run_config import TRAINING_NAME, read_config
from rcdsac_trl.deploy.export.exported import LIMIT, betas_of, check_extra, differences, export_agent
from rcdsac_trl.deploy.policy.weights import Weights, packed
from rcdsac_trl.errors import FaultError
from rcdsac_trl.release.named_agent import RunAgent, named_agent
from rcdsac_trl.release.quantile_offsets import with_calibration, with_offsets
from rcdsac_trl.storage import atomic
from rcdsac_trl.system.progress import Work
from rcdsac_trl.system.resources import check_empty


@dataclass(frozen=True)
class Export:
    """An agent that is about to leave.

    Attributes:
        weights: of the agent.
        out: the folder that is written.
        num_quantiles: of the exported critics.
        training: the config of its training, as a file, by which others can measure it again; None where nobody has it.
    """

    weights: Weights
    out: Path
    num_quantiles: int
    training: bytes | None = None

    def run(self, *, steps: int = 1000) -> dict[str, float]:
        """Write the folder, unless a program differs from torch by more than the limit; return the differences.

        Args:
            steps: recurrent steps over which they are compared, at each ``beta`` of a grid.

        Raises:
            FaultError: if one differs; nothing is written then.
        """
        betas = betas_of(self.weights)
        with Work("two programs as ONNX and by torch.export", 1, "export"):
            exported = export_agent(self.weights, self.num_quantiles)
        doing = f"drives of {steps} steps with each program, compared with torch"
        with Work(doing, len(betas), "drive") as work:
            found = differences(exported, self.weights, betas=betas, steps=steps, work=work)
        for name, difference in found.items():
            print(f"{name:>12}: largest difference from torch {difference:.1e}")
        if not max(found.values()) <= LIMIT:
            raise FaultError(
                f"the export differs from torch by {max(found.values()):.1e}, more than {LIMIT:g}: nothing was "
                "written; use the package versions of constraints.txt"
            )
        self.out.mkdir(parents=True, exist_ok=True)
        # The config comes last: a folder that has one is complete.
        training = {} if self.training is None else {TRAINING_NAME: self.training}
        for name, content in (exported.files | training | packed(self.weights)).items():
            atomic.write(self.out / name, content)
        print(f"wrote {self.out}")
        if (acting := self.weights.config.acting).chooses:
            print(f"its programs act by tanh(mean); the choice among {acting.num_candidates} actions is Policy's alone")
        if (recalibration := self.weights.config.recalibration) is not None:
            print(f"its programs tell raw quantiles; Policy tells them {recalibration}")
        return found


def make_export(cfg: DictConfig) -> Export:
    """Make an export of an agent; refuses before anything is written.

    Raises:
        UserInputError: for a missing agent or package, a calibration of another agent, or a folder that holds
            something.
    """
    settings = read_config(cfg, ExportSettings)
    check_extra()
    assert settings.run is not None
    agent = named_agent(settings.run, settings.checkpoint)
    weights = settings.acting.in_weights(agent.weights())
    if settings.calibration is not None:
        weights = with_calibration(weights, agent.described["checkpoint"], Path(settings.calibration))
    elif isinstance(agent, RunAgent):
        weights = with_offsets(weights, agent.folder, agent.checkpoint)
    out = agent.out / "export" / agent.stem if settings.out is None else Path(settings.out)
    check_empty(out)
    return Export(weights, out, settings.num_quantiles, agent.training)
