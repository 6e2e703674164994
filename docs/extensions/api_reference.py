"""Pages on the public modules, from their docstrings, and what Sphinx has to be told of how these are written."""

import inspect
from itertools import groupby
from typing import Any

from sphinx.application import Sphinx
from sphinx.util.inspect import stringify_signature

from rcdsac_trl.robot.robot_settings import PAPER

_PAGES = {
    "package": ("The package", ["rcdsac_trl", "rcdsac_trl.errors"]),
    "deploy": ("Deployment", ["rcdsac_trl.deploy"]),
    "environment": (
        "Environment",
        [
            "rcdsac_trl.world.task.env",
            "rcdsac_trl.world.task.gymnasium_env",
            "rcdsac_trl.world.task.world_settings",
            "rcdsac_trl.world.task.rules",
            "rcdsac_trl.world.maps.generator",
            "rcdsac_trl.robot.robot_settings",
        ],
    ),
    "learner": (
        "Agent and loss",
        [
            "rcdsac_trl.agent.risk",
            "rcdsac_trl.agent.network_settings",
            "rcdsac_trl.agent.networks",
            "rcdsac_trl.agent.heads",
            "rcdsac_trl.agent.actor",
            "rcdsac_trl.agent.loss.loss_settings",
            "rcdsac_trl.agent.loss.distributional_sac",
            "rcdsac_trl.agent.loss.functional",
        ],
    ),
    "controllers": (
        "Planners",
        [
            "rcdsac_trl.rollout.planners.controller",
            "rcdsac_trl.rollout.planners.pursuit",
            "rcdsac_trl.rollout.planners.dwa",
            "rcdsac_trl.rollout.planners.mppi",
            "rcdsac_trl.rollout.planners.trajectory_costs",
        ],
    ),
}
PAGES = [f"reference/{name}" for name in _PAGES]


def pages() -> dict[str, str]:
    """Return each page's Markdown by its name."""
    return {f"reference/{name}": _page(title, modules) for name, (title, modules) in _PAGES.items()}


def _page(title: str, modules: list[str]) -> str:
    parts = [f"## {name}\n\n```{{eval-rst}}\n.. automodule:: {name}\n```\n" for name in modules]
    return "\n".join([f"# {title}\n", *parts])


def tables_of_markdown(lines: list[str]) -> list[str]:
    """Return a docstring's lines with its Markdown tables, which docstrings of ours have, as Sphinx reads tables.

    Example:
        >>> tables_of_markdown(["| a | b |", "|---|---|", "| `1` | |"])[3:]
        ['', '   * - a', '     - b', '   * - `1`', '     - ', '']
    """
    written: list[str] = []
    for is_table, block in groupby(lines, key=lambda line: line.startswith("|")):
        if not is_table:
            written += block
            continue
        head, _, *rows = block
        written += [".. list-table::", "   :header-rows: 1", "   :widths: auto", ""]
        for row in (head, *rows):
            first, *others = (cell.strip() for cell in row.strip("|").split("|"))
            written += [f"   * - {first}", *(f"     - {cell}" for cell in others)]
        written.append("")
    return written


def short_signature(thing: Any, signature: str | None) -> str | None:
    """Return a signature with a class's own parameters, not its metaclass's, and the paper's robot by its name.

    Example:
        >>> from rcdsac_trl.world.task.env import NavigationEnv
        >>> short_signature(NavigationEnv, "(*args, **kwargs)").partition(", ")[0]
        '(world: ~rcdsac_trl.world.task.world_settings.WorldSettings | None = None'
    """
    unknown = "(*args, **kwargs)"
    if inspect.isclass(thing) and signature == unknown:
        own = inspect.signature(thing.__init__)
        own = own.replace(parameters=list(own.parameters.values())[1:], return_annotation=own.empty)
        signature = stringify_signature(own, unqualified_typehints=True).replace(unknown, "")
    return signature and signature.replace(repr(PAPER), "PAPER")


def _adapt(app: Sphinx, what: str, name: str, thing: object, options: Any, lines: list[str]) -> None:
    lines[:] = tables_of_markdown(lines)


def _shorten(
    app: Sphinx, what: str, name: str, thing: object, options: Any, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    return short_signature(thing, signature), returns


def setup(app: Sphinx) -> dict[str, bool]:
    """Have Sphinx call what stands above."""
    app.connect("autodoc-process-docstring", _adapt)
    app.connect("autodoc-process-signature", _shorten)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
