"""Shared by all tests."""

import torch

# Small tensors: a second thread costs more than it brings, and far more while tests run side by side.
torch.set_num_threads(1)
