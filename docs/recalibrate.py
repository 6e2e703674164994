"""Recalibrate an agent of weights/ whose run is gone: new offsets, how well they hold, and its card.

Both folders were written by ``calibrate as_driven=true`` of that agent: the first on validation maps, on which offsets
are fitted, the second on evaluation maps, on which they are checked. Weights and evaluations stay as they are::

    rcdsac-trl calibrate run=rcdsac_cvar_long-narrow as_driven=true split=validation num_maps=48 out=fit
    rcdsac-trl calibrate run=rcdsac_cvar_long-narrow as_driven=true split=evaluation num_maps=32 out=check
    python docs/recalibrate.py rcdsac_cvar_long-narrow fit check
"""

import argparse
from dataclasses import replace
from pathlib import Path

from rcdsac_trl.deploy.policy.weights import packed
from rcdsac_trl.release.named_agent import named_agent
from rcdsac_trl.release.quantile_offsets import check_checked, with_calibration
from rcdsac_trl.report.card import told_calibration
from rcdsac_trl.storage import atomic

ROOT = Path(__file__).resolve().parents[1]


def recalibrate(folder: Path, fit: Path, check: Path) -> None:
    """Write the agent of a weights folder anew, with what one calibration asks for and another one finds.

    Raises:
        UserInputError: if one is of another agent or of the other's maps; nothing is written then.
    """
    agent = named_agent(folder)
    checkpoint = agent.described["checkpoint"]
    weights = with_calibration(agent.weights(), checkpoint, fit)
    check_checked(check, weights, checkpoint)
    assert weights.config.recalibration is not None
    assert weights.measured is not None
    told = told_calibration(check, weights.config.recalibration.tell)
    measured = replace(weights.measured, told_calibration=tuple(told))
    for name, content in packed(weights, half=True, measured=measured).items():
        atomic.write(folder / name, content)
    print(f"{folder.name}: its quantiles are {weights.config.recalibration}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", help="of the agent, in weights/")
    parser.add_argument("fit", type=Path, help="folder of its calibration on validation maps")
    parser.add_argument("check", type=Path, help="folder of its calibration on evaluation maps")
    given = parser.parse_args()
    recalibrate(ROOT / "weights" / given.name, given.fit, given.check)
