"""Shared by all tests."""

from pathlib import Path

import pytest
import torch

# Small tensors: a second thread costs more than it brings, and far more while tests run side by side.
torch.set_num_threads(1)


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one finished tiny training of rcdsac_pow; tests only read it, but for its evaluations."""
    from tiny import tiny_trainer  # the other tests need not wait for the whole pipeline

    folder = tmp_path_factory.mktemp("tiny") / "run"
    tiny_trainer(folder, "rcdsac_pow", "logger=default").run()
    return folder
