"""The claims of the paper's simulation table and of its text, one by one.

Section "Performance Comparison" of Choi, Dance, Kim, Hwang and Park (2021), *Risk-Conditioned Distributional Soft
Actor-Critic for Risk-Sensitive Navigation*. Where the text averages, it does so over both risk measures at the two
settings of each that DSAC has: so do the claims here.
"""

import math
from collections.abc import Iterator, Sequence

import pandas as pd

from rcdsac_trl.report.averages import averaged_rows
from rcdsac_trl.report.read import Episodes
from rcdsac_trl.report.rows import condition_label, paper_table
from rcdsac_trl.report.statistics import Array
from rcdsac_trl.report.table import SENSORS
from rcdsac_trl.report.training_errors import training_errors
from rcdsac_trl.report.training_scatter import TrainingError
from rcdsac_trl.report.verdicts import Cell, Claim, Expectation, Finding, Group, Measured, find, than

_RESAMPLE, _STORED, _DSAC, _RCWR, _SAC = "RC-DSAC (resample)", "RC-DSAC (stored)", "DSAC", "RCWR", "SAC"
_RISK_SENSITIVE = (_RESAMPLE, _STORED, _DSAC)
_ROWS_BY_BETA = ("rcdsac_cvar", "rcdsac_pow", "rcdsac_cvar_stored", "rcdsac_pow_stored")
# RC-DSAC (resample) at its most averse and at its boldest in the paper's table.
_AVERSE = (("rcdsac_cvar", 0.25), ("rcdsac_pow", -2.0))
_BOLD = (("rcdsac_cvar", 1.0), ("rcdsac_pow", -0.5))


def claims() -> list[Claim]:
    """Return all claims: of each sensor, then of one sensor against the other."""
    return [claim for sensor in SENSORS for claim in _Rows(sensor).claims()] + _between_sensors()


def judged_claims(episodes: Episodes) -> list[Finding]:
    """Judge all claims by the episodes that were driven."""
    measured = _measured(episodes)
    return [find(claim, measured) for claim in claims()]


def _measured(episodes: Episodes) -> Measured:
    """Find cells among the episodes; the paper turns no beta, so what controllers drove is left out."""
    fixed = episodes.conditions[episodes.conditions["beta_controller"].isna()]
    own = {_cell(condition): condition for _, condition in fixed.iterrows()}
    paper = {_cell(row): row for _, row in paper_table().iterrows()}

    def values(cell: Cell, metric: str) -> Array | None:
        return episodes.of(own[cell], metric) if cell in own else None

    def printed(cell: Cell, metric: str) -> float:
        return float(paper[cell][f"{metric}_mean"]) if cell in paper else math.nan

    errors = training_errors(episodes)

    def error(terms: Sequence[tuple[float, Cell]], metric: str) -> TrainingError | None:
        if not all(errors.is_known(cell.sensor, metric) for _, cell in terms):
            return None
        return errors.of_sum([(weight, own[cell]) for weight, cell in terms], metric)

    return Measured(values, printed, error=error)


def _cell(row: pd.Series) -> Cell:
    beta, weight = (None if pd.isna(value) else float(value) for value in (row["beta"], row["collision_weight"]))
    return Cell(row["agent"], beta, weight, row["sensor"])


class _Rows:
    """The paper's rows under one sensor, in groups that its text speaks of."""

    def __init__(self, sensor: str) -> None:
        self.sensor = sensor
        table = paper_table()
        self._table = table[table["sensor"] == sensor]
        self._rows_averaged = averaged_rows(self._table)

    def claims(self) -> list[Claim]:
        """Return the claims in the order of the paper's text, the main one first."""
        return [
            *self._fewest(),
            *self._sac(),
            *self._averaged(),
            *self._weights(),
            *self._orders(),
        ]

    def _claim(self, says: str, *expectations: Expectation, any_of: bool = False) -> Claim:
        return Claim(says, self.sensor, expectations, "any" if any_of else "all")

    def _fewest(self) -> Iterator[Claim]:
        mean = self.average(_RESAMPLE)
        others = (self.average(_DSAC), self.average(_STORED), self.average(_RCWR), self.average(_SAC))
        yield self._claim(
            "RC-DSAC (resample) collides least, averaged", *(than(mean, "less", other) for other in others)
        )
        fewest, *rest = self._first_and_rest("rcdsac_pow", -1.5)
        yield self._claim(
            "Of all rows the power law at β = -1.5 collides least", *(than(fewest, "less", other) for other in rest)
        )
        if self.sensor == "narrow":
            averaged = (self.average(_DSAC), self.average(_STORED))
            yield self._claim(
                "RC-DSAC (resample) earns most, averaged",
                *(than(mean, "more", other, "reward") for other in averaged),
            )
            most, *rest = self._first_and_rest("rcdsac_pow", -1.0)
            yield self._claim(
                "Of all rows the power law at β = -1 earns most",
                *(than(most, "more", other, "reward") for other in rest),
            )

    def _sac(self) -> Iterator[Claim]:
        sac = self.average(_SAC)
        rows = [row for name in _RISK_SENSITIVE for row in self.each_of(name)]
        yield self._claim(
            "SAC collides most: every row of RC-DSAC and DSAC collides less", *(than(row, "less", sac) for row in rows)
        )
        yield self._claim("RCWR collides less than SAC", than(self.average(_RCWR), "less", sac))
        yield self._claim(
            "Some rows of RC-DSAC or DSAC earn more than SAC",
            *(than(row, "more", sac, "reward") for row in rows),
            any_of=True,
        )

    def _averaged(self) -> Iterator[Claim]:
        resample, stored, dsac = (self.average(name) for name in _RISK_SENSITIVE)
        yield self._claim("RC-DSAC (resample) collides less than DSAC, averaged", than(resample, "less", dsac))
        yield self._claim("Resampled β collides less than stored β, averaged", than(resample, "less", stored))
        if self.sensor == "narrow":
            yield self._claim(
                "RC-DSAC (stored) collides about as often as DSAC, averaged", than(stored, "comparable", dsac)
            )
            yield self._claim("RC-DSAC (stored) earns more than DSAC, averaged", than(stored, "more", dsac, "reward"))
        else:
            yield self._claim("RC-DSAC (stored) collides less than DSAC, averaged", than(stored, "less", dsac))
            yield self._claim(
                "RC-DSAC (stored) earns about as much as DSAC, averaged", than(stored, "comparable", dsac, "reward")
            )

    def _weights(self) -> Iterator[Claim]:
        averse, bold = (
            Group(name, tuple(Cell(agent, beta, None, self.sensor) for agent, beta in cells))
            for name, cells in (("RC-DSAC averse", _AVERSE), ("RC-DSAC bold", _BOLD))
        )
        heavy, light = (
            Group(f"RCWR at w_coll = {weight:g}", (Cell("rcwr", None, weight, self.sensor),)) for weight in (2.0, 1.0)
        )
        yield self._claim("Averse RC-DSAC collides less than RCWR at its most careful", than(averse, "less", heavy))
        yield self._claim(
            "Turning β saves more collisions than turning RCWR's weight",
            Expectation(
                (bold, averse, light, heavy),
                (1.0, -1.0, -1.0, 1.0),
                "collisions",
                "more",
                "β saves more than the weight by",
            ),
        )

    def _orders(self) -> Iterator[Claim]:
        for agent in _ROWS_BY_BETA:
            cells = sorted((cell for cell in self._cells() if cell.agent == agent), key=lambda cell: cell.beta or 0.0)
            groups = tuple(Group(f"β = {cell.beta:g}", (cell,)) for cell in cells)
            name = condition_label(agent, self.sensor, math.nan, math.nan, None)
            yield self._claim(
                f"{name}: collisions rise with β" + ("" if "cvar" in agent else " (the paper claims it of CVaR alone)"),
                Expectation(groups, _rise(len(groups)), "collisions", "more", "A straight line rises by"),
            )

    def average(self, name: str) -> Group:
        """Average over the rows of a name that the paper's text averages."""
        return Group(name, tuple(_cell(row) for _, row in self._rows_averaged[name, self.sensor].iterrows()))

    def each_of(self, name: str) -> list[Group]:
        """Return the rows of a name, each for itself."""
        rows = self._table[self._table["name"] == name]
        return [_alone(_cell(row)) for _, row in rows.iterrows()]

    def _first_and_rest(self, agent: str, beta: float) -> list[Group]:
        """Return one row, and then all others."""
        first = Cell(agent, beta, None, self.sensor)
        return [_alone(first), *(_alone(cell) for cell in self._cells() if cell != first)]

    def _cells(self) -> list[Cell]:
        return [_cell(row) for _, row in self._table.iterrows()]


def _between_sensors() -> list[Claim]:
    """Say of each kind of agent what the paper's table says: with the sparse sensor it collides less."""
    narrow, sparse = (_Rows(sensor) for sensor in SENSORS)

    def means(rows: _Rows, name: str) -> Group:
        return Group(f"{name} {rows.sensor}", rows.average(name).cells)

    return [
        Claim(
            f"{name} collides less with the sparse sensor than with the narrow one",
            " and ".join(SENSORS),
            (than(means(sparse, name), "less", means(narrow, name)),),
        )
        for name in (*_RISK_SENSITIVE, _RCWR, _SAC)
    ]


def _alone(cell: Cell) -> Group:
    beta, weight = (math.nan if value is None else value for value in (cell.beta, cell.collision_weight))
    return Group(condition_label(cell.agent, cell.sensor, beta, weight, None), (cell,))


def _rise(settings: int) -> tuple[float, ...]:
    """Return the weights that give the rise of the straight line through so many means, from the first to the last.

    Example:
        >>> _rise(2), _rise(3)
        ((-1.0, 1.0), (-1.0, 0.0, 1.0))
    """
    steps = [number - (settings - 1) / 2 for number in range(settings)]
    scale = (settings - 1) / sum(step**2 for step in steps)
    return tuple(step * scale for step in steps)
