"""The claims of the paper's second table, of the office course, one by one.

Section "Real-World Experiments" of Choi, Dance, Kim, Hwang and Park (2021). Each of its numbers is of one run; here the
unit is a run of the course, forward or in reverse, with its people and its errors of odometry, which all agents met.
"""

import math

import numpy as np
import pandas as pd

from rcdsac_trl.report.course_table import paper_course
from rcdsac_trl.report.statistics import Array
from rcdsac_trl.report.verdicts import Cell, Claim, Expectation, Finding, Group, Measured, find, than

COURSE = "office course"
"""Stands for the sensor in tables of claims."""
_NAMES = {"collisions": "collisions a run", "time_s": "required time, s"}
_AVERSE = (("rcdsac_cvar", 0.25), ("rcdsac_pow", -2.0))
_BOLD = (("rcdsac_cvar", 0.75), ("rcdsac_pow", -1.0))


def course_claims() -> list[Claim]:
    """Return the claims of the paper's text about its second table."""
    paper = paper_course().drop_duplicates(["agent", "beta"])
    rows = {name: [_row(*of) for of in part[["agent", "beta"]].to_numpy()] for name, part in paper.groupby("name")}
    distributional = [*rows["RC-DSAC"], *rows["DSAC"]]
    (sac,) = rows["SAC"]
    slowest = Group("DSAC CVaR β = 0.25", (_row("dsac_cvar", 0.25),))
    others = [_alone(cell) for cell in (*distributional, sac) if cell not in slowest.cells]
    averse, bold = (
        Group(f"RC-DSAC {name}", tuple(_row(agent, beta) for agent, beta in cells))
        for name, cells in (("averse", _AVERSE), ("bold", _BOLD))
    )
    ours, theirs = (Group(name, tuple(rows[name])) for name in ("RC-DSAC", "DSAC"))
    return [
        Claim(
            "SAC collides more than RC-DSAC and DSAC, row by row",
            COURSE,
            tuple(than(_alone(cell), "less", _alone(sac)) for cell in distributional),
        ),
        Claim("Averse RC-DSAC collides less than bold RC-DSAC", COURSE, (than(averse, "less", bold),)),
        Claim(
            "DSAC with CVaR's β = 0.25 takes longest",
            COURSE,
            tuple(than(slowest, "more", other, "time_s") for other in others),
        ),
        Claim("RC-DSAC takes about as long as DSAC", COURSE, (than(ours, "comparable", theirs, "time_s"),)),
        Claim(
            "DSAC never collides",
            COURSE,
            (Expectation((theirs,), (1.0,), "collisions", "comparable", "Above none by"),),
        ),
    ]


def judged_course_claims(runs: pd.DataFrame) -> list[Finding]:
    """Judge the claims by runs over the course.

    Args:
        runs: from :func:`rcdsac_trl.report.read_course.read_courses`.
    """
    measured = _measured(runs)
    return [find(claim, measured) for claim in course_claims()]


def _measured(runs: pd.DataFrame) -> Measured:
    paper = paper_course()

    def values(cell: Cell, metric: str) -> Array | None:
        of = runs[(runs["agent"] == cell.agent) & _is(runs["beta"], cell.beta)]
        if of.empty:
            return None
        # Several agents of one row are its training seeds.
        ordered = of.sort_values(["run", "direction", "repetition"])
        shown = ordered[metric].astype(float)
        if metric == "time_s":  # who did not arrive has no required time
            shown = shown.where(ordered["finished"].astype(bool))
        return np.asarray(shown, dtype=np.float64).reshape(of["run"].nunique(), -1, 1)

    def printed(cell: Cell, metric: str) -> float:
        found = paper[(paper["agent"] == cell.agent) & _is(paper["beta"], cell.beta)]
        return float(found[metric].mean()) if len(found) else math.nan

    return Measured(values, printed, unit="runs", names=_NAMES)


def _is(values: "pd.Series[float]", beta: float | None) -> "pd.Series[bool]":
    return values.isna() if beta is None else values == beta


def _row(agent: str, beta: float) -> Cell:
    return Cell(agent, None if np.isnan(beta) else float(beta), None, COURSE)


def _alone(cell: Cell) -> Group:
    names = paper_course().drop_duplicates("agent").set_index("agent")[["name", "psi"]].fillna("")
    name, psi = map(str, names.loc[cell.agent])
    told = "" if cell.beta is None else f" β = {cell.beta:g}"
    return Group(f"{name}{' ' + psi if psi else ''}{told}", (cell,))
