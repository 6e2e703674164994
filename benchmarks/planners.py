"""Milliseconds that a decision of DWA and of MPPI takes, on one core, while they drive on a validation map.

This process's own time counts, so that other programs count less; the simulation's does not.
"""

import time

import bench_world as bench


def main() -> None:
    parser = bench.parser(__doc__)
    parser.add_argument("--steps", type=int, default=500, help="agent steps; a tenth more go before")
    options = parser.parse_args()
    bench.prepare()
    bench.report({f"{name}_ms_per_decision": 1e3 * seconds(name, options.steps) for name in ("dwa", "mppi")}, options)


def seconds(name: str, steps: int) -> float:
    """Return the seconds of a decision of a baseline."""
    import torch
    from tensordict import TensorDictBase

    from rcdsac_trl.robot.limits import MEAN_PERIOD_S
    from rcdsac_trl.rollout.planners.baselines import baseline_policy
    from rcdsac_trl.rollout.timed import Timed
    from rcdsac_trl.world.task.env import make_env

    agent_ids = range(2)
    env = make_env(split="validation", agent_ids=agent_ids, num_workers=0)
    policy = baseline_policy(name, sensor="narrow", agent_ids=agent_ids, seed=0)
    if isinstance(policy, Timed):
        policy.set_periods([MEAN_PERIOD_S] * len(agent_ids))
    taken = []
    observed: TensorDictBase = env.reset()
    for step in range(steps + steps // 10):
        observed["is_init"] = torch.full((len(agent_ids), 1), step == 0)
        start = time.process_time()
        policy(observed)
        taken.append(time.process_time() - start)
        observed = env.step(observed)["next"]
    env.close()
    return sum(taken[steps // 10 :]) / steps / len(agent_ids)


if __name__ == "__main__":
    main()
