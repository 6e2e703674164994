"""Which version of this package runs."""

import subprocess
from pathlib import Path


def commit() -> str:
    """Return the commit of the checkout this package runs from (with ``+`` if changed), or ``none``."""
    here = Path(__file__).parent
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--abbrev=40", "--dirty=+", "--exclude=*"],
            cwd=here,
            capture_output=True,
            text=True,
            encoding="utf-8",
            check=True,
            timeout=10,
        )
        tracked = subprocess.run(["git", "ls-files", "--error-unmatch", __file__], cwd=here, capture_output=True)
    except (OSError, subprocess.SubprocessError):
        return "none"
    return described.stdout.strip() if tracked.returncode == 0 else "none"
