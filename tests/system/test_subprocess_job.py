"""Programs in processes of their own end when they are to, whatever they do."""

import os
import sys
from pathlib import Path

import pytest

from rcdsac_trl.system import subprocess_job
from rcdsac_trl.system.subprocess_job import STOPPED, call

# Tells its number once it ignores SIGTERM, as one does that hangs in compiled code; by itself it ends in a minute.
DEAF = """
import os, signal, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
with open(sys.argv[1], "w") as file:
    file.write(str(os.getpid()))
time.sleep(60)
open(sys.argv[1], "a").write(" outlived it")
"""


@pytest.mark.parametrize("interrupted", [False, True])
def test_a_program_that_does_not_hear_that_it_is_to_end_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, interrupted: bool
) -> None:
    monkeypatch.setattr(subprocess_job, "_POLL_S", 0.02)
    monkeypatch.setattr(subprocess_job, "_PATIENCE_S", 0.1)
    told = tmp_path / "told"

    def should_stop() -> bool:
        is_deaf = told.exists() and bool(told.read_text())
        if is_deaf and interrupted:
            raise KeyboardInterrupt
        return is_deaf

    command = [sys.executable, "-c", DEAF, str(told)]
    if interrupted:
        with pytest.raises(KeyboardInterrupt):
            call(command, tmp_path / "said", {}, should_stop)
    else:
        assert call(command, tmp_path / "said", {}, should_stop) == STOPPED
    number = int(told.read_text())
    with pytest.raises(ProcessLookupError):
        os.kill(number, 0)
