"""Stops a training at the first number that is NaN or infinite, and keeps what shows it again."""

import json
from pathlib import Path
from typing import Any, NoReturn

import safetensors.torch
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.checkpoint import Checkpoint
from torchrl.objectives import LossModule, SoftUpdate

from rcdsac_trl.config.run_config import settings_of_run
from rcdsac_trl.errors import TrainingError
from rcdsac_trl.rollout.make_agent import make_loss
from rcdsac_trl.storage import atomic

_BATCH = "batch.safetensors"
_WEIGHTS = "weights"


class FiniteGuard:
    """Looks at every episode before it is stored and at every update's losses and gradients.

    On the CPU an update that fails is stopped before the optimiser has moved a weight, and its batch, the weights and
    the generator's state go into the dump. Elsewhere looking at each update would make the device wait for it: a
    flag on the device is read once an iteration, and its updates are done again from the last checkpoint.

    Args:
        folder: the run folder; dumps go to ``failure/`` in it.
        loss: whose inputs and losses are looked at.
        optimizer: whose parameters' gradients are looked at.
    """

    def __init__(self, folder: Path, loss: LossModule, optimizer: torch.optim.Optimizer) -> None:
        self.folder = folder / "failure"
        self.loss = loss
        self.optimizer = optimizer
        self._iteration = 1
        self._update = 1
        self._failed: Tensor | None = None
        loss.register_forward_pre_hook(self._remember_input)
        loss.register_forward_hook(self._remember_losses)
        optimizer.register_step_pre_hook(self._check_update)

    def start_iteration(self, iteration: int) -> None:
        """Say which iteration it is, from 0; messages and folders count it, and its updates, from 1 as the log does."""
        self._iteration = iteration + 1
        self._update = 1
        self._failed = None

    def check_episodes(self, episodes: TensorDictBase) -> None:
        """Look at every number of some episodes ``[N, T]``.

        Raises:
            TrainingError: if one is not finite.
        """
        for key, value in sorted(episodes.items(True, True), key=lambda item: _name(item[0])):
            if value.is_floating_point() and not value.isfinite().all():
                episode, step = (~value.isfinite()).flatten(2).any(-1).nonzero()[0].tolist()
                what = f"{_name(key)} of episode {episode} at step {step}"
                self._stop(what, f"iteration-{self._iteration:06d}", episodes)

    def end_iteration(self) -> None:
        """Look at what the device found.

        Raises:
            TrainingError: if a loss or a gradient was not finite.
        """
        if self._failed is not None and self._failed.item():
            raise TrainingError(
                f"a loss or a gradient became NaN or infinite in iteration {self._iteration}: training stops; "
                "the last checkpoint is from before it, and continuing it shows the failure again"
            )

    def _remember_input(self, loss: LossModule, arguments: tuple[TensorDictBase]) -> None:
        self._batch = arguments[0]
        self._generator_state = loss.rng_state

    def _remember_losses(self, loss: LossModule, arguments: tuple[TensorDictBase], losses: TensorDictBase) -> None:
        self._losses = losses

    def _check_update(self, *_: Any) -> None:
        sizes = {key: value.detach() for key, value in self._losses.items() if key.startswith("loss_")}
        for number, group in enumerate(self.optimizer.param_groups):
            gradients = [parameter.grad for parameter in group["params"] if parameter.grad is not None]
            sizes[f"gradient norm of parameter group {number}"] = torch.nn.utils.get_total_norm(gradients)
        failed = ~torch.stack([value.sum() for value in sizes.values()]).sum().isfinite()
        if failed.device.type != "cpu":
            self._failed = failed if self._failed is None else self._failed | failed
        elif failed:
            what = ", ".join(f"{name} = {value.item():g}" for name, value in sizes.items() if not value.isfinite())
            self.loss.rng_state = self._generator_state
            self._stop(what, f"iteration-{self._iteration:06d}-update-{self._update:06d}", self._batch)
        self._update += 1

    def _stop(self, what: str, name: str, batch: TensorDictBase) -> NoReturn:
        folder = self.folder / name
        if not folder.exists():  # else the same failure, again
            self.folder.mkdir(exist_ok=True)
            atomic.clear_leftovers(self.folder)
            temporary = atomic.unfinished(folder)
            Checkpoint(loss=self.loss).save(temporary / _WEIGHTS)
            tensors = {_name(key): _unexpanded(value) for key, value in batch.items(True, True)}
            (temporary / _BATCH).write_bytes(safetensors.torch.save(tensors))
            described = {
                "not_finite": what,
                "iteration": self._iteration,
                "batch_size": list(batch.batch_size),
                "distortion_strength": self.loss.distortion_strength,
            }
            (temporary / "failure.json").write_text(json.dumps(described, indent=2) + "\n", encoding="utf-8")
            atomic.publish(folder)
        raise TrainingError(
            f"{what} is NaN or infinite in iteration {self._iteration}: training stops; {folder} shows it again, "
            "and the last checkpoint is from before it"
        )


def reproduce_failure(dump: Path) -> tuple[LossModule, TensorDict]:
    """Make what shows a NaN or an infinity again: called with the batch, the loss returns what it returned then.

    Args:
        dump: a folder below ``failure/`` of a run folder.
    """
    settings = settings_of_run(dump.parents[1])
    loss = make_loss(settings, "cpu")
    SoftUpdate(loss, tau=settings.learner.target_coefficient)  # TorchRL warns of targets that nothing moves
    return loss, load_failure(dump, loss)


def load_failure(folder: Path, loss: LossModule) -> TensorDict:
    """Load a dump: weights, schedule and the generator's state into a loss of the same run, and return the batch.

    Args:
        folder: below ``failure/`` of a run folder.
        loss: as the run's config makes it; called with the batch, it computes again what was not finite.
    """
    Checkpoint(loss=loss).load(folder / _WEIGHTS, map_location="cpu")
    tensors = safetensors.torch.load_file(folder / _BATCH)
    described = json.loads((folder / "failure.json").read_text(encoding="utf-8"))
    loss.distortion_strength = described["distortion_strength"]
    size = described["batch_size"]
    keyed = {tuple(name.split(".")): value.expand(*size, *value.shape[len(size) :]) for name, value in tensors.items()}
    return TensorDict(keyed, batch_size=size)


def _unexpanded(value: Tensor) -> Tensor:
    """Copy ``[B, T, ..]``, but keep one entry of a time along which it is expanded: a loss may tell the two apart."""
    return (value[:, :1] if value.stride(1) == 0 else value).clone(memory_format=torch.contiguous_format)


def _name(key: str | tuple[str, ...]) -> str:
    return key if isinstance(key, str) else ".".join(key)
