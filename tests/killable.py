"""Trains tiny runs in processes that die of SIGKILL at an event that the test names; see test_resume.py.

A process of its own serves them, so that what it changes is of this alone: each line that it reads is a job, and each
job a fork of it. Events are counted, so that where a run dies does not depend on the clock.
"""

import json
import os
import shutil
import signal
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TextIO

from rcdsac_trl.storage.sequence_replay import SequenceReplay
from rcdsac_trl.system import process_pool
from rcdsac_trl.training.learner import Learner
from rcdsac_trl.training.run_log import RunLog
from rcdsac_trl.training.setup import resume_training
from rcdsac_trl.world.task.agent_group import AgentGroup
from tiny import evaluate, tiny_trainer

SAVING = [(os, "fsync"), (os, "rename"), (os, "truncate"), (os, "unlink"), (shutil, "rmtree")]
TRAINING = [
    (RunLog, "episodes"),
    (RunLog, "scalars"),
    (SequenceReplay, "add_episodes"),
    (Learner, "update"),
    (AgentGroup, "step"),
]


class Events:
    """Counts every call of what is watched, and kills the process before the call of a given kind and number."""

    def __init__(self, kill_at: tuple[str, int] | None) -> None:
        self.kill_at = kill_at
        self.process = os.getpid()
        self.counted = {"saving": 0, "training": 0}
        for kind, watched in (("saving", SAVING), ("training", TRAINING)):
            for owner, name in watched:
                setattr(owner, name, self.watched(getattr(owner, name), kind))

    def watched(self, function: Callable[..., Any], kind: str) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            if (kind, self.counted[kind]) == self.kill_at and os.getpid() == self.process:
                os.kill(os.getpid(), signal.SIGKILL)
            self.counted[kind] += 1
            return function(*args, **kwargs)

        return call


def work(job: dict[str, Any]) -> None:
    """Do a job, as the command line does it, and write down what happened."""
    folder = Path(job["folder"])
    events = Events(tuple(job["kill_at"]) if job["kill_at"] is not None else None)
    if job["do"] == "train":
        tiny_trainer(folder, job["row"], *job["overrides"]).run()
    else:
        trainer = resume_training(folder)
        if trainer is not None:
            trainer.run()
    happened = dict(events.counted)
    for name in job["evaluate"]:
        evaluate(f"run={folder}", *job["told"], f"checkpoint={name}", f"out={folder / 'evaluation' / name}")
    Path(job["out"]).write_text(json.dumps(happened))


def serve(jobs: TextIO, answers: TextIO, prepared: list[str]) -> None:
    """Do jobs until there are no more; answer each with the status of its process.

    Args:
        jobs: a job a line.
        answers: an answer a line.
        prepared: overrides of the training that goes before: what it has compiled and which maps it has made, all
            forks have.
    """
    process_pool.START_METHOD = "fork"  # a fork server would import everything for each job anew
    with TemporaryDirectory() as folder:
        tiny_trainer(Path(folder), "rcdsac_pow", *prepared, "logger=none").run()
    for line in jobs:
        job = json.loads(line)
        alive, held = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(alive)
            log = os.open(job["out"] + ".log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            os.dup2(log, 1)
            os.dup2(log, 2)
            code = 0
            try:
                work(job)
            except BaseException:
                traceback.print_exc()
                code = 1
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
        os.close(held)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        os.read(alive, 1)  # until whatever the job had started has ended, too
        os.close(alive)
        answers.write(f"{status}\n")
        answers.flush()
