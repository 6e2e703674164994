"""Losses and their gradients from parts of a mini-batch, each on a thread of its own.

Torch gives its threads to one operation after another, and what lies between two matrix products runs on one of them.
Here each thread does the whole work of some sequences, forwards and backwards, and they meet once.
"""

import functools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

Gradients = tuple[Tensor | None, ...]


def gradients_of(
    outputs: Sequence[Tensor], parameters: Sequence[nn.Parameter], slopes: Sequence[Tensor] | None = None
) -> Gradients:
    """Return gradients as a backward pass leaves them: None for what is frozen or has no part in it.

    Args:
        outputs: are differentiated.
        parameters: by which.
        slopes: that come back to each output; None: 1 to scalars.
    """
    wanted = [parameter for parameter in parameters if parameter.requires_grad]
    if not wanted or not all(output.requires_grad for output in outputs):
        return (None,) * len(parameters)
    found = iter(torch.autograd.grad(outputs, wanted, slopes, allow_unused=True))
    return tuple(next(found) if parameter.requires_grad else None for parameter in parameters)


def parallel_backward(
    compute: Callable[[slice], dict[str, Tensor]],
    groups: dict[str, list[nn.Parameter]],
    parts: list[slice],
    threads: int,
) -> dict[str, Tensor]:
    """Return the sums of what the parts return; the backward pass of each is done in its thread, too.

    The threads only share what they read, and sums are taken in the parts' order: results do not depend on timing.

    Args:
        compute: returns a part's contribution to each loss and, without gradient, to each diagnostic; scalars.
        groups: name of each loss, and all the parameters it has a gradient in.
        parts: slices of the batch.
        threads: that all parts together may take.
    """
    parameters = [parameter for group in groups.values() for parameter in group]

    def work(part: slice) -> tuple[dict[str, Tensor], Gradients]:
        values = compute(part)
        losses = torch.stack([values[name] for name in groups])
        gradients = gradients_of([losses.sum()], parameters)
        return {name: value.detach() for name, value in values.items()}, gradients

    pool = thread_pool(len(parts), max(1, threads // len(parts)))
    running = [pool.submit(work, part) for part in parts]
    wait(running)  # where one fails nothing of the others goes on
    (values, gradients), *others = (future.result() for future in running)
    for more_values, more_gradients in others:
        values = {name: value + more_values[name] for name, value in values.items()}
        pairs = zip(gradients, more_gradients, strict=True)
        gradients = tuple(a if b is None else b if a is None else a + b for a, b in pairs)
    return values | with_gradients({name: values[name] for name in groups}, groups, gradients)


def with_gradients(
    losses: dict[str, Tensor], groups: dict[str, list[nn.Parameter]], gradients: Gradients
) -> dict[str, Tensor]:
    """Return losses whose backward pass gives gradients that are known already.

    Args:
        losses: scalars.
        groups: name of each loss, and all the parameters it has a gradient in.
        gradients: of all groups' parameters, one group's behind the other's; None for none.
    """
    parameters = [parameter for group in groups.values() for parameter in group]
    known = _Known.apply([losses[name] for name in groups], list(map(len, groups.values())), gradients, *parameters)
    return dict(zip(groups, known, strict=True))


@functools.cache
def thread_pool(workers: int, threads: int) -> ThreadPoolExecutor:
    """Return workers each of which lets torch use so many threads for an operation."""

    def begin() -> None:
        torch.set_num_threads(threads)

    return ThreadPoolExecutor(workers, "losses", begin)


# A forked process has none of its parent's threads.
os.register_at_fork(after_in_child=thread_pool.cache_clear)


class _Known(torch.autograd.Function):
    """Losses whose gradients are known."""

    @staticmethod
    def forward(
        ctx: Any, losses: list[Tensor], sizes: list[int], gradients: Gradients, *_: nn.Parameter
    ) -> tuple[Tensor, ...]:
        ctx.sizes, ctx.gradients = sizes, gradients
        ctx.set_materialize_grads(False)  # a loss that nobody differentiates leaves no gradients
        return tuple(losses)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor | None) -> tuple[Tensor | None, ...]:
        each = (slope for slope, size in zip(slopes, ctx.sizes, strict=True) for _ in range(size))
        pairs = zip(ctx.gradients, each, strict=True)
        return None, None, None, *(None if a is None or slope is None else a * slope for a, slope in pairs)
