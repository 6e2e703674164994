"""Configurations become settings: rows, presets, types."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import pytest
from omegaconf import DictConfig, OmegaConf

from rcdsac_trl.config.algo_settings import AlgoSettings, DistortionSettings
from rcdsac_trl.config.chosen_world import chosen_world
from rcdsac_trl.config.compose import choices, compose
from rcdsac_trl.config.conditions import Condition
from rcdsac_trl.config.evaluation_settings import EvaluationSettings
from rcdsac_trl.config.run_config import agent_of_run, read_config, settings_of_run, training_settings
from rcdsac_trl.config.schedule import Schedule
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.config.typed import read
from rcdsac_trl.errors import UserInputError
from tiny import AGENTS, ROWS, TINY, tiny_settings, yaml_of


def composed(*overrides: str) -> TrainingSettings:
    return training_settings(compose("train", list(overrides)))


def leaves(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        name = f"{prefix}.{key}".removeprefix(".")
        if isinstance(value, dict):
            yield from leaves(value, name)
        else:
            yield name, value


# ------------------------------------------------------------------------------------------------ rows
# The paper's table, and the one row beyond it: what each row is made of.
#                      critic      conditioning   relabel     measure    told          beta
PARTS_OF_ROWS = {
    "rcdsac_pow": ("quantile", "per_episode", "resample", "pow", "risk", None),
    "rcdsac_pow_wide": ("quantile", "per_episode", "resample", "pow_wide", "risk", None),
    "rcdsac_cvar": ("quantile", "per_episode", "resample", "cvar", "risk", None),
    "rcdsac_pow_stored": ("quantile", "per_episode", "stored", "pow", "risk", None),
    "rcdsac_cvar_stored": ("quantile", "per_episode", "stored", "cvar", "risk", None),
    "dsac_pow": ("quantile", "fixed", "stored", "pow", None, -1.0),
    "dsac_cvar": ("quantile", "fixed", "stored", "cvar", None, 0.25),
    "rcwr": ("scalar", "none", "stored", "neutral", "collision_weight", None),
    "sac": ("scalar", "none", "stored", "neutral", None, None),
}


def test_there_are_no_rows_but_these() -> None:
    assert set(ROWS) == set(choices("algo")) == set(PARTS_OF_ROWS)


@pytest.mark.parametrize("row", ROWS)
def test_a_row_is_made_of_its_parts(row: str) -> None:
    algo = composed(f"+algo={row}").algo
    parts = (algo.critic, algo.conditioning, algo.relabel, algo.distortion.name, algo.context_key, algo.beta)
    assert parts == PARTS_OF_ROWS[row]
    assert algo.name == row
    assert (algo.network_measure is not None) == (algo.conditioning == "per_episode")


def test_validation_looks_where_the_papers_table_does() -> None:
    def conditions(row: str) -> list[Condition]:
        return composed(f"+algo={row}").algo.default_conditions

    assert [c.beta for c in conditions("rcdsac_pow")] == [-2.0, -1.5, -1.0, -0.5]
    assert [c.beta for c in conditions("rcdsac_cvar")] == [0.25, 0.5, 0.75, 1.0]
    assert [c.collision_weight for c in conditions("rcwr")] == [1.0, 1.5, 2.0]
    assert conditions("dsac_pow") == [Condition(beta=-1.0)]
    assert conditions("sac") == [Condition()]
    assert composed("+algo=rcwr").algo.collision_weight == (0.1, 2.0)


@pytest.mark.parametrize("measure", choices("algo/distortion"))
def test_every_measure_goes_on_top_of_a_row(measure: str) -> None:
    extra = {
        "neutral": ["algo.conditioning=none", "algo.relabel=stored"],
        "var": ["schedule.neutral_iterations=0", "schedule.ramp_iterations=0"],
    }
    settings = composed("+algo=rcdsac_pow", f"algo/distortion={measure}", *extra.get(measure, []))
    assert settings.algo.distortion.name == yaml_of(f"algo/distortion/{measure}.yaml")["name"]
    assert settings.algo.critic == "quantile"


# ------------------------------------------------------------------------------------------------ presets
def test_preset_paper_is_the_papers_table_of_hyper_parameters() -> None:
    settings = composed("+algo=rcdsac_pow", "preset=paper")
    learner, schedule = settings.learner, settings.schedule
    assert (learner.actor_lr, learner.critic_lr, learner.alpha_lr) == (3e-4, 3e-4, 3e-4)
    assert learner.gamma == 0.99
    assert learner.target_coefficient == 0.001
    assert (learner.num_critics, learner.target_over_critics) == (2, "minimum")
    assert learner.target_entropy == -2
    assert (learner.num_quantiles, learner.num_target_quantiles) == (16, 16)
    assert (learner.batch_size, learner.sequence_length, learner.burn_in) == (100, 64, 0)
    assert learner.max_grad_norm is None
    assert (learner.resample_per, learner.fractions_per) == ("transition", "transition")
    assert learner.fraction_sampling == "uniform"
    assert settings.replay.capacity_steps == 5_000_000
    assert (schedule.iterations, schedule.updates_per_iteration) == (500, 200)
    assert (schedule.pursuit_iterations, schedule.neutral_iterations, schedule.ramp_iterations) == (0, 0, 0)
    assert settings.world.num_agents == 10
    assert settings.task.episode_steps == 1000
    assert settings.sensor.name == "narrow"
    # 5 M steps, all of which the replay holds, and 100,000 updates
    assert settings.replay_steps() == 500 * 10 * 1000
    assert all(schedule.distortion_strength(iteration) == 1.0 for iteration in range(500))
    assert all(schedule.learning_rate_share(iteration) == 1.0 for iteration in range(500))
    assert learner.actor_average_decay == 0.0


def test_preset_paper_takes_nothing_that_came_beyond_the_paper() -> None:
    cfg = compose("train", ["+algo=rcdsac_pow", "preset=paper"])
    expected = {
        "learner.kappa": 1.0,
        "learner.n_steps": 1,
        "learner.mirror": False,
        "learner.num_risk_samples": 16,
        "learner.alpha_init": 0.05,  # which the paper does not give
        "network.conv": 32,
        "network.range": 128,
        "network.vector": 32,
        "network.memory": 128,
        "network.head": 128,
        "network.cosines": 64,
        "network.range_code": "paper",
        "network.restart_steps": None,
        "network.look_ahead": False,
        "acting.num_candidates": 1,
        "sensor.memory_s": 0.0,
    }
    assert {key: OmegaConf.select(cfg, key) for key in expected} == expected


def test_preset_paper_is_the_root() -> None:
    cfg = compose("train", ["+algo=rcdsac_pow", "preset=paper"])
    root = {key: value for key, value in yaml_of("train.yaml").items() if key not in ("defaults", "hydra")}
    for key, value in leaves(root):
        assert OmegaConf.select(cfg, key) == value, key


@pytest.mark.parametrize("preset", [name for name in choices("preset") if name != "paper"])
def test_every_value_of_a_preset_takes_effect(preset: str) -> None:
    """The defaults list must name `_self_` first, else the root overrides its presets in silence."""
    values = yaml_of(f"preset/{preset}.yaml")
    values.pop("defaults", None)
    cfg = compose("train", ["+algo=rcdsac_pow", f"preset={preset}"])
    for key, value in leaves(values):
        assert OmegaConf.select(cfg, key) == value, key


def test_laptop_is_the_default_preset_and_changes_something() -> None:
    assert composed("+algo=rcdsac_pow") == composed("+algo=rcdsac_pow", "preset=laptop")
    assert composed("+algo=rcdsac_pow").learner != composed("+algo=rcdsac_pow", "preset=paper").learner


def test_a_long_training_is_the_laptops_but_for_its_length() -> None:
    long, laptop = composed("+algo=rcdsac_cvar", "preset=long"), composed("+algo=rcdsac_cvar", "preset=laptop")
    assert (long.schedule.iterations, long.schedule.decay_iterations) == (400, 275)
    assert replace(long, schedule=laptop.schedule) == laptop


def test_the_command_line_wins_over_the_preset() -> None:
    preset = yaml_of("preset/laptop.yaml")["schedule"]
    assert preset["iterations"] != 7
    assert composed("+algo=rcdsac_pow", "schedule.iterations=7").schedule.iterations == 7


@pytest.mark.parametrize("group", ["map", "sensor", "task", "collector", "preset"])
def test_every_choice_of_a_group_is_readable(group: str) -> None:
    more = {"file": ["map.path=building.yaml"]}
    for name in choices(group):
        if name != "barn":  # which no training takes
            composed("+algo=rcdsac_pow", f"{group}={name}", *more.get(name, []))


# ------------------------------------------------------------------------------------------------ worlds
def test_an_evaluation_that_changes_nothing_drives_where_its_agent_was_trained() -> None:
    trained = tiny_settings("rcdsac_pow", "robot=turtlebot4", "sensor.memory_s=3", "task.range_noise_std_m=0.1")
    chosen = chosen_world(trained, "an agent", maps=None, sensor=None, task=None, robot=None)
    assert chosen.world_for(7) == trained.world_for(7)
    assert trained.world_for(AGENTS) == replace(trained.training_world, num_workers=0, worker_timeout_s=None)


# ------------------------------------------------------------------------------------------------ schedule
@pytest.mark.parametrize(
    ("neutral", "ramp", "strengths"),
    [
        (0, 0, [1, 1, 1, 1]),
        (2, 0, [0, 0, 1, 1]),
        (0, 4, [0.25, 0.5, 0.75, 1, 1, 1]),
        (2, 3, [0, 0, 1 / 3, 2 / 3, 1, 1]),
        (1, 1, [0, 1, 1]),
    ],
)
def test_distortion_strength_by_hand(neutral: int, ramp: int, strengths: list[float]) -> None:
    schedule = Schedule(
        iterations=10,
        updates_per_iteration=0,
        pursuit_iterations=0,
        pursuit_noise=0.0,
        neutral_iterations=neutral,
        ramp_iterations=ramp,
        decay_iterations=0,
        final_learning_rate_share=0.1,
    )
    assert [schedule.distortion_strength(i) for i in range(len(strengths))] == pytest.approx(strengths)


@pytest.mark.parametrize(
    ("iterations", "decay", "shares"),
    [(3, 0, [1, 1, 1]), (4, 2, [1, 1, 0.6, 0.2]), (4, 4, [0.8, 0.6, 0.4, 0.2]), (2, 4, [0.4, 0.2]), (2, 1, [1, 0.2])],
)
def test_learning_rate_share_by_hand(iterations: int, decay: int, shares: list[float]) -> None:
    schedule = Schedule(
        iterations=iterations,
        updates_per_iteration=0,
        pursuit_iterations=0,
        pursuit_noise=0.0,
        neutral_iterations=0,
        ramp_iterations=0,
        decay_iterations=decay,
        final_learning_rate_share=0.2,
    )
    assert [schedule.learning_rate_share(i) for i in range(iterations)] == pytest.approx(shares)


# ------------------------------------------------------------------------------------------------ types
@dataclass(frozen=True)
class Inner:
    low: float
    names: tuple[str, ...] = ("a",)


@dataclass(frozen=True)
class Outer:
    count: int
    share: float
    on: bool
    title: str
    kind: Literal["x", "y"]
    limits: tuple[float, float]
    cores: int | Literal["auto"]
    perhaps: float | None
    inner: Inner
    other: Inner | None = None


GOOD: dict[str, Any] = {
    "count": 3,
    "share": 0.5,
    "on": True,
    "title": "t",
    "kind": "x",
    "limits": [1, 2.5],
    "cores": "auto",
    "perhaps": None,
    "inner": {"low": 1},
}


def test_read_makes_nested_settings_with_tuples() -> None:
    outer = read(Outer, GOOD)
    assert outer.limits == (1, 2.5)
    assert outer.inner == Inner(low=1)
    assert outer.other is None
    changed = read(Outer, GOOD | {"cores": 4, "perhaps": 1, "other": {"low": 0.5, "names": ["b", "c"]}})
    assert changed.other == Inner(low=0.5, names=("b", "c"))
    assert (changed.cores, changed.perhaps) == (4, 1)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"count": 1.5}, "top.count=1.5 must be a whole number"),
        ({"count": 2.0}, "top.count=2.0 must be a whole number"),
        ({"count": True}, "top.count=True must be a whole number"),
        ({"count": "3"}, "top.count=3 must be a whole number"),
        ({"count": None}, "top.count=null must be a whole number"),
        ({"share": "much"}, "top.share=much must be a number"),
        ({"share": False}, "top.share=False must be a number"),
        ({"share": float("nan")}, "top.share=nan must be a number"),
        ({"share": float("inf")}, "top.share=inf must be a number"),
        ({"on": 1}, "top.on=1 must be true or false"),
        ({"title": 7}, "top.title=7 must be text; as a text: 'top.title=\"7\"'"),
        ({"kind": "z"}, "top.kind=z must be one of x, y"),
        ({"limits": [1]}, "top.limits=[1] must be a list of 2 numbers in brackets"),
        ({"limits": [1, "b"]}, "top.limits=[1, 'b'] must be a list of 2 numbers in brackets"),
        ({"limits": "12"}, "top.limits=12 must be a list of 2 numbers in brackets"),
        ({"cores": "all"}, "top.cores=all must be a whole number or auto"),
        ({"perhaps": "no"}, "top.perhaps=no must be a number or null"),
        ({"inner": 3}, "top.inner=3 must be a section with keys of its own"),
        ({"inner": {"low": 1, "names": "a"}}, "top.inner.names=a must be a list of words in brackets"),
        ({"inner": {"low": 1, "lwo": 2}}, "there is no key top.inner.lwo: did you mean top.inner.low?"),
        ({"inner": {}}, "top.inner.low is missing: give it a value"),
    ],
)
def test_read_refuses_in_one_sentence(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(UserInputError) as caught:
        read(Outer, GOOD | changes, "top")
    assert str(caught.value) == sentence


@pytest.mark.parametrize("root", ["train", "evaluate"])
def test_every_leaf_of_the_root_is_a_field(root: str) -> None:
    """What is written in the root file lands in the settings, where `test_dead_keys` sees it read."""
    settings: Any
    if root == "train":
        settings = training_settings(compose("train", ["+algo=rcdsac_pow", "preset=paper"]))
    else:
        settings = read_config(compose("evaluate", ["baseline=pursuit"]), EvaluationSettings)
    values = {k: v for k, v in yaml_of(f"{root}.yaml").items() if k not in ("defaults", "hydra")}
    found = list(leaves(values))
    assert len(found) > 10
    for key, value in found:
        node = settings
        for part in key.split("."):
            node = getattr(node, part)
        assert node == ("pursuit" if key == "baseline" else value), key


def test_the_sections_of_a_run_folder_read_back_the_same(tiny_run: Path) -> None:
    saved = OmegaConf.load(tiny_run / "config.yaml")
    assert isinstance(saved, DictConfig)
    assert training_settings(saved) == tiny_settings("rcdsac_pow", "logger=default")


# ------------------------------------------------------------------------------------------------ what does not fit
def algo(**changes: Any) -> AlgoSettings:
    parts: dict[str, Any] = {
        "name": "row",
        "critic": "quantile",
        "conditioning": "per_episode",
        "relabel": "resample",
        "beta": None,
        "collision_weight": None,
        "evaluation_collision_weights": (),
        "distortion": DistortionSettings("pow", -2.0, 0.0, (-2.0, -1.0)),
    }
    return AlgoSettings(**parts | changes)


NEUTRAL = DistortionSettings("neutral", 0.0, 0.0, ())
WEIGHTED = {
    "critic": "scalar",
    "conditioning": "none",
    "relabel": "stored",
    "distortion": NEUTRAL,
    "collision_weight": (0.1, 2.0),
    "evaluation_collision_weights": (1.0, 2.0),
}


@pytest.mark.parametrize(
    ("changes", "fragment"),
    [
        ({"distortion": NEUTRAL}, "algo.conditioning=per_episode does not go with algo/distortion=neutral"),
        ({"conditioning": "none", "relabel": "stored"}, "algo.conditioning=none does not go with algo/distortion=pow"),
        ({"critic": "scalar"}, "algo.critic=scalar knows only the mean"),
        ({"conditioning": "fixed", "relabel": "stored"}, "fixed needs one beta"),
        ({"conditioning": "fixed", "relabel": "stored", "beta": -2.5}, "beta = -2.5 is outside the domain [-2, 0]"),
        ({"conditioning": "fixed", "beta": -1.0}, "algo.relabel=resample does nothing"),
        (WEIGHTED | {"collision_weight": (2.0, 0.1)}, "algo.collision_weight=[2.0,0.1] is no range"),
        (WEIGHTED | {"collision_weight": None}, "algo.collision_weight=None: nobody is told a weight, so give []"),
        (WEIGHTED | {"collision_weight": (2.0, 2.0)}, "[2.0, 2.0]: nobody is told a weight, so give []"),
        (WEIGHTED | {"evaluation_collision_weights": ()}, "give some of the range"),
        (WEIGHTED | {"collision_weight": (1.0, 1e39)}, "is no range: give [low,high] with 0 <= low <= high <= 1000"),
        (WEIGHTED | {"evaluation_collision_weights": (3.0,)}, "collision weight 3 is outside row's range [0.1, 2]"),
        (
            {"collision_weight": (0.1, 2.0), "evaluation_collision_weights": (1.0,)},
            "algo.collision_weight=[0.1, 2.0] does not go with algo.conditioning=per_episode",
        ),
        (
            {"distortion": DistortionSettings("pow", -2.0, 0.0, (-1.0, -1.0))},
            "beta=-1 is given more than once",
        ),
    ],
)
def test_parts_that_do_not_fit_together_are_refused(changes: dict[str, Any], fragment: str) -> None:
    with pytest.raises(UserInputError) as caught:
        algo(**changes)
    assert fragment in str(caught.value)


def test_a_range_of_one_weight_is_what_a_collision_counts_and_told_to_nobody() -> None:
    twice = algo(collision_weight=(2, 2))
    assert (twice.fixed_weight, twice.told_weights, twice.context_key) == (2.0, None, "risk")
    assert twice.conditions([-1], None) == [Condition(beta=-1.0)]
    with pytest.raises(UserInputError, match="row is told no collision weight"):
        twice.conditions(None, [2.0])
    told = algo(**WEIGHTED)
    assert (told.fixed_weight, told.told_weights, told.context_key) == (1.0, (0.1, 2.0), "collision_weight")
    assert (algo().fixed_weight, algo().told_weights) == (1.0, None)


def test_a_betas_domain_is_checked_wherever_a_beta_is_given() -> None:
    with pytest.raises(UserInputError, match="outside the domain"):
        DistortionSettings("pow", -2.5, 0.0, ())
    with pytest.raises(UserInputError, match="outside the domain"):
        DistortionSettings("cvar", 0.01, 1.0, (0.0,))
    with pytest.raises(UserInputError, match="outside the domain"):
        algo().conditions([-1.0, 0.5], None)


def test_conditions_of_an_evaluation() -> None:
    assert algo().conditions([-2, 0], None) == [Condition(beta=-2.0), Condition(beta=0.0)]
    assert algo().conditions(None, None) == [Condition(beta=-2.0), Condition(beta=-1.0)]  # the row's own
    with pytest.raises(UserInputError, match=r"^beta=\[\] names none: leave it out for beta=\[-2,-1\], or give one$"):
        algo().conditions([], None)
    with pytest.raises(UserInputError, match="more than once"):
        algo().conditions([-1, -1.0], None)
    with pytest.raises(UserInputError, match="is told no collision weight"):
        algo().conditions([-1], [1.0])

    fixed = algo(conditioning="fixed", relabel="stored", beta=-1.0)
    assert fixed.conditions(None, None) == fixed.conditions([-1.0], None) == [Condition(beta=-1.0)]
    with pytest.raises(UserInputError, match="was trained for beta=-1 alone"):
        fixed.conditions([-2.0], None)

    weighted = algo(**WEIGHTED)
    assert weighted.conditions(None, None) == [Condition(collision_weight=1.0), Condition(collision_weight=2.0)]
    assert weighted.conditions(None, [0.5]) == [Condition(collision_weight=0.5)]
    with pytest.raises(UserInputError, match=r"outside row's range \[0.1, 2\]"):
        weighted.conditions(None, [2.5])
    with pytest.raises(UserInputError, match="has no beta"):
        weighted.conditions([-1.0], None)


def test_replay_holds_an_iteration_and_is_no_larger_than_the_run_can_fill() -> None:
    settings = tiny_settings()
    assert settings.replay_steps() == 2 * 2 * 20 < settings.replay.capacity_steps
    assert tiny_settings("sac", "replay.capacity_steps=40").replay_steps(60) == 40
    assert settings.replay_steps(60) == 2 * 2 * 20 + 60
    with pytest.raises(UserInputError, match=r"capacity_steps=39 does not hold the 40 steps of one iteration"):
        composed("+algo=sac", *TINY, "replay.capacity_steps=39")


def test_runs_that_do_not_say_how_they_pad_do_not(tmp_path: Path) -> None:
    cfg = compose("train", ["+algo=rcdsac_pow"])
    OmegaConf.save(cfg, tmp_path / "config.yaml")
    assert agent_of_run(tmp_path).network.padding == settings_of_run(tmp_path).network.padding == "circular"
    OmegaConf.set_struct(cfg, False)
    del cfg.network["padding"]
    OmegaConf.save(cfg, tmp_path / "config.yaml")
    assert agent_of_run(tmp_path).network.padding == settings_of_run(tmp_path).network.padding == "none"
