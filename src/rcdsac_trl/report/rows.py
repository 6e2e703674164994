"""The rows of the paper's table, its numbers, and what rows are called: the paper's names where it has them.

The paper's numbers are ``paper.csv``: table "Performance evaluation against baselines" of Choi, Dance, Kim, Hwang and
Park (2021), *Risk-Conditioned Distributional Soft Actor-Critic for Risk-Sensitive Navigation*, under the names of our
rows. Mean and standard deviation over 500 episodes, 50 maps x 10.
"""

from functools import cache
from pathlib import Path

import pandas as pd

# Name and measure of rows that the paper's table lacks.
_BEYOND_THE_PAPER = {
    "rcdsac_pow_wide": ("RC-DSAC (resample)", "wide pow"),
    "rcdsac_cvar_long": ("RC-DSAC (resample)", "long CVaR"),
    "mppi": ("MPPI", ""),
    "dwa": ("DWA", ""),
    "pursuit": ("pure pursuit", ""),
}


def paper_table() -> pd.DataFrame:
    """Return the paper's numbers, one row an agent, setting and sensor."""
    return pd.read_csv(Path(__file__).with_name("paper.csv"))


def condition_label(
    agent: str, sensor: str, beta: float, weight: float, controller: str | None, sensors: int = 1
) -> str:
    """Name a condition in figures and lists; the sensor only where there are several."""
    told = setting_label(beta, weight, controller)
    return f"{row_label(agent)}{told}{', ' + sensor if sensors > 1 else ''}"


def setting_label(beta: float, weight: float, controller: str | None) -> str:
    """Name the setting that an agent is driven at, as it stands behind the agent's name.

    Example:
        >>> nothing = float("nan")
        >>> setting_label(-1.0, nothing, None), setting_label(nothing, nothing, "goal_distance")
        (' β = -1', ' β by goal distance')
    """
    if isinstance(controller, str):
        return f" β by {controller.replace('_', ' ')}"
    return f" β = {beta:g}" if pd.notna(beta) else f" w_coll = {weight:g}" if pd.notna(weight) else ""


def row_label(agent: str) -> str:
    """Name a row as the paper does, with its measure.

    Example:
        >>> row_label("rcdsac_pow"), row_label("mppi"), row_label("mine")
        ('RC-DSAC (resample) pow', 'MPPI', 'mine')
    """
    return " ".join(part for part in called(agent) if part)


def has_dial(agent: str) -> bool:
    """Return whether one policy of a row is driven at all its β; each of DSAC's is of another training.

    Example:
        >>> has_dial("rcdsac_cvar"), has_dial("dsac_cvar")
        (True, False)
    """
    return called(agent)[0] != "DSAC"


def called(agent: str) -> tuple[str, str]:
    """Return the name and risk measure of a row, the paper's where it has it; of an unknown one its own name."""
    return _called().get(agent, (agent, ""))


@cache
def _called() -> dict[str, tuple[str, str]]:
    rows = paper_table()[["agent", "name", "psi"]].drop_duplicates().fillna("").itertuples(index=False)
    return _BEYOND_THE_PAPER | {agent: (name, measure) for agent, name, measure in rows}
