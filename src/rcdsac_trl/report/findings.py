"""Statistics of all conditions as tables: summaries, comparisons in pairs, trends in beta, what turning it brings."""

import itertools

import numpy as np
import pandas as pd

from rcdsac_trl.report import statistics
from rcdsac_trl.report.read import CONDITION, Episodes, possible
from rcdsac_trl.report.rows import condition_label
from rcdsac_trl.report.statistics import Array, Interval, Statistic
from rcdsac_trl.report.training_errors import training_errors
from rcdsac_trl.report.training_scatter import TrainingError

TAILS = (0.1, 0.25)
"""Shares of the worst returns whose mean is given: realised CVaR."""
SUMMARISED: dict[str, tuple[str, Statistic]] = {
    "reward, interquartile mean": ("reward", statistics.interquartile_mean),
    **{f"reward, mean of the worst {share:.0%}": ("reward", statistics.cvar(share)) for share in TAILS},
}
"""Statistics beside the means of all metrics: of which metric, and which."""
TRENDS = ("collisions", "mean_speed_m_per_s", "goals", "reward")
COMPARED = ("collisions", "reward")
"""Metrics of which conditions are compared with each other."""
# Collisions are better fewer.
_BETTER_DOWN = {"collisions"}


def labels(episodes: Episodes) -> list[str]:
    """Name the conditions, in their order, with what stood between the agent and the wheels."""
    sensors = episodes.conditions["sensor"].nunique()
    columns = (episodes.conditions[key].tolist() for key in CONDITION)
    agents, names, betas, weights, controllers = columns
    helps = (f", with {helped}" if helped else "" for helped in episodes.conditions["helped"])
    rows = zip(agents, names, betas, weights, controllers, helps, strict=True)
    return [
        condition_label(agent, name, beta, weight, by, sensors) + help_ for agent, name, beta, weight, by, help_ in rows
    ]


def bounded(
    values: Array, metric: str, statistic: Statistic = statistics.mean, error: TrainingError | None = None
) -> Interval:
    """Return a statistic of a metric and its interval, none of it outside of what the metric can be."""
    return statistics.bootstrap(values, statistic, error).within(*possible(metric))


def summary(episodes: Episodes) -> pd.DataFrame:
    """Return `condition`, `statistic`, `value`, `low`, `high`: every metric's mean, and :data:`SUMMARISED`."""
    rows, errors = [], training_errors(episodes)
    for (_, condition), label in zip(episodes.conditions.iterrows(), labels(episodes), strict=True):
        wanted = {metric: (metric, statistics.mean) for metric in episodes.metrics} | SUMMARISED
        for name, (metric, statistic) in wanted.items():
            error = errors.of(condition, metric, statistic)
            interval = bounded(episodes.of(condition, metric), metric, statistic, error)
            rows.append({"condition": label, "statistic": name} | vars(interval))
    return pd.DataFrame(rows)


def comparisons(episodes: Episodes) -> pd.DataFrame:
    """Compare all conditions of one sensor with each other, on the same maps.

    Returns:
        One row a pair and metric: `sensor`, `first`, `second`, `metric`, `difference`, `low`, `high`; `better`, the
        probability that an episode of the first is the better one, `better_low`, `better_high`; and `p_value`,
        adjusted by Holm's method for the number of pairs of its sensor, a metric at a time.
    """
    rows, errors = [], training_errors(episodes)
    named = list(zip(episodes.conditions.iterrows(), labels(episodes), strict=True))
    for ((_, first), first_label), ((_, second), second_label) in itertools.combinations(named, 2):
        if first["sensor"] != second["sensor"]:
            continue
        for metric in COMPARED:
            sides = episodes.of(first, metric), episodes.of(second, metric)
            same, error = errors.same(first, second), errors.between(first, second, metric)
            found = statistics.compare(*sides, same_agents=same, error=error)
            better = found.improvement
            if metric in _BETTER_DOWN:
                better = Interval(1 - better.value, 1 - better.high, 1 - better.low)
            rows.append(
                {
                    "sensor": first["sensor"],
                    "first": first_label,
                    "second": second_label,
                    "metric": metric,
                    "difference": found.difference.value,
                    "low": found.difference.low,
                    "high": found.difference.high,
                    "better": better.value,
                    "better_low": better.low,
                    "better_high": better.high,
                    "p_value": found.p_value,
                }
            )
    table = pd.DataFrame(rows)
    if rows:
        families = table.groupby(["sensor", "metric"])["p_value"]
        table["p_value"] = families.transform(lambda values: statistics.holm(values.tolist()))
    return table


def trends(episodes: Episodes) -> pd.DataFrame:
    """Test whether metrics go with beta, for each agent that was driven at three values of it or more.

    Maps are the blocks, so the test speaks of the agents that were driven, also where they are of several seeds.

    Returns:
        `agent`, `sensor`, `metric`, `settings`, `correlation` and `p_value`, see
        :func:`rcdsac_trl.report.statistics.trend`; `worst_reward` is the worst episode of each map and beta.
    """
    rows = []
    told = episodes.conditions.dropna(subset="beta")
    for (agent, sensor), conditions in told.groupby(["agent", "sensor"], sort=False):
        if len(conditions) < 3:
            continue
        ordered = [condition for _, condition in conditions.sort_values("beta").iterrows()]
        columns = {
            metric: [np.nanmean(episodes.of(condition, metric), axis=(0, 2)) for condition in ordered]
            for metric in TRENDS
        }
        columns["worst_reward"] = [episodes.of(condition, "reward").min((0, 2)) for condition in ordered]
        for metric, values in columns.items():
            found = statistics.trend(np.stack(values, 1))
            rows.append({"agent": agent, "sensor": sensor, "metric": metric, "settings": len(ordered)} | vars(found))
    return pd.DataFrame(rows)


def adaptive(episodes: Episodes) -> pd.DataFrame:
    """Compare every controller of beta with the best fixed beta of the same agent, on the same maps.

    The best one is chosen for each metric by these very episodes, which favours it.

    Returns:
        One row a controller and metric: `agent`, `sensor`, `controller`, `mean_beta`, `metric`, `value`; `best_beta`
        and `best_value`; `difference` from it, `low`, `high`; and `p_value`, adjusted by Holm's method for the agent's
        number of controllers.
    """
    rows, errors = [], training_errors(episodes)
    for (agent, sensor), conditions in episodes.conditions.groupby(["agent", "sensor"], sort=False):
        turned = conditions[conditions["beta_controller"].notna()]
        fixed = [condition for _, condition in conditions.dropna(subset="beta").iterrows()]
        for metric in COMPARED:
            means = [statistics.mean(episodes.of(condition, metric)) for condition in fixed]
            found = []
            for _, condition in turned.iterrows():
                best = int(np.argmin(means) if metric in _BETTER_DOWN else np.argmax(means))
                values = episodes.of(condition, metric)
                error = errors.between(condition, fixed[best], metric)
                compared = statistics.compare(values, episodes.of(fixed[best], metric), same_agents=True, error=error)
                found.append(
                    {
                        "agent": agent,
                        "sensor": sensor,
                        "controller": condition["beta_controller"],
                        "mean_beta": statistics.mean(episodes.of(condition, "mean_beta")),
                        "metric": metric,
                        "value": statistics.mean(values),
                        "best_beta": fixed[best]["beta"],
                        "best_value": means[best],
                        "difference": compared.difference.value,
                        "low": compared.difference.low,
                        "high": compared.difference.high,
                        "p_value": compared.p_value,
                    }
                )
            adjusted = statistics.holm([row["p_value"] for row in found])
            rows += [row | {"p_value": p_value} for row, p_value in zip(found, adjusted, strict=True)]
    return pd.DataFrame(rows)
