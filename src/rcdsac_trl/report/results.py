"""All that a report says, each thing computed once: its files and its page are made of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import pandas as pd

from rcdsac_trl.report import averages, collision_report, findings, learning, table
from rcdsac_trl.report.claims import judged_claims
from rcdsac_trl.report.course_claims import judged_course_claims
from rcdsac_trl.report.course_table import course_table
from rcdsac_trl.report.read import Episodes
from rcdsac_trl.report.training_errors import training_errors
from rcdsac_trl.report.verdicts import Finding


@dataclass(frozen=True)
class Results:
    """All that a report says, computed once.

    Attributes:
        episodes: of all evaluations.
        folders: of them; learning curves are drawn of those that are runs.
        course_runs: runs over the office course; None if none were named.
    """

    episodes: Episodes
    folders: Sequence[Path]
    course_runs: pd.DataFrame | None = None

    @cached_property
    def paper(self) -> pd.DataFrame:
        """The paper's first table beside the paper's numbers."""
        return table.comparison(self.episodes)

    @cached_property
    def course(self) -> pd.DataFrame | None:
        """The paper's second table beside the paper's numbers."""
        return None if self.course_runs is None else course_table(self.course_runs)

    @cached_property
    def claims(self) -> list[Finding]:
        """Every claim of the paper with its verdict; the course's only where it was driven."""
        return judged_claims(self.episodes) + self.course_claims

    @cached_property
    def course_claims(self) -> list[Finding]:
        """The claims about the office course, none where it was not driven."""
        return [] if self.course_runs is None else judged_course_claims(self.course_runs)

    @cached_property
    def averages(self) -> pd.DataFrame:
        """The averages of the paper's text, of its table and of ours."""
        own = averages.averages(self.episodes).assign(source="here")
        return pd.concat([averages.paper_averages().assign(source="paper"), own])

    @cached_property
    def summary(self) -> pd.DataFrame:
        """Every metric of every condition."""
        return findings.summary(self.episodes)

    @cached_property
    def comparisons(self) -> pd.DataFrame:
        """Every pair of conditions."""
        return findings.comparisons(self.episodes)

    @cached_property
    def trainings(self) -> pd.DataFrame:
        """How far the trainings of each agent lie apart."""
        return training_errors(self.episodes).trainings(findings.COMPARED)

    @cached_property
    def trends(self) -> pd.DataFrame:
        """What goes with beta."""
        return findings.trends(self.episodes)

    @cached_property
    def adaptive(self) -> pd.DataFrame:
        """What controllers of beta bring."""
        return findings.adaptive(self.episodes)

    @cached_property
    def causes(self) -> pd.DataFrame:
        """What was hit."""
        return collision_report.of_episodes(self.episodes, findings.labels(self.episodes))

    @cached_property
    def learnt(self) -> dict[str, pd.DataFrame]:
        """Validation during training, of the folders that are runs."""
        return learning.validation_of_runs(self.folders)

    @cached_property
    def references(self) -> dict[str, int]:
        """What all others of a sensor are compared with: a baseline that knows no risk, if any.

        A sensor with one condition has none.
        """
        chosen = {}
        for sensor, conditions in self.episodes.conditions.groupby("sensor", sort=False):
            agents = conditions["agent"].tolist()
            if len(agents) > 1:
                at = next((agents.index(name) for name in ("sac", "pursuit") if name in agents), 0)
                chosen[str(sensor)] = int(conditions.index[at])
        return chosen

    @cached_property
    def measures(self) -> list[str]:
        """The risk measures of all agents."""
        return [str(measure) for measure in self.episodes.conditions["measure"].dropna().unique()]
