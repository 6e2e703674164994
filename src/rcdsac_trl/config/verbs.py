"""The verbs of the command line: the one table that the list of verbs, their help and the tests are made from."""

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec

from rcdsac_trl.errors import UserInputError


@dataclass(frozen=True)
class Verb:
    """What ``--help`` says of a verb beside what its root config in ``conf/`` explains.

    Attributes:
        does: one line.
        examples: what to write behind the verb, and what that does; three of them.
        keys: keys in sections, or whole sections, that are shown; those at the root always are.
        groups: groups to choose from that the root's defaults lack, as they are written, and what they choose.
        more_roots: other root configs whose groups the verb takes, and when.
    """

    does: str
    examples: Mapping[str, str]
    keys: tuple[str, ...] = ()
    groups: Mapping[str, str] = field(default_factory=dict)
    more_roots: Mapping[str, str] = field(default_factory=dict)


_ROW = {
    "+algo": "The row of the paper's table, which must be chosen.",
    "algo/distortion": "Another risk measure for a row with quantile critics.",
}

VERBS = {
    "play": Verb(
        does="drive an agent on a page in a browser, and turn beta while it drives",
        examples={
            "port=5008": "shipped agents, nothing to train; on another port than 5006",
            "run=runs/<folder>": "yours, beside the shipped ones",
            "browser=false port=5007": "on another machine: ssh -L 5007:localhost:5007",
        },
    ),
    "train": Verb(
        does="train an agent into a new run folder, or continue a run",
        examples={
            "+algo=rcdsac_pow": "RC-DSAC with the power law: about 25 minutes on two cores",
            "+algo=rcdsac_cvar sensor=sparse map=hard seed=1": "another measure, sensor, map set and seed",
            "resume=runs/<folder>": "go on where a run ended early",
        },
        keys=(
            "schedule.iterations",
            "schedule.updates_per_iteration",
            "world.num_agents",
            "validation.every_iterations",
            "checkpoint.every_iterations",
            "hydra.run.dir",
        ),
        groups=_ROW,
        more_roots={"sweep": "with -m, several trainings in one folder"},
    ),
    "evaluate": Verb(
        does="measure an agent, or a hand-written controller, on unseen maps",
        examples={
            "run=runs/<folder>": "a run, at the values of beta of its row",
            "run=rcdsac_cvar-narrow beta=[0.25,1] map=hard": "a shipped agent, on another map set",
            "baseline=mppi num_maps=10": "a classical planner, on fewer maps",
        },
        keys=("acting",),
    ),
    "report": Verb(
        does="compare evaluations: the paper's tables and claims, statistics and figures",
        examples={
            "runs=[runs/<a>,runs/<b>]": "two runs, with all that was evaluated of them",
            "runs=[runs/<a>,evaluation/<baseline>] out=mine": "a run against a baseline, into the folder `mine`",
            "runs=[results,results/seed-1,results/seed-2]": "all trainings of the paper's rows, in a checkout",
        },
    ),
    "plot_training": Verb(
        does="draw the learning curve of a run, also while it trains",
        examples={
            "run=runs/<folder>": "into the run folder",
            "run=runs/<folder> out=curve.png": "into a file of yours",
            "run=results/rcdsac_pow-narrow out=curve.png": "of a shipped agent, in a checkout",
        },
    ),
    "calibrate": Verb(
        does="hold the quantiles that critics predict against returns really earned",
        examples={
            "run=runs/<folder>": "at the values of beta of its row",
            "run=runs/<folder> as_driven=true split=validation": "as it acts: `publish` recalibrates by it",
            "run=runs/<folder> cross_evaluate=true num_maps=80 num_states=1 num_rollouts=32": "is each beta's policy "
            "the best by its own measure?",
        },
        keys=("acting",),
    ),
    "draw_maps": Verb(
        does="draw maps with their waypoints",
        examples={
            "map=hard count=8 out=hard.png": "eight maps of a set",
            "split=evaluation seed=1": "maps that are never trained on",
            "map=file map.path=<building.yaml>": "your building",
        },
    ),
    "export": Verb(
        does="write an agent for a robot: weights, ONNX, torch programs",
        examples={
            "run=runs/<folder>": "the best checkpoint of a run",
            "run=runs/<folder> checkpoint=last out=mine": "the last one, into the folder `mine`",
            "run=rcdsac_pow-narrow": "a shipped agent",
        },
    ),
    "replay": Verb(
        does="ask an agent what it would have done over a ROS bag or a CARMEN log",
        examples={
            "drive.mcap beta=-1": "a recording at one beta",
            "drive.mcap run=runs/<folder> waypoints=trajectory": "your agent, along the way that was driven",
            "drive.mcap zero_means=far record=true": "with a film; the scanner says 0 where nothing is near",
        },
    ),
    "course": Verb(
        does="drive agents over the office course with simulated depth cameras",
        examples={
            "run=rcdsac_cvar-narrow beta=[0.25,1]": "a shipped agent at two values of beta",
            "run=runs/<folder> repetitions=1 record=true": "your agent once, with a film",
            "baseline=pursuit": "a controller that sees nothing, alone",
        },
    ),
    "search": Verb(
        does="search hyper-parameters with Optuna",
        examples={
            "+algo=rcdsac_pow search.name=mine": "the space of conf/space/learner.yaml; the same call goes on",
            "+algo=sac search.name=rate space=none 'learner.actor_lr=interval(1e-4,1e-3)'": "one key alone",
            "+algo=rcdsac_cvar search.name=short search.trials=10 schedule.iterations=30": "ten short trials",
        },
        keys=("search",),
        groups=_ROW,
        more_roots={"train": "of what is trained"},
    ),
    "agents": Verb(
        does="list the trained agents that are here, and how they drive",
        examples={
            "sac-narrow": "one of them; without a name, all",
            "format=json": "all that is known of each, for programs",
            "sac-narrow rcwr-narrow format=json": "of these two",
        },
    ),
    "verify": Verb(
        does="measure shipped agents again, and say whether their cards' numbers hold",
        examples={
            "seed=7": "those of the wheel, on maps of your choosing: about 7 minutes on two cores",
            "rcdsac_pow-narrow num_maps=100": "one agent, more surely",
            "sac-narrow seed=0 num_maps=50 num_episodes=5": "on the card's own maps",
        },
    ),
    "publish": Verb(
        does="turn evaluated runs into agents that ship with the package",
        examples={
            "runs=[runs/<a>,runs/<b>]": "two runs, their last checkpoints",
            "runs=[runs/<a>] checkpoint=best": "the best checkpoint",
            "runs=[runs/<a>] weights=mine results=mine": "into a folder of yours",
        },
    ),
}
"""Every verb, in the order in which they are listed."""


def verb_named(name: str) -> str:
    """Return the verb that is meant; ``-`` may stand for ``_``.

    Raises:
        UserInputError: if there is none, with the nearest one.

    Example:
        >>> verb_named("draw-maps")
        'draw_maps'
        >>> verb_named("evalute")
        Traceback (most recent call last):
        rcdsac_trl.errors.UserInputError: there is no verb evalute: did you mean evaluate?
    """
    verb = name.replace("-", "_")
    if verb in VERBS:
        return verb
    nearest = difflib.get_close_matches(verb, VERBS, n=1)
    raise UserInputError(
        f"there is no verb {name}: " + (f"did you mean {nearest[0]}?" if nearest else f"one of {', '.join(VERBS)}")
    )


def module_of(verb: str) -> str:
    """Return the module whose ``main`` does what a verb says.

    Example:
        >>> module_of("train"), module_of("report")
        ('rcdsac_trl.train', 'rcdsac_trl.report.__main__')
    """
    name = f"rcdsac_trl.{verb}"
    spec = find_spec(name)
    assert spec is not None
    return name if spec.submodule_search_locations is None else f"{name}.__main__"
