"""Pages on ``conf/``: every verb, group, file and key, with the comments that stand there."""

import re
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path
from typing import Any

import yaml

from rcdsac_trl.config.paths import CONF_DIR
from rcdsac_trl.config.verb_help import Explained, explained_defaults, explained_keys
from rcdsac_trl.config.verbs import VERBS


def pages(conf: Path = CONF_DIR) -> dict[str, str]:
    """Return each page's Markdown by its name: one on the root configs, one a group, and one that lists the groups.

    Args:
        conf: a folder such as ``conf/``.
    """
    groups = sorted({path.parent.relative_to(conf).as_posix() for path in conf.rglob("*.yaml")} - {"."})
    names = {group: f"conf-{group.replace('/', '-')}" for group in groups}
    index = [
        "# Configuration\n",
        "Every group of `conf/`, chosen by `<group>=<name>`, and what each of its files sets.",
        "The [commands](commands.md) have keys of their own.\n",
        *(f"- [`{group}`]({name}.md)" for group, name in names.items()),
        "\n```{toctree}\n:hidden:\n",
        *names.values(),
        "```\n",
    ]
    return {
        "reference/commands": _page("# Commands", sorted(conf.glob("*.yaml"))),
        "reference/configuration": "\n".join(index),
        **{
            f"reference/{name}": _page(f"# {group}", sorted((conf / group).glob("*.yaml")))
            for group, name in names.items()
        },
    }


def _page(title: str, paths: list[Path]) -> str:
    return "\n".join([title, *(line for path in paths for line in _section(path))]) + "\n"


def _section(path: Path) -> Iterator[str]:
    """Yield what one file says."""
    yield f"\n## {path.stem}\n"
    if path.parent == CONF_DIR and path.stem in VERBS:
        verb = VERBS[path.stem]
        yield f"{_escaped(verb.does[0].upper() + verb.does[1:])}.\n"
        for call, does in verb.examples.items():
            yield f"- `rcdsac-trl {path.stem} {call}`: {_escaped(does)}"
        yield ""
    text = path.read_text("utf-8")
    if head := _head(text):
        yield f"{_escaped(head)}\n"
    values = yaml.safe_load(text) or {}
    if parents := [f"`{name}`" for name in values.get("defaults", []) if isinstance(name, str) and name != "_self_"]:
        yield f"What is not said here is as in {', '.join(parents)}.\n"
    if values:
        yield from _table(("group", "takes", "what it chooses"), explained_defaults(path))
        # Of Hydra's own keys those matter that somebody found worth a comment.
        keys = (key for key in explained_keys(path) if key.comment or key.name.split(".")[0] != "hydra")
        yield from _table(("key", "value", "meaning"), keys)


def _head(text: str) -> str:
    """Return the comment that a file begins with, if it is not that of its first key."""
    lines = text.removeprefix("# @package _global_\n").splitlines()
    comment = list(takewhile(lambda line: line.startswith("#"), lines))
    is_of_file = [*lines, ""][len(comment)] in ("", "defaults:")
    return " ".join(line.removeprefix("#").strip() for line in comment) if is_of_file else ""


def _table(head: tuple[str, str, str], rows: Iterator[Explained]) -> Iterator[str]:
    lines = [f"| `{row.name}` | {_shown(row.value)} | {_escaped(row.comment)} |" for row in rows]
    if lines:
        yield from (f"| {' | '.join(head)} |", "|---|---|---|", *lines, "")


def _shown(value: Any) -> str:
    """Write a value as the command line takes it; of a section nothing, as its keys follow."""
    if isinstance(value, dict) and value:
        return ""
    text = yaml.safe_dump(value, default_flow_style=True, width=1000).removesuffix("...\n").strip()
    return f"`{text}`".replace("|", r"\|")


def _escaped(comment: str) -> str:
    """Return a comment of which Markdown takes nothing but code for a mark.

    Example:
        >>> _escaped("[tb4] a * b, `a_b`, a_b; a|b")
        '\\\\[tb4\\\\] a \\\\* b, `a_b`, a\\\\_b; a\\\\|b'
    """
    parts = comment.split("`")
    marked = (re.sub(r"([\\*_<>\[\]{}$#~])", r"\\\1", part) if i % 2 == 0 else part for i, part in enumerate(parts))
    return "`".join(marked).replace("|", r"\|")
