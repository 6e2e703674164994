"""What other trainings would have changed in the results of a report, from all trainings in it."""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pandas as pd

from rcdsac_trl.report.read import Episodes
from rcdsac_trl.report.rows import has_dial
from rcdsac_trl.report.statistics import Array, Interval, Statistic, Term, contrast, mean
from rcdsac_trl.report.training_scatter import TrainingError, TrainingScatter

Recipe = tuple[str, str, float | None]
"""What was trained, once for each seed: an agent for a sensor; and its beta, if each was trained for itself."""
Terms = Sequence[tuple[float, pd.Series]]
"""Weighted conditions."""


@dataclass(frozen=True)
class _Table:
    """A statistic of all trainings of a sensor.

    Attributes:
        recipes: in the order of `scatter`'s agents.
        settings: the conditions of each, by number in :attr:`Episodes.conditions`, in their order.
        seeds: of each, as in the rows of `values`.
        values: of each, ``[S, K]``.
        scatter: of these.
    """

    recipes: list[Recipe]
    settings: list[list[int]]
    seeds: list[list[int]]
    values: list[Array]
    scatter: TrainingScatter


@lru_cache(maxsize=1)
def training_errors(episodes: Episodes) -> "TrainingErrors":
    """Return the errors of a report's conditions: all its tables and figures ask for those of the same episodes."""
    return TrainingErrors(episodes)


class TrainingErrors:
    """The errors of means, differences and other statistics of a report's conditions.

    Agents of one sensor are pooled, metric by metric and statistic by statistic. Planners have no training: nothing
    would change of them.

    Args:
        episodes: of all agents.
    """

    def __init__(self, episodes: Episodes) -> None:
        self._episodes = episodes
        self._tables: dict[tuple[str, str, Statistic], _Table] = {}
        # Weights of one seed that differ from beta to beta are of a training each.
        of_seeds = episodes.table.groupby(["agent", "sensor", "train_seed"])["weights"].nunique().reset_index()
        apart = of_seeds[of_seeds["weights"] > 1]
        self._trained_apart = set(zip(apart["agent"], apart["sensor"], strict=True))

    def is_known(self, sensor: str, metric: str, statistic: Statistic = mean) -> bool:
        """Say whether any agent of a sensor has two trainings."""
        return self._table(sensor, metric, statistic).scatter.is_known

    def of(self, condition: pd.Series, metric: str, statistic: Statistic = mean) -> TrainingError:
        """Return the error of a statistic of a condition."""
        return self.of_sum([(1.0, condition)], metric, statistic)

    def between(self, first: pd.Series, second: pd.Series, metric: str) -> TrainingError:
        """Return the error of a difference of the means of two conditions."""
        return self.of_sum([(1.0, first), (-1.0, second)], metric)

    def of_sum(self, terms: Terms, metric: str, statistic: Statistic = mean) -> TrainingError:
        """Return the error of a weighted sum over conditions."""
        error = TrainingError()
        for sensor in dict.fromkeys(condition["sensor"] for _, condition in terms):
            of_sensor = [(weight, condition) for weight, condition in terms if condition["sensor"] == sensor]
            error += self._of_sensor(self._table(sensor, metric, statistic), of_sensor)
        return error

    def contrast(self, terms: Terms, metric: str) -> Interval:
        """Return a weighted sum of the means of conditions, and its interval over maps and trainings."""
        sides = [Term(weight, self._episodes.of(condition, metric), condition["agent"]) for weight, condition in terms]
        return contrast(sides, error=self.of_sum(terms, metric))

    def same(self, first: pd.Series, second: pd.Series) -> bool:
        """Say whether two conditions were driven by agents of the same trainings."""
        return self._recipe(first) == self._recipe(second)

    def trainings(self, metrics: Sequence[str]) -> pd.DataFrame:
        """Return how far the trainings of each agent lie apart.

        Returns:
            One row an agent and metric: `agent`, `sensor`, `beta` where each was trained for itself, `trainings`,
            `metric`; `sd`, the standard deviation of one setting from training to training, `sd_others`, that of all
            other agents that are pooled, and `apart`: whether it is not pooled, being for sure larger.
        """
        rows = []
        for sensor in self._episodes.conditions["sensor"].unique():
            for metric in metrics:
                table = self._table(sensor, metric, mean)
                for number, (agent, _, beta) in enumerate(table.recipes):
                    own, others = table.scatter.spread(number), table.scatter.pooled(number)
                    rows.append(
                        {
                            "agent": agent,
                            "sensor": sensor,
                            "beta": beta,
                            "trainings": len(table.seeds[number]),
                            "metric": metric,
                            "sd": _deviation(*own),
                            "sd_others": _deviation(*others),
                            "apart": number in table.scatter.apart,
                        }
                    )
        return pd.DataFrame(rows)

    @staticmethod
    def _of_sensor(table: _Table, terms: Terms) -> TrainingError:
        weights: defaultdict[tuple[int, int], defaultdict[int, float]] = defaultdict(lambda: defaultdict(float))
        places = {
            number: (recipe, place) for recipe, of in enumerate(table.settings) for place, number in enumerate(of)
        }
        for weight, condition in terms:
            if condition.name not in places:  # a planner
                continue
            recipe, place = places[condition.name]
            measured = np.flatnonzero(np.isfinite(table.values[recipe][:, place])).tolist()
            for training in measured:
                weights[recipe, training][place] += weight / len(measured)
        return table.scatter.error((recipe, of_training) for (recipe, _), of_training in weights.items())

    def _table(self, sensor: str, metric: str, statistic: Statistic) -> _Table:
        key = sensor, metric, statistic
        if key not in self._tables:
            self._tables[key] = self._made(*key)
        return self._tables[key]

    def _made(self, sensor: str, metric: str, statistic: Statistic) -> _Table:
        conditions = self._episodes.conditions
        of_recipes: defaultdict[Recipe, dict[int, dict[int, float]]] = defaultdict(dict)
        for number, condition in conditions[conditions["trained"] & (conditions["sensor"] == sensor)].iterrows():
            values, seeds = self._episodes.of(condition, metric), self._episodes.seeds(condition)
            after = {seed: statistic(of_seed) for seed, of_seed in zip(seeds, values, strict=True)}
            of_recipes[self._recipe(condition)][int(str(number))] = after
        numbers = [list(settings) for settings in of_recipes.values()]
        trained = [sorted(set().union(*settings.values())) for settings in of_recipes.values()]
        arrays = [
            np.array([[after.get(seed, math.nan) for after in settings.values()] for seed in of_recipe])
            for settings, of_recipe in zip(of_recipes.values(), trained, strict=True)
        ]
        return _Table(list(of_recipes), numbers, trained, arrays, TrainingScatter(arrays))

    def _recipe(self, condition: pd.Series) -> Recipe:
        agent, sensor = condition["agent"], condition["sensor"]
        apart = not has_dial(agent) or (agent, sensor) in self._trained_apart
        return agent, sensor, condition["beta"] if apart else None


def _deviation(variance: float, freedom: int) -> float:
    """Return a standard deviation, NaN where nothing tells it."""
    return variance**0.5 if freedom else math.nan
