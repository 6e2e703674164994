"""A report's folder: what may become one, and what an earlier report has left in it."""

from pathlib import Path

from rcdsac_trl.errors import UserInputError

CLAIMS = "claims.md"
"""The first file that a report writes: by it its folder is known."""

# What one report has and another has not.
_NOT_ALWAYS = (
    "course.csv",
    "course.md",
    "adaptive.csv",
    "collision_summary.csv",
    "beta_response_*.png",
    "differences_*.png",
    "learning_curves.png",
    "collision_causes.png",
)


def check_report_folder(out: Path) -> None:
    """Refuse a folder that holds something else than a report.

    Raises:
        UserInputError: naming it.
    """
    if out.is_dir() and not (out / CLAIMS).is_file() and any(out.iterdir()):
        raise UserInputError(f"out={out} holds something else than a report: give another folder with out=<folder>")


def clear_report_folder(out: Path) -> None:
    """Remove what an earlier report wrote that the next one may not write over."""
    for pattern in _NOT_ALWAYS:
        for path in out.glob(pattern):
            path.unlink()
