"""Modules of float32 on the CPU, whatever a program has made torch's defaults."""

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
from torch import nn

Made = TypeVar("Made", bound=type[nn.Module])


@contextmanager
def float32_on_cpu() -> Iterator[None]:
    """Within it, torch makes tensors of float32 on the CPU where nothing else is asked for."""
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        with torch.device("cpu"):
            yield
    finally:
        torch.set_default_dtype(default)


def made_in_float32(cls: Made) -> Made:
    """Have the instances of a module class made within :func:`float32_on_cpu`.

    The environment, the replay and the compiled layers hold float32 on the CPU. Whoever wants a network of another type
    or on another device moves it, by :meth:`torch.nn.Module.to`.

    Example:
        >>> @made_in_float32
        ... class Layer(nn.Linear):
        ...     pass
        >>> torch.set_default_dtype(torch.float64)
        >>> Layer(2, 3).weight.dtype
        torch.float32
        >>> torch.set_default_dtype(torch.float32)
    """
    original: Callable[..., None] = cls.__init__

    @functools.wraps(original)
    def made(self: nn.Module, *arguments: Any, **named: Any) -> None:
        with float32_on_cpu():
            original(self, *arguments, **named)

    cls.__init__ = made  # type: ignore[method-assign]
    return cls
