"""Where trained agents lie that are called by a name: in the package or its checkout, or in a folder of the user's."""

import difflib
import os
from collections.abc import Iterator
from pathlib import Path

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.invocation import from_here, program

CONFIG_NAME = "config.json"
"""What makes a folder a weights folder."""
WEIGHTS_VARIABLE = "RCDSAC_TRL_WEIGHTS"
"""Environment variable that names a folder of agents, which comes before the package's own."""
HANDFUL = ("rcdsac_pow-narrow", "rcdsac_cvar-narrow", "sac-narrow")
"""What the wheel carries, as ``pyproject.toml`` says."""
TABLE_ROWS = (
    "rcdsac_cvar",
    "rcdsac_pow",
    "rcdsac_cvar_stored",
    "rcdsac_pow_stored",
    "dsac_cvar_0.25",
    "dsac_cvar_0.75",
    "dsac_pow_-2",
    "dsac_pow_-1",
    "rcwr",
    "sac",
)
"""The agents of the paper's table, as ``conf/experiment/table.yaml`` names their runs."""
TABLE_SENSORS = ("narrow", "sparse")

_PACKAGE = Path(__file__).resolve().parents[2]
# The wheel carries some inside the package; a checkout keeps all of them beside src/, where people look for them.
_OWN_PLACES = (_PACKAGE / "weights", _PACKAGE.parents[1] / "weights")


def agent_name(row: str, fixed_beta: float | None, sensor: str, robot: str | None = None) -> str:
    """Return what an agent is called that is published.

    Args:
        row: of the paper's table.
        fixed_beta: the one beta it was trained for; None for a range, or for none.
        sensor: it was trained with.
        robot: it drives, unless that is the paper's.

    Example:
        >>> agent_name("dsac_pow", -2.0, "narrow"), agent_name("sac", None, "sparse", "jackal")
        ('dsac_pow_-2-narrow', 'sac-sparse-jackal')
    """
    told = "" if fixed_beta is None else f"_{fixed_beta:g}"
    return "-".join([f"{row}{told}", sensor, *([] if robot is None else [robot])])


def table_names() -> list[str]:
    """Return the names of all agents of the paper's table, whether they are there or not."""
    return [f"{row}-{sensor}" for row in TABLE_ROWS for sensor in TABLE_SENSORS]


def rebuilding_command(name: str) -> str:
    """Return the command that trains and evaluates an agent of the table.

    Example:
        >>> rebuilding_command("sac-sparse")
        'python -m rcdsac_trl.train -m +experiment=table preset=laptop sensor=sparse seed=0 experiment.only=[sac]'
    """
    row, _, sensor = name.rpartition("-")
    chosen = f"preset=laptop sensor={sensor} seed=0 experiment.only=[{row}]"
    return f"python -m rcdsac_trl.train -m +experiment=table {chosen}"


def places() -> tuple[Path, ...]:
    """Return the folders in which agents are looked for by name, in this order.

    Raises:
        UserInputError: if the environment names a folder that is none.
    """
    own = tuple(place for place in _OWN_PLACES if place.is_dir())
    if not (named := os.environ.get(WEIGHTS_VARIABLE)):
        return own
    if not os.path.isdir(named):
        raise UserInputError(
            f"{WEIGHTS_VARIABLE}={named} is no folder: let it name one that holds a folder for each agent, or unset it"
        )
    return (Path(named), *own)


def shipped_agents() -> dict[str, Path]:
    """Return the folders of all agents that are called by a name, in the order of the names.

    Where two places have one of a name, it is that of the first.

    Raises:
        UserInputError: as :func:`places`.
    """
    found = {name: folder for place in reversed(places()) for name, folder in _agents_in(place)}
    return dict(sorted(found.items()))


def _agents_in(place: Path) -> Iterator[tuple[str, Path]]:
    for config in place.glob(f"*/{CONFIG_NAME}"):
        yield config.parent.name, config.parent


def shipped_names() -> list[str]:
    """List the agents that are called by a name: those that come with the package, and of the user's folder.

    Raises:
        UserInputError: as :func:`places`.
    """
    return list(shipped_agents())


def is_shipped(folder: Path) -> bool:
    """Tell whether a folder is that of an agent that is called by its name."""
    return folder.resolve().parent in [place.resolve() for place in places()]


def find_weights(name_or_folder: str | Path, *, takes_runs: bool = True) -> Path:
    """Return the weights folder of that path, or of the agent of that name.

    Args:
        name_or_folder: what was typed.
        takes_runs: whether whoever asks would take a run folder, too, so that one is worth offering.

    Raises:
        UserInputError: if there is neither; the sentence says what was probably meant, and how to get it.
    """
    folder = Path(name_or_folder)
    if os.path.isfile(folder / CONFIG_NAME):  # false for a name that is too long, too
        return folder
    agents = shipped_agents()
    if (name := str(name_or_folder)) in agents:
        return agents[name]
    folders = "a run folder, or one that `export` wrote" if takes_runs else "a folder that `export` wrote"
    others = f"`{program()} agents` lists what there is; or name {folders}"
    if os.path.isdir(folder):
        lacks = f"neither checkpoints nor {CONFIG_NAME}" if takes_runs else f"no {CONFIG_NAME}"
        raise UserInputError(f"{folder} holds {lacks}: {others}")
    if name in table_names():
        looked = ", ".join(from_here(place) for place in places()) or "no folder"
        raise UserInputError(
            f"agent {name} is not here (looked into {looked}): let {WEIGHTS_VARIABLE} name the folder weights/ of a "
            f"checkout that has it, or train it, {rebuilding_command(name)}"
        )
    near = nearest_agent(name)
    meant = "" if near is None else f"did you mean {near}? "
    raise UserInputError(f"there is no agent {name!r}: {meant}{others}")


def nearest_agent(typed: str) -> str | None:
    """Return the agent that was probably meant; None where none is like it.

    What begins as it was typed comes before what is spelt alike, one that is here before one that would have to be
    trained, and the paper's first sensor, narrow, before others.

    Raises:
        UserInputError: as :func:`places`.
    """
    here = shipped_names()
    for names in (here, table_names()):
        if typed and (begun := [name for name in names if name.startswith(typed)]):
            return min(begun, key=lambda name: (not name.endswith(f"-{TABLE_SENSORS[0]}"), len(name)))
    near = [match for names in (here, sorted(table_names())) for match in difflib.get_close_matches(typed, names, n=1)]
    return near[0] if near else None
