"""A trained agent on a robot: reading it, driving with it, and what sensors say in the form it knows.

Nothing here needs PyBullet, Hydra, TorchRL or torch, but for :mod:`rcdsac_trl.deploy.export`, which writes ONNX.
"""

from rcdsac_trl.deploy.policy.acting import ActingSettings
from rcdsac_trl.deploy.policy.beta_controllers import (
    BetaController,
    ClearanceBeta,
    FixedBeta,
    TailVarianceBeta,
)
from rcdsac_trl.deploy.policy.command import Command, Outlook
from rcdsac_trl.deploy.policy.input_checks import InputLimits, Stamps
from rcdsac_trl.deploy.policy.path import PathFollower
from rcdsac_trl.deploy.policy.policy import Policy
from rcdsac_trl.deploy.policy.weights import AgentConfig, Weights, find_weights, read_weights, shipped_names
from rcdsac_trl.deploy.sensors.cloud import CameraPose, CloudFilter, cloud_sectors
from rcdsac_trl.deploy.sensors.scan import Scan, scan_sectors
from rcdsac_trl.robot.guard import Guard
from rcdsac_trl.robot.sectors import Mount, Sectors

__all__ = [
    "ActingSettings",
    "AgentConfig",
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
