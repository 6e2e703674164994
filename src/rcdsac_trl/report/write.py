"""A report's folder: tables in several formats, statistics, verdicts, figures, and one page of it all."""

from pathlib import Path

from matplotlib.figure import Figure

from rcdsac_trl.report import findings, table
from rcdsac_trl.report.comparison_figures import collision_causes, paired_differences
from rcdsac_trl.report.folder import CLAIMS, check_report_folder, clear_report_folder
from rcdsac_trl.report.learning_figures import learning_curves
from rcdsac_trl.report.page import page
from rcdsac_trl.report.response_figures import beta_response
from rcdsac_trl.report.results import Results
from rcdsac_trl.report.sections import lead, sections, title
from rcdsac_trl.report.verdict_words import as_table, evidence


def write_report(results: Results, out: Path) -> None:
    """Write everything.

    Args:
        results: what is written.
        out: the folder; where it is an earlier report's, this one takes its place.

    Raises:
        UserInputError: if it holds something else.
    """
    check_report_folder(out)
    claims = as_table(results.claims)
    tables = {
        "claims": claims,
        "claims_evidence": evidence(results.claims),
        "summary": results.summary,
        "comparisons": results.comparisons,
        "trends": results.trends,
        "trainings": results.trainings,
        "averages": results.averages,
        "adaptive": results.adaptive,
        "collision_summary": results.causes,
    }
    figures = _figures(results)
    told = page(title(results), lead(results), sections(results))
    # Only now: what an earlier report holds is not lost to one that cannot be made.
    clear_report_folder(out)
    out.mkdir(parents=True, exist_ok=True)
    (out / CLAIMS).write_text(table.markdown(claims), encoding="utf-8")
    table.write_table(results.paper, out / "table")
    if results.course is not None:
        results.course.to_csv(out / "course.csv", index=False)
        (out / "course.md").write_text(table.markdown(results.course), encoding="utf-8")
    for name, values in tables.items():
        if len(values) or name not in ("adaptive", "collision_summary"):
            values.to_csv(out / f"{name}.csv", index=False, float_format="%.6g")
    for name, figure in figures.items():
        figure.savefig(out / f"{name}.png", dpi=130)
    (out / "report.html").write_text(told, encoding="utf-8")


def _figures(results: Results) -> dict[str, Figure]:
    """Draw the figures that a report's folder holds by name."""
    figures: dict[str, Figure] = {}
    for measure in results.measures:
        if (figure := beta_response(results.episodes, measure)) is not None:
            figures[f"beta_response_{measure}"] = figure
    for sensor, reference in results.references.items():
        for metric in findings.COMPARED:
            figures[f"differences_{metric}_{sensor}"] = paired_differences(results.episodes, reference, metric)
    if results.learnt:
        figures["learning_curves"] = learning_curves(results.learnt)
    if len(results.causes):
        figures["collision_causes"] = collision_causes(results.causes)
    return figures
