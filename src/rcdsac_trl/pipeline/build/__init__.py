"""From the config to objects: the only package that reads ``cfg``."""

from rcdsac_trl.pipeline.build.evaluation import evaluation
from rcdsac_trl.pipeline.build.training import check_training, run_folder, trainer

__all__ = ["check_training", "evaluation", "run_folder", "trainer"]
