"""Draw beta_response.png, beta_response_cvar.png and differences_collisions.png, what `report` says of the agents.

python docs/images/results_figures.py
"""

import shutil
import tempfile
from pathlib import Path

from rcdsac_trl.report.read import read_episodes
from rcdsac_trl.report.write import write_report

HERE = Path(__file__).parent
RESULTS = HERE.parents[1] / "results"
# Folders of one training or baseline each, with its evaluation; those of the study lie deeper or are called otherwise.
RUNS = sorted(RESULTS.glob("*-narrow"))
PICTURES = {
    "beta_response_pow.png": "beta_response.png",
    "beta_response_cvar.png": "beta_response_cvar.png",
    "differences_collisions_narrow.png": "differences_collisions.png",
}


def main() -> None:
    """Write the report, and keep these figures of it."""
    with tempfile.TemporaryDirectory() as folder:
        write_report(read_episodes(RUNS), RUNS, Path(folder))
        for drawn, name in PICTURES.items():
            shutil.copyfile(Path(folder) / drawn, HERE / name)


if __name__ == "__main__":
    main()
