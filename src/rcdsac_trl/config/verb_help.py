"""What ``--help`` says of a verb: its table entry, and keys and groups with the comments of ``conf/``."""

import shutil
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf

from rcdsac_trl.config.compose import choices, compose, offered
from rcdsac_trl.config.paths import CONF_DIR
from rcdsac_trl.config.verbs import VERBS

_WIDEST = 110
_INDENT = " " * 6


@dataclass(frozen=True)
class Explained:
    """A key of a file of ``conf/``, or a group of its defaults, with the comment above it.

    Attributes:
        name: the key in full; of a section too.
        value: as the file has it.
        comment: on one line; may be empty.
    """

    name: str
    value: Any
    comment: str


def verb_help(verb: str, overrides: Sequence[str] = ()) -> str:
    """Return what ``--help`` prints.

    Args:
        verb: one of :data:`~rcdsac_trl.config.verbs.VERBS`.
        overrides: of the command line; the values that are shown are those with them.

    Raises:
        UserInputError: for overrides that Hydra refuses.
    """
    described, path = VERBS[verb], CONF_DIR / f"{verb}.yaml"
    lines = [f"rcdsac-trl {verb}: {described.does}.", "", "Examples:"]
    for example, does in described.examples.items():
        lines += [f"  rcdsac-trl {verb} {example}", f"{_INDENT}{does}"]
    own = (Explained(name, None, comment) for name, comment in described.groups.items())
    groups = [line for group in own for line in _groups(verb, [group])]
    groups += _groups_of(path)
    if groups:
        lines += ["", "Groups, chosen by <group>=<name>:", *groups]
    for root, when in described.more_roots.items():
        if more := _groups_of(CONF_DIR / f"{root}.yaml"):
            lines += ["", f"Groups {when}:", *more]
    lines += ["", "Keys, set by <key>=<value>:", *_keys(verb, overrides)]
    lines += ["", f"All of it: {path}; --cfg job prints every value. Options of Hydra: --hydra-help."]
    return "\n".join(lines)


def list_of_verbs() -> str:
    """Return every verb with a line."""
    width = max(map(len, VERBS))
    lines = [f"  {name:{width}}  {verb.does}" for name, verb in VERBS.items()]
    return "\n".join(
        [
            "rcdsac-trl <verb> key=value ..",
            "",
            *lines,
            "",
            "rcdsac-trl <verb> --help explains one, rcdsac-trl --version says which version this is.",
        ]
    )


def _groups_of(path: Path) -> list[str]:
    found = [explained for explained in explained_defaults(path) if choices(explained.name)]
    alike = groupby(found, key=lambda group: group.comment)
    return [line for _, groups in alike for line in _groups(path.stem, list(groups))]


def _groups(root: str, groups: Sequence[Explained]) -> Iterator[str]:
    """Yield what there is to choose in groups that share a comment, and the comment."""
    for group in groups:
        options = offered(root, group.name.lstrip("+"))
        named = [f"{option} (default)" if option == group.value else option for option in options]
        yield from _wrapped(f"{group.name}: {', '.join(named)}", "  ", _INDENT)
    yield from _wrapped(groups[0].comment, _INDENT, _INDENT)


def _keys(verb: str, overrides: Sequence[str]) -> Iterator[str]:
    wanted, hidden = VERBS[verb].keys, []
    composed = compose(verb, list(overrides))
    for explained in explained_keys(CONF_DIR / f"{verb}.yaml"):
        is_section = isinstance(explained.value, dict)
        section = explained.name.split(".")[0]
        is_wanted = explained.name in wanted or section in wanted
        if is_section:
            if explained.name == section and section != "hydra" and not any(key.startswith(section) for key in wanted):
                hidden.append(section)
        elif is_wanted or explained.name == section:
            yield from _wrapped(f"{explained.name}={_shown(composed, explained)}", "  ", _INDENT)
            yield from _wrapped(explained.comment, _INDENT, _INDENT)
    if hidden:
        yield from _wrapped(f"and in sections: {', '.join(f'{name}.*' for name in hidden)}", "  ", _INDENT)


def _shown(composed: Any, explained: Explained) -> str:
    """Write a value as the command line takes it."""
    value: Any = explained.value
    if not explained.name.startswith("hydra."):  # Hydra's own part is left out of what is composed
        value = OmegaConf.to_container(composed, resolve=False)
        for part in explained.name.split("."):
            value = value[part]
    return yaml.safe_dump(value, default_flow_style=True, width=1000).removesuffix("...\n").strip()


def _wrapped(text: str, first: str, others: str) -> list[str]:
    width = min(shutil.get_terminal_size((100, 24)).columns, _WIDEST)
    return textwrap.wrap(
        text, width, initial_indent=first, subsequent_indent=others, break_long_words=False, break_on_hyphens=False
    )


# ---------------------------------------------------------------------------------------------- comments
def explained_keys(path: Path) -> Iterator[Explained]:
    """Yield every key of a file but its defaults, sections before what is in them."""
    text = path.read_text(encoding="utf-8")
    root = yaml.compose(text)
    assert isinstance(root, yaml.MappingNode)
    values = yaml.safe_load(text)
    lines = text.splitlines()

    def below(node: yaml.MappingNode, prefix: str, values: Any) -> Iterator[Explained]:
        for key, value in node.value:
            name = f"{prefix}{key.value}"
            yield Explained(name, values[key.value], _comment_above(lines, key.start_mark.line))
            if isinstance(value, yaml.MappingNode):
                yield from below(value, f"{name}.", values[key.value])

    yield from (found for found in below(root, "", values) if found.name != "defaults")


def explained_defaults(path: Path) -> Iterator[Explained]:
    """Yield every group of a root's defaults with the option it takes."""
    text = path.read_text(encoding="utf-8")
    root = yaml.compose(text)
    assert isinstance(root, yaml.MappingNode)
    lines = text.splitlines()
    comment = ""
    for entry in next((value.value for key, value in root.value if key.value == "defaults"), []):
        if isinstance(entry, yaml.MappingNode):
            ((key, value),) = entry.value
            # Groups that stand together share the comment above the first.
            comment = _comment_above(lines, entry.start_mark.line) or comment
            yield Explained(key.value, value.value, comment)


def _comment_above(lines: Sequence[str], line: int) -> str:
    found: list[str] = []
    while line > 0 and (above := lines[line - 1].strip()).startswith("#"):
        found.insert(0, above.removeprefix("#").strip())
        line -= 1
    return " ".join(found)
