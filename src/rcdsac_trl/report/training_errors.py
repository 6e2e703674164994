"""What other trainings would have changed in the results of a report, from all trainings in it."""

from collections import defaultdict
from collections.abc import Hashable, Sequence

import numpy as np
import pandas as pd

from rcdsac_trl.report.read import CONDITION, Episodes, under
from rcdsac_trl.report.rows import has_dial
from rcdsac_trl.report.statistics import Array, Statistic, mean
from rcdsac_trl.report.training_scatter import TrainingError, TrainingScatter

Training = tuple[str, float | None, str]
"""What was trained: an agent, its beta where each is of another training, and the sensor."""


def training_of(agent: str, beta: float | None, sensor: str) -> Training:
    """Name what drove: settings of one name were driven by the same trainings."""
    return agent, None if has_dial(agent) else beta, sensor


class TrainingErrors:
    """The errors of means, differences and other statistics of a report's conditions.

    Agents of one sensor are pooled, metric by metric and statistic by statistic. Planners have no training: nothing
    would change of them.

    Args:
        episodes: of all agents.
    """

    def __init__(self, episodes: Episodes) -> None:
        self._episodes = episodes
        self._known: dict[tuple[str, str, Statistic], TrainingScatter] = {}
        self._seeds: dict[Hashable, int] = {}

    def scatter(self, sensor: str, metric: str, statistic: Statistic = mean) -> TrainingScatter:
        """Return how far trainings lie apart."""
        key = sensor, metric, statistic
        if key not in self._known:
            self._known[key] = TrainingScatter.of(self._trainings(*key))
        return self._known[key]

    def of(self, condition: pd.Series, metric: str, statistic: Statistic = mean) -> TrainingError:
        """Return the error of a statistic of a condition."""
        return self._sum(condition["sensor"], metric, statistic, [(1.0, condition)])

    def between(self, first: pd.Series, second: pd.Series, metric: str) -> TrainingError:
        """Return the error of a difference of the means of two conditions of one sensor."""
        return self._sum(first["sensor"], metric, mean, [(1.0, first), (-1.0, second)])

    @staticmethod
    def same(first: pd.Series, second: pd.Series) -> bool:
        """Say whether two conditions were driven by the same trainings."""
        return _trained(first) == _trained(second)

    def _sum(
        self, sensor: str, metric: str, statistic: Statistic, terms: Sequence[tuple[float, pd.Series]]
    ) -> TrainingError:
        parts: defaultdict[tuple[Training, int], list[float]] = defaultdict(list)
        for weight, condition in terms:
            if condition["trained"]:
                parts[_trained(condition), self._seeds_of(condition)].append(weight)
        scatter = self.scatter(sensor, metric, statistic)
        return scatter.error((weights, seeds) for (_, seeds), weights in parts.items())

    def _seeds_of(self, condition: pd.Series) -> int:
        if condition.name not in self._seeds:
            self._seeds[condition.name] = under(self._episodes.table, condition, CONDITION)["train_seed"].nunique()
        return self._seeds[condition.name]

    def _trainings(self, sensor: str, metric: str, statistic: Statistic) -> list[Array]:
        """Return a statistic after each training of each agent, ``[S, K]``, at the settings that most seeds drove."""
        conditions = self._episodes.conditions
        driven = conditions[conditions["trained"] & (conditions["sensor"] == sensor)]
        fixed = driven[driven["beta_controller"].isna()]
        of_agents: defaultdict[Training, list[Array]] = defaultdict(list)
        for _, condition in fixed.iterrows():
            of_agents[_trained(condition)].append(self._episodes.of(condition, metric))
        return [_after_each(settings, statistic) for settings in of_agents.values()]


def _trained(condition: pd.Series) -> Training:
    return training_of(condition["agent"], condition["beta"], condition["sensor"])


def _after_each(settings: Sequence[Array], statistic: Statistic) -> Array:
    most = max(len(values) for values in settings)
    driven = [values for values in settings if len(values) == most]
    return np.array([[statistic(of_seed) for of_seed in values] for values in driven]).T
