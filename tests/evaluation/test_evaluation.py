"""Evaluation: the same maps for everyone, deterministic actions, the same files twice, numbers that add up."""

import json
import multiprocessing
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pandas as pd
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, exploration_type

from rcdsac_trl.config.acting_override import ActingOverride
from rcdsac_trl.config.algo_settings import AlgoSettings
from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.conditions import Condition
from rcdsac_trl.deploy import find_weights, read_weights, shipped_names
from rcdsac_trl.deploy.policy.weights import packed, read_agent_config
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.evaluation import make_evaluation
from rcdsac_trl.rollout import map_evaluator as driver
from rcdsac_trl.rollout import measurement
from rcdsac_trl.rollout.environments import environment
from rcdsac_trl.rollout.make_agent import make_average, make_loss
from rcdsac_trl.rollout.metrics import METRICS
from rcdsac_trl.rollout.navigation_metrics import TRIP_METRICS
from rcdsac_trl.rollout.policies import LeanPolicy, PursuitPolicy
from rcdsac_trl.rollout.worker import EpisodeBatch, RolloutWorker
from rcdsac_trl.storage.checkpoint import Checkpoints, load_weights
from rcdsac_trl.storage.checkpoint_record import Progress
from rcdsac_trl.training.validation import Snapshot
from rcdsac_trl.world.maps.shapes import Kind
from rcdsac_trl.world.task.env import make_env
from rcdsac_trl.world.task.world_settings import WorldSettings
from tiny import evaluate, evaluation_betas, exported, load_progress, tiny_settings, tiny_trainer

FILES = ("episodes.csv", "summary.csv", "collisions.csv", "evaluation.json")


def contents(folder: Path) -> dict[str, bytes]:
    assert sorted(path.name for path in folder.iterdir()) == sorted(FILES)
    return {name: (folder / name).read_bytes() for name in FILES}


@pytest.fixture(scope="module")
def run(tiny_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of this module's own, since evaluations write into it."""
    folder = tmp_path_factory.mktemp("evaluated") / "run"
    shutil.copytree(tiny_run, folder)
    return folder


# ------------------------------------------------------------------------------------------------ files
def test_the_same_run_evaluated_twice_gives_identical_files(run: Path, tmp_path: Path) -> None:
    given = [f"run={run}", "beta=[-2,-1]", "num_maps=2"]
    first = contents(evaluate(*given, f"out={tmp_path / 'a'}"))
    torch.manual_seed(7)
    second = contents(evaluate(*given, f"out={tmp_path / 'b'}"))
    assert first == second
    # Over the first files as well, which are its own.
    assert contents(evaluate(*given, f"out={tmp_path / 'a'}")) == first


def test_processes_do_not_change_an_evaluation(run: Path, tmp_path: Path) -> None:
    """Not even where actions are drawn: then the noise must not depend on who drives either."""
    given = [f"run={run}", "beta=[-2,-1]", "num_maps=3", "sampled=true"]
    alone = contents(evaluate(*given, f"out={tmp_path / 'a'}"))
    assert contents(evaluate(*given, f"out={tmp_path / 'b'}", "num_workers=2")) == alone
    assert not multiprocessing.active_children()


def test_another_seed_split_or_agent_gives_other_episodes(run: Path, tmp_path: Path) -> None:
    given = [f"run={run}", "beta=[-1]"]
    others = {
        "plain": [],
        "seed": ["seed=1"],
        "split": ["split=validation"],
        "sampled": ["sampled=true"],
        "beta": ["beta=[-2]"],
        "map": ["map=static"],
    }
    found = {
        contents(evaluate(*given, *more, f"out={tmp_path / name}"))["episodes.csv"] for name, more in others.items()
    }
    assert len(found) == len(others)


def test_sampled_episodes_do_not_depend_on_the_other_betas_nor_on_their_order(run: Path, tmp_path: Path) -> None:
    def episodes(betas: str, folder: str) -> dict[float, str]:
        out = evaluate(f"run={run}", f"beta={betas}", "sampled=true", f"out={tmp_path / folder}")
        rows = pd.read_csv(out / "episodes.csv", index_col="map", dtype={"beta": float})
        return {float(beta): part.to_csv() for beta, part in rows.groupby("beta")}

    found = episodes("[-2,-1,-0.5]", "a")
    assert episodes("[-0.5,-2,-1]", "b") == found
    assert episodes("[-1]", "c")[-1.0] == found[-1.0]


def test_what_critics_choose_does_not_depend_on_who_drives_beside(run: Path, tmp_path: Path) -> None:
    given = [f"run={run}", "num_maps=2", "acting.num_candidates=6", "acting.spread=1.5"]
    together = evaluate(*given, "beta=[-2,-1]", f"out={tmp_path / 'a'}", "num_workers=2")
    alone = evaluate(*given, "beta=[-1]", f"out={tmp_path / 'b'}")
    by_mean = evaluate(f"run={run}", "num_maps=2", "beta=[-1]", f"out={tmp_path / 'c'}")
    one = evaluate(f"run={run}", "num_maps=2", "beta=[-1]", "acting.num_candidates=1", f"out={tmp_path / 'd'}")
    found = pd.read_csv(together / "episodes.csv")
    rows = [pd.read_csv(out / "episodes.csv") for out in (alone, by_mean)]
    alike = found[found["beta"] == -1.0].reset_index(drop=True)
    # A column that holds nothing but whole numbers is read as such.
    pd.testing.assert_frame_equal(alike, rows[0], check_exact=True, check_dtype=False)
    assert not rows[0].equals(rows[1])
    assert contents(one) == contents(by_mean)
    described = json.loads((alone / "evaluation.json").read_text())
    assert described["acting"] == {"num_candidates": 6, "spread": 1.5, "over_critics": "minimum", "margin_m": 0.0}


def test_an_exported_agent_acts_as_was_chosen_for_its_export(run: Path, tmp_path: Path) -> None:
    folder = exported(run, tmp_path / "agent")
    chosen = ActingOverride(num_candidates=6).in_weights(read_weights(folder))
    for name, content in packed(chosen).items():
        (folder / name).write_bytes(content)
    evaluated = [
        evaluate(f"run={folder}", "beta=[-1]", f"out={tmp_path / 'a'}"),
        evaluate(f"run={run}", "beta=[-1]", "acting.num_candidates=6", f"out={tmp_path / 'b'}"),
    ]
    assert len({(out / "episodes.csv").read_bytes() for out in evaluated}) == 1


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["sampled=true"], "sampled=true draws actions, and acting.num_candidates=6 chooses among some: leave sampled"),
        (["acting.spread=0"], "acting.spread=0 must be above 0"),
        (["acting.over_critics=max"], "acting.over_critics=max must be one of minimum, mean or null"),
        (["run=null", "baseline=pursuit", "beta=null"], "baseline=pursuit has no critics to choose by"),
    ],
)
def test_what_cannot_choose_is_refused(run: Path, tmp_path: Path, more: list[str], told: str) -> None:
    with pytest.raises(UserInputError, match=told):
        evaluate(f"run={run}", "beta=[-1]", "acting.num_candidates=6", f"out={tmp_path / 'out'}", *more)
    assert not (tmp_path / "out").exists()


def test_it_never_mixes_with_what_another_wrote_meanwhile(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    sizes = ["num_maps=1", "num_episodes=2", "num_workers=0", "threads=1"]
    later = make_evaluation(compose("evaluate", [f"run={run}", "beta=[-2]", f"out={out}", *sizes]))
    before = contents(evaluate(f"run={run}", "beta=[-1]", f"out={out}"))
    with pytest.raises(UserInputError, match="holds the evaluation of something else"):
        later.run()
    assert contents(out) == before


def test_it_refuses_to_overwrite_another_evaluation(run: Path, tmp_path: Path) -> None:
    out = evaluate(f"run={run}", "beta=[-1]", f"out={tmp_path / 'out'}")
    before = contents(out)
    for other in (["beta=[-2]"], ["beta=[-1]", "seed=1"], ["beta=[-1]", "checkpoint=last"]):
        with pytest.raises(
            UserInputError, match="holds the evaluation of something else: give another folder with out="
        ):
            evaluate(f"run={run}", *other, f"out={out}")
    assert contents(out) == before


def test_it_refuses_a_folder_of_somebody_elses_tables(run: Path, tmp_path: Path) -> None:
    table = tmp_path / "episodes.csv"
    table.write_text("mine\n1\n")
    with pytest.raises(UserInputError, match=r"holds tables of something else, episodes\.csv among them: give another"):
        evaluate(f"run={run}", "beta=[-1]", f"out={tmp_path}")
    assert [path.name for path in tmp_path.iterdir()] == ["episodes.csv"]
    assert table.read_text() == "mine\n1\n"


def test_results_go_beside_the_run_unless_told_otherwise(run: Path) -> None:
    out = evaluate(f"run={run}", "beta=[-1]", "seed=5", "checkpoint=last")
    assert out == run / "evaluation" / "last-evaluation-seed5-1x2-beta_-1"
    assert contents(out)


def test_the_description_says_what_was_measured(run: Path, tmp_path: Path) -> None:
    out = evaluate(f"run={run}", "beta=[-2,-0.5]", f"out={tmp_path / 'out'}")
    described = json.loads((out / "evaluation.json").read_text())
    expected = {
        "agent": "rcdsac_pow",
        "train_seed": 0,
        "measure": "pow",
        "sensor": "narrow",
        "checkpoint": "best",
        "split": "evaluation",
        "seed": 0,
        "num_maps": 1,
        "num_episodes": 2,
        "sampled": False,
        "conditions": ["beta=-2", "beta=-0.5"],
    }
    assert {key: described[key] for key in expected} == expected
    assert described["map"]["size_m"] == 10
    assert described["task"]["episode_steps"] == 20


def test_nothing_is_written_when_it_is_stopped(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(measurement, "episode_metrics", stop)
    with pytest.raises(KeyboardInterrupt):
        evaluate(f"run={run}", "beta=[-1]", f"out={tmp_path / 'out'}")
    assert not (tmp_path / "out").exists()


def test_what_has_ended_is_kept_and_a_later_call_says_so(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    given = [f"run={run}", "beta=[-1]", "num_maps=3", f"out={out}"]
    metrics, calls = measurement.episode_metrics, iter(range(100))

    def stop_on_the_third_map(*args: Any, **kwargs: Any) -> Any:
        if next(calls) == 2:
            raise KeyboardInterrupt
        return metrics(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(measurement, "episode_metrics", stop_on_the_third_map)
        with pytest.raises(KeyboardInterrupt):
            evaluate(*given)
    told = capsys.readouterr().err.splitlines()
    assert told[0] == f"rcdsac_trl: 3 maps, for {out}"
    assert told[-1] == f"rcdsac_trl: 2 of 3 maps are in {out / 'unfinished'}"
    assert [path.name for path in out.iterdir()] == ["unfinished"]  # nothing that looks like an evaluation
    assert json.loads((out / "unfinished" / "evaluation.json").read_text())["units_ended"] == 2
    kept = contents(out / "unfinished")["episodes.csv"]

    with pytest.raises(UserInputError, match="holds the unfinished evaluation of something else: give another folder"):
        evaluate(*given, "seed=1")
    assert contents(out / "unfinished")["episodes.csv"] == kept
    whole = contents(evaluate(*given))["episodes.csv"]
    assert "rcdsac_trl: an earlier call ended after 2 of 3 maps: all are measured anew" in capsys.readouterr().err
    assert whole.startswith(kept)
    assert not (out / "unfinished").exists()


def test_a_whole_evaluation_stays_until_the_next_is_whole(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = [f"run={run}", "beta=[-1]", "num_maps=2", f"out={tmp_path / 'out'}"]
    before = contents(evaluate(*given))
    metrics, calls = measurement.episode_metrics, iter(range(100))

    def stop_on_the_second_map(*args: Any, **kwargs: Any) -> Any:
        if next(calls) == 1:
            raise KeyboardInterrupt
        return metrics(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(measurement, "episode_metrics", stop_on_the_second_map)
        with pytest.raises(KeyboardInterrupt):
            evaluate(*given)
    assert {name: (tmp_path / "out" / name).read_bytes() for name in FILES} == before
    assert contents(evaluate(*given)) == before


# ------------------------------------------------------------------------------------------------ three forms
def test_an_exported_agent_does_what_its_run_does(run: Path, tmp_path: Path) -> None:
    folder = exported(run, tmp_path / "agent")
    given = ["beta=[-2,-1]", "beta_controller=[tail_variance]"]  # which asks the critics, too
    of_run = contents(evaluate(f"run={run}", *given, f"out={tmp_path / 'run'}"))
    out = evaluate(f"run={folder}", *given)
    assert out.parent == folder / "evaluation"
    assert contents(out)["episodes.csv"] == of_run["episodes.csv"]
    described, of_run_described = (json.loads(c["evaluation.json"]) for c in (contents(out), of_run))
    digest = json.loads((folder / "config.json").read_text())["weights_sha256"]
    assert described.pop("weights_sha256") == digest
    assert described == of_run_described


@pytest.mark.parametrize("name", shipped_names())
def test_every_shipped_agent_can_be_measured_again(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    config, _ = read_agent_config(find_weights(name))
    row = config.name
    betas = [f"beta={evaluation_betas(row)}".replace(" ", "")] if evaluation_betas(row) else []
    out = evaluate(f"run={name}", *betas, "seed=7", "num_episodes=1", "task=default", "task.episode_steps=20")
    assert out.parts[:1] == ("evaluation",)
    assert out.name.startswith(f"{name}-evaluation-seed7-1x1")
    described = json.loads((out / "evaluation.json").read_text())
    assert (described["agent"], described["sensor"], described["checkpoint"]) == (row, config.sensor, "last")
    assert described["map"]["size_m"] == 20.0


def test_what_is_no_agent_of_one_s_own_is_refused(run: Path, tmp_path: Path) -> None:
    with pytest.raises(UserInputError, match="checkpoint=best chooses among those of a run, and run=sac-narrow is one"):
        evaluate("run=sac-narrow", "checkpoint=best")
    with pytest.raises(
        UserInputError, match=r"holds neither checkpoints nor config\.json: .* agents` lists what there is"
    ):
        evaluate(f"run={tmp_path}")
    folder = exported(run, tmp_path / "agent")
    (folder / "training.yaml").write_text((folder / "training.yaml").read_text().replace("name: narrow", "name: full"))
    with pytest.raises(UserInputError, match=r"training\.yaml is of another agent than the weights: export it anew"):
        evaluate(f"run={folder}", "beta=[-1]")
    (folder / "training.yaml").unlink()
    with pytest.raises(UserInputError, match=r"holds no training\.yaml, .* export it anew .* or name its run folder"):
        evaluate(f"run={folder}", "beta=[-1]")


# ------------------------------------------------------------------------------------------------ numbers
def test_rows_and_summary_add_up(run: Path, tmp_path: Path) -> None:
    out = evaluate(f"run={run}", "beta=[-1,-2]", "num_maps=2", "num_episodes=3", f"out={tmp_path / 'out'}")
    episodes, summary = pd.read_csv(out / "episodes.csv"), pd.read_csv(out / "summary.csv")
    assert list(episodes) == ["beta", "collision_weight", "map", "episode", *METRICS, *TRIP_METRICS]
    keys = list(episodes[["beta", "map", "episode"]].itertuples(index=False, name=None))
    assert keys == [(beta, map_, i) for beta in (-2.0, -1.0) for map_ in (0, 1) for i in range(3)]
    assert summary["beta"].tolist() == [-2.0, -1.0]
    assert summary["episodes"].tolist() == [6, 6]
    assert (episodes["collisions"] % 1 == 0).all()
    assert episodes["contact_fraction"].between(0, 1).all()
    assert (episodes["contact_fraction"] * 20 >= episodes["collisions"] - 1e-6).all()
    assert episodes["mean_speed_m_per_s"].between(0, 0.7).all()
    for _, line in summary.iterrows():
        of_beta = episodes[episodes["beta"] == line["beta"]]
        for metric in METRICS:
            values = of_beta[metric].tolist()
            mean = sum(values) / 6
            spread = (sum((value - mean) ** 2 for value in values) / 6) ** 0.5
            assert line[f"{metric}_mean"] == pytest.approx(mean, rel=1e-4, abs=1e-6)
            assert line[f"{metric}_std"] == pytest.approx(spread, rel=1e-3, abs=1e-5)


def test_every_collision_has_a_row(tmp_path: Path) -> None:
    """As many as the episodes count, and each at a step whose own contact begins there: blind driving hits a lot."""
    blind = [
        "map=mixed",
        "task=default",
        "map.num_movers=6",
        "map.size_m=10",
        "task.episode_steps=300",
        "num_episodes=8",
    ]
    out = evaluate("baseline=pursuit", *blind, f"out={tmp_path / 'out'}")
    episodes, collisions = pd.read_csv(out / "episodes.csv"), pd.read_csv(out / "collisions.csv")
    counted = collisions.groupby("episode").size().reindex(episodes["episode"], fill_value=0)
    assert counted.tolist() == episodes["collisions"].tolist()
    assert len(collisions) > 3
    assert list(collisions)[:4] == ["beta", "collision_weight", "map", "episode"]
    assert set(collisions["thing"]) <= {*get_args(Kind), "mover"}
    reach = np.hypot(collisions["x_m"] - collisions["robot_x_m"], collisions["y_m"] - collisions["robot_y_m"])
    assert reach.between(0.25 * np.cos(np.pi / 8) - 0.005, 0.255).all()
    assert (collisions["unsensed_s"].dropna() <= collisions["time_s"].loc[collisions["unsensed_s"].notna()]).all()
    stands = collisions["thing"] != "mover"
    assert (collisions.loc[stands, ["thing_vx_m_per_s", "thing_vy_m_per_s"]] == 0.0).all(axis=None)


class Hits:
    """A worker whose every agent collides in its second of four steps."""

    def __init__(self, num_agents: int) -> None:
        self.num_agents = num_agents

    def rollout(self, policy: TensorDictModuleBase, episode: int, **asked: Any) -> EpisodeBatch:
        assert (asked["observed"], asked["happened"]) == (
            ("velocity", "pose"),
            ("contact", "goal_reached", "reward_components"),
        )
        policy(TensorDict({"done": torch.zeros(self.num_agents, 1)}, [self.num_agents]))
        components = np.tile(np.float32([-0.02, 0.0, 0.5, 1.2, 0.0]), (self.num_agents, 4, 1))
        components[:, 1, 4] = -10.0
        done = {
            "contact": components[..., 4:] < 0.0,
            "goal_reached": components[..., 4:] > 0.0,
            "reward_components": components,
            "action": np.zeros((self.num_agents, 4, 2), np.float32),
        }
        return EpisodeBatch({"velocity": np.full((self.num_agents, 5, 4), -0.1, np.float32)}, done, {})


class Nothing(TensorDictModuleBase):
    """Drives nowhere, and notes how actions are chosen."""

    in_keys = ["done"]  # noqa: RUF012
    out_keys = ["action"]  # noqa: RUF012

    def __init__(self) -> None:
        super().__init__()
        self.kinds: set[Any] = set()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.kinds.add(exploration_type())
        assert not torch.is_grad_enabled()
        return tensordict.set("action", torch.zeros(*tensordict.batch_size, 2))


@pytest.mark.parametrize("sampled", [False, True])
def test_a_table_of_known_episodes(sampled: bool) -> None:
    conditions = [Condition(collision_weight=2.0), Condition(collision_weight=1.0)]
    policy, worker = Nothing(), Hits(4)
    table = measurement.table_of(
        measurement.measure_map(
            worker, policy, conditions=conditions, num_agents=2, map_index=map_index, sampled=sampled
        )
        for map_index in (2, 0, 1)
    )
    assert policy.kinds == {ExplorationType.RANDOM if sampled else ExplorationType.DETERMINISTIC}
    assert table["map"].tolist() == [0, 0, 1, 1, 2, 2] * 2
    assert len(table) == 2 * 3 * 2
    assert table["collision_weight"].tolist() == [1.0] * 6 + [2.0] * 6  # sorted, whatever order was asked for
    assert table["beta"].isna().all()
    # 4 x (-0.02 + 0.5 x 1.2) - 10, with a weight of 1 for both conditions: what was paid is not what is reported
    assert table["reward"].to_numpy() == pytest.approx(4 * 0.58 - 10.0)
    assert (table["collisions"] == 1).all()
    assert (table["contact_fraction"] == 0.25).all()
    assert table["mean_speed_m_per_s"].to_numpy() == pytest.approx(0.1)


def told_environment(
    world: WorldSettings, algo: AlgoSettings | None, conditions: list[Condition], agents: int, state_size: int
) -> EnvBase:
    """Make an evaluation's agents as an environment that transforms tell what they are told."""
    return environment(
        world,
        algo,
        split="evaluation",
        seed=0,
        agent_ids=list(range(agents)) * len(conditions),
        state_size=state_size,
        conditions=[condition for condition in conditions for _ in range(agents)],
    )


def test_the_weighted_row_is_paid_with_its_weight_and_reported_without(tmp_path: Path) -> None:
    """RCWR's reward column must compare with every other row's: w_coll is 1 there."""
    settings = tiny_settings("rcwr")
    conditions = [Condition(collision_weight=0.5), Condition(collision_weight=2.0)]
    world = crowded(4)
    env = told_environment(world, settings.algo, conditions, 2, settings.network.state_size)
    tensordict, kept = env.reset(), []
    policy = PursuitPolicy()
    for _ in range(world.task.episode_steps):
        tensordict = env.step(policy(tensordict))
        kept.append(tensordict.clone())
        tensordict = env.step_mdp(tensordict)
    env.close()
    steps = torch.stack(kept, 1)
    weights = torch.tensor([0.5, 0.5, 2.0, 2.0])
    assert torch.equal(steps["collision_weight"].squeeze(-1), weights.view(4, 1).expand(4, world.task.episode_steps))
    parts = steps["next", "reward_components"]
    rest = parts[..., 0] + parts[..., 1] + parts[..., 2] * parts[..., 3]
    paid = (rest + weights.view(4, 1) * parts[..., 4]).sum(1)
    torch.testing.assert_close(steps["next", "reward"].squeeze(-1).sum(1), paid, rtol=1e-5, atol=1e-4)
    collisions = (parts[..., 4] / -10.0).sum(1)
    assert collisions.sum() > 0, "the map is crowded enough to tell the two rewards apart"
    reported = measurement.episode_metrics(steps)["reward"]
    torch.testing.assert_close(reported.float(), (rest + parts[..., 4]).sum(1), rtol=1e-5, atol=1e-4)


# ------------------------------------------------------------------------------------------------ who meets what
def crowded(num_agents: int) -> WorldSettings:
    """A small world in which a blind controller hits something soon."""
    cfg = ["map.num_movers=0", "map.clutter_per_m2=0.6", "map.mapped_fraction=0", "task.episode_steps=60"]
    settings = tiny_settings("rcwr", *cfg)
    return WorldSettings(settings.map, settings.task, "narrow", num_agents=num_agents, num_workers=0)


@pytest.mark.parametrize("workers", [0, 2])
def test_agent_i_of_every_condition_meets_the_same_start(workers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rcdsac_trl.rollout.environments.make_env", partial(make_env, serial=True))
    settings = tiny_settings("rcdsac_pow")
    conditions = [Condition(beta=beta) for beta in (-2.0, -1.0, 0.0, -0.5)]
    agents = 3
    world = WorldSettings(settings.map, settings.task, "narrow", num_agents=12, num_workers=workers)
    env = told_environment(world, settings.algo, conditions, agents, settings.network.state_size)
    starts = []
    for _ in range(2):
        first = env.reset().reshape(-1)
        assert first["risk"].flatten().tolist() == [c.beta for c in conditions for _ in range(agents)]
        blocks = first["pose"].view(len(conditions), agents, 3)
        assert (blocks == blocks[:1]).all()
        assert len({tuple(pose) for pose in blocks[0].tolist()}) == agents, "the agents of a block start apart"
        for key in ("range", "waypoint"):
            assert (
                first[key].view(len(conditions), agents, -1) == first[key].view(len(conditions), agents, -1)[:1]
            ).all()
        starts.append(blocks[0])
    assert not torch.equal(*starts), "the next map is another one"
    env.close()


def test_a_run_meets_the_same_episodes_as_the_baseline(run: Path) -> None:
    settings = tiny_settings()
    world = WorldSettings(settings.map, settings.task, "narrow", num_agents=2, num_workers=0)
    poses = []
    for algo, conditions in ((settings.algo, [Condition(beta=-1.0)]), (None, [Condition()])):
        env = told_environment(world, algo, conditions, 2, settings.network.state_size)
        poses.append(env.reset()["pose"])
        env.close()
    assert torch.equal(*poses)


def test_actions_are_tanh_of_the_mean(run: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen: list[TensorDictBase] = []

    forward = LeanPolicy.forward

    def watched(self: LeanPolicy, tensordict: TensorDictBase) -> TensorDictBase:
        out = forward(self, tensordict)
        seen.append(out.select("loc", "scale", "action").clone())
        return out

    monkeypatch.setattr(LeanPolicy, "forward", watched)
    evaluate(f"run={run}", "beta=[-1]", f"out={tmp_path / 'a'}")
    steps = torch.stack(seen)
    torch.testing.assert_close(steps["action"], steps["loc"].tanh(), rtol=0, atol=1e-6)
    seen.clear()
    evaluate(f"run={run}", "beta=[-1]", "sampled=true", f"out={tmp_path / 'b'}")
    drawn = torch.stack(seen)
    noise = (drawn["action"].clamp(-0.999, 0.999).atanh() - drawn["loc"]) / drawn["scale"]
    assert noise.std().item() == pytest.approx(1.0, abs=0.3)


def test_the_named_checkpoint_drives(run: Path, tmp_path: Path) -> None:
    """Saved weights act: what is saved under a name is what an evaluation under that name measures."""
    changed = tmp_path / "run"
    shutil.copytree(run, changed)
    settings = tiny_settings()
    loss = make_loss(settings, "cpu")
    average = make_average(loss, settings.learner)
    load_weights(changed / "checkpoints", "best", loss=loss, average=average)
    best_progress = load_progress(changed / "checkpoints", "last")
    checkpoints = Checkpoints(changed / "checkpoints", {"loss": loss, "average": average}, replay=None, keep=10)
    checkpoints.save(replace(best_progress, iterations=90), {})
    given = [f"run={changed}", "beta=[-1]"]
    best = contents(evaluate(*given, f"out={tmp_path / 'best'}"))["episodes.csv"]
    assert contents(evaluate(*given, "checkpoint=last", f"out={tmp_path / 'same'}"))["episodes.csv"] == best
    with torch.no_grad():
        for value in average.module.parameters():
            value.mul_(2.0)
    checkpoints.save(replace(best_progress, iterations=91), {})
    assert contents(evaluate(*given, "checkpoint=last", f"out={tmp_path / 'other'}"))["episodes.csv"] != best
    assert contents(evaluate(*given, "checkpoint=90", f"out={tmp_path / 'then'}"))["episodes.csv"] == best
    assert contents(evaluate(*given, f"out={tmp_path / 'best'}"))["episodes.csv"] == best


# ------------------------------------------------------------------------------------------------ pursuit, validation
def test_the_pursuit_baseline_drives_without_any_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    small = ["map=easy", "task=default", "task.episode_steps=120"]
    out = evaluate("baseline=pursuit", *small)
    assert out == Path("evaluation") / "pursuit-narrow-evaluation-seed0-1x2"
    episodes = pd.read_csv(out / "episodes.csv")
    assert len(episodes) == 2
    assert episodes[["beta", "collision_weight"]].isna().all(axis=None)
    assert (episodes["mean_speed_m_per_s"] > 0.25).all(), "it drives"
    described = json.loads((out / "evaluation.json").read_text())
    assert (described["agent"], described["measure"], described["checkpoint"]) == ("pursuit", None, None)
    assert contents(evaluate("baseline=pursuit", *small, "out=again")) == contents(out)


def test_a_validation_repeats_itself_and_follows_its_snapshot(tmp_path: Path) -> None:
    trainer = tiny_trainer(tmp_path / "run", "rcdsac_pow", "validation.num_maps=2")

    def measured(actor: bytes) -> pd.DataFrame:
        trainer.validation.evaluator.start(Snapshot(Progress(), actor), alone=False)
        return trainer.validation.evaluator.finish()

    before = trainer.learner.averaged_actor()
    first = measured(before)
    with torch.no_grad():
        for value in trainer.learner.average.module.parameters():
            value.mul_(3.0)
    pd.testing.assert_frame_equal(first, measured(before))  # the snapshot stays what it was
    assert not measured(trainer.learner.averaged_actor())["reward"].equals(first["reward"])
    trainer.validation.close()
    trainer.episodes.close()
    trainer.log.close()
    trainer.lock.close()


def test_building_an_evaluation_writes_nothing(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    built = make_evaluation(compose("evaluate", [f"run={run}", "beta=[-1]", f"out={out}"]))
    assert built.results.path == out
    assert not out.exists()


@pytest.fixture
def closed(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Note the workers of evaluations that are closed."""
    closed: list[bool] = []
    original: Callable[..., RolloutWorker] = driver.evaluation_worker

    def watched(*arguments: Any) -> RolloutWorker:
        worker = original(*arguments)
        close = worker.close
        monkeypatch.setattr(worker, "close", lambda: (closed.append(True), close()))
        return worker

    monkeypatch.setattr(driver, "evaluation_worker", watched)
    return closed


def test_an_evaluation_closes_its_environment(run: Path, tmp_path: Path, closed: list[bool]) -> None:
    evaluate(f"run={run}", "beta=[-1]", f"out={tmp_path / 'out'}")
    assert closed == [True]


def test_an_evaluation_whose_policy_cannot_be_made_leaves_neither_environment_nor_threads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, closed: list[bool]
) -> None:
    monkeypatch.setattr(driver, "baseline_policy", lambda *_, **__: 1 / 0)
    threads = torch.get_num_threads()
    with pytest.raises(ZeroDivisionError):
        evaluate("baseline=pursuit", f"threads={threads + 1}", f"out={tmp_path / 'out'}")
    assert closed == [True]
    assert torch.get_num_threads() == threads
