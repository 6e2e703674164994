"""Tables that another process may still write."""

import io
from pathlib import Path
from typing import Any

import pandas as pd


def read_growing(path: Path, **options: Any) -> pd.DataFrame:
    """Read the whole lines of a CSV table: a last one without an end is being written, or was cut.

    Args:
        path: the file.
        options: of :func:`pandas.read_csv`.

    Raises:
        OSError: if it cannot be read.
        ValueError: if it has no whole line, or is no table.
    """
    content = path.read_bytes()
    return pd.read_csv(io.BytesIO(content[: content.rfind(b"\n") + 1]), **options)
