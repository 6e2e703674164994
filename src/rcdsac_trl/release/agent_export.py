"""An export from its config."""

from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from rcdsac_trl.config.evaluation_settings import ExportSettings
from rcdsac_trl.config.run_config import read_config
from rcdsac_trl.deploy.export.exported import LIMIT, check_extra, differences, export_agent
from rcdsac_trl.deploy.policy.weights import Weights, packed
from rcdsac_trl.errors import FaultError, UserInputError
from rcdsac_trl.release.run_weights import weights_of_run
from rcdsac_trl.storage import atomic
from rcdsac_trl.system.resources import check_writable


@dataclass(frozen=True)
class Export:
    """An agent that is about to leave.

    Attributes:
        weights: of the agent.
        out: the folder that is written.
        num_quantiles: of the exported critics.
    """

    weights: Weights
    out: Path
    num_quantiles: int

    def run(self, *, steps: int = 1000) -> dict[str, float]:
        """Write the folder, unless a program differs from torch by more than the limit; return the differences.

        Args:
            steps: recurrent steps over which they are compared, at each ``beta`` of a grid.

        Raises:
            FaultError: if one differs; nothing is written then.
        """
        exported = export_agent(self.weights, self.num_quantiles)
        found = differences(exported, self.weights, steps=steps)
        for name, difference in found.items():
            print(f"{name:>12}: largest difference from torch {difference:.1e}")
        if not max(found.values()) <= LIMIT:
            raise FaultError(
                f"the export differs from torch by {max(found.values()):.1e}, more than {LIMIT:g}: nothing was "
                "written; use the package versions of constraints.txt"
            )
        self.out.mkdir(parents=True, exist_ok=True)
        # The config comes last: a folder that has one is complete.
        for name, content in (exported.files | packed(self.weights)).items():
            atomic.write(self.out / name, content)
        print(f"wrote {self.out}")
        return found


def make_export(cfg: DictConfig) -> Export:
    """Make an export of a run; refuses before anything is written.

    Raises:
        UserInputError: for a missing run or package, or a folder that holds something.
    """
    settings = read_config(cfg, ExportSettings)
    check_extra()
    assert settings.run is not None
    weights = weights_of_run(Path(settings.run), settings.checkpoint)
    default_out = Path(settings.run) / "export" / str(settings.checkpoint)
    out = default_out if settings.out is None else Path(settings.out)
    check_writable(out)
    if out.is_dir() and any(out.iterdir()):
        raise UserInputError(f"out={out} is not empty: choose another folder, or remove what is there")
    return Export(weights, out, settings.num_quantiles)
