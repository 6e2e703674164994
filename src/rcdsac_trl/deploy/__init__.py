"""A trained agent on a robot: reading it, driving with it, and what sensors say in the form it knows.

Nothing here needs PyBullet, Hydra, TorchRL or torch, but for :mod:`rcdsac_trl.deploy.exported`, which writes ONNX.
"""

from rcdsac_trl.deploy.adaptive import BanditBeta, BetaController, ClearanceBeta, FixedBeta, TailVarianceBeta
from rcdsac_trl.deploy.checks import InputLimits, Stamps
from rcdsac_trl.deploy.cloud import CameraPose, CloudFilter, cloud_sectors
from rcdsac_trl.deploy.command import Command, Outlook
from rcdsac_trl.deploy.guard import Guard
from rcdsac_trl.deploy.path import PathFollower
from rcdsac_trl.deploy.policy import Policy
from rcdsac_trl.deploy.scan import Scan, scan_sectors
from rcdsac_trl.deploy.sectors import Mount, Sectors
from rcdsac_trl.deploy.weights import AgentConfig, Weights, find_weights, read_weights, shipped_names

__all__ = [
    "AgentConfig",
    "BanditBeta",
    "BetaController",
    "CameraPose",
    "ClearanceBeta",
    "CloudFilter",
    "Command",
    "FixedBeta",
    "Guard",
    "InputLimits",
    "Mount",
    "Outlook",
    "PathFollower",
    "Policy",
    "Scan",
    "Sectors",
    "Stamps",
    "TailVarianceBeta",
    "Weights",
    "cloud_sectors",
    "find_weights",
    "read_weights",
    "scan_sectors",
    "shipped_names",
]
