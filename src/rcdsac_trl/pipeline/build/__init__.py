"""From the config to objects: the only package that reads ``cfg``."""

from rcdsac_trl.pipeline.build.calibration import calibration
from rcdsac_trl.pipeline.build.course import course
from rcdsac_trl.pipeline.build.evaluation import evaluation
from rcdsac_trl.pipeline.build.export import Export, export
from rcdsac_trl.pipeline.build.publish import publication
from rcdsac_trl.pipeline.build.resume import run_to_continue
from rcdsac_trl.pipeline.build.search import search
from rcdsac_trl.pipeline.build.sweep import check_single, sweep
from rcdsac_trl.pipeline.build.training import check_training, failure, given_overrides, resumed, run_folder, trainer

__all__ = [
    "Export",
    "calibration",
    "check_single",
    "check_training",
    "course",
    "evaluation",
    "export",
    "failure",
    "given_overrides",
    "publication",
    "resumed",
    "run_folder",
    "run_to_continue",
    "search",
    "sweep",
    "trainer",
]
