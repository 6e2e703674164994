"""How users name a checkpoint."""

from typing import Literal

CheckpointName = Literal["best", "last"] | int
"""The best on validation maps, the newest, or the one after so many iterations."""
