"""What driving costs on one core: time to import and load, and how long one call of a policy takes.

An untrained agent with the default networks drives on made-up messages among random obstacles, so that the stop zone
has to think in most calls; so does the same agent whose critics choose among 32 actions. Both take turns with torch's
modules on the same observations. Processor time of this process, since other programs on the same core are not what is
measured; run it with `taskset -c 0`.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import bench_world as bench

CALLS = 3000
IMPORTS = 5
CANDIDATES = 32
_IMPORT = """
import json, sys, time
start = time.process_time()
import rcdsac_trl
policy = rcdsac_trl.load(sys.argv[1])
seconds = time.process_time() - start
print(json.dumps([seconds, len(sys.modules), "torch" in sys.modules]))
"""


def main() -> None:
    parser = bench.parser(__doc__)
    parser.add_argument("--weights", type=Path, help="folder of weights to drive with; default: untrained ones")
    options = parser.parse_args()
    for library in ("OMP", "OPENBLAS", "MKL"):  # before anything reads them
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    import numpy as np
    import torch

    from rcdsac_trl.deploy import ActingSettings, Guard, Policy, read_weights
    from rcdsac_trl.deploy.export.modules import ActorStep, CriticStep
    from rcdsac_trl.robot.observation import REMEMBERED_SIZE

    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        weights_folder = options.weights or untrained(Path(folder))
        imports = [imported(weights_folder) for _ in range(IMPORTS)]
        weights = read_weights(weights_folder)
    by_mean, choosing = ActingSettings(), ActingSettings(CANDIDATES)
    policy = Policy(weights, acting=by_mean)
    drivers = {
        "act": policy,
        "act_without_guard": Policy(weights, guard=None, acting=by_mean),
        "act_choosing": Policy(weights, acting=choosing),
        "act_choosing_without_guard": Policy(weights, guard=None, acting=choosing),
    }
    actor, critics = ActorStep.of_weights(weights), CriticStep(weights, torch.from_numpy(policy.fractions))
    memory, memories = torch.zeros(1, actor.encoder.state_size), torch.zeros(2, 1, actor.encoder.state_size)
    took: dict[str, list[float]] = {name: [] for name in (*drivers, "torch_networks_alone")}
    rng, remembers = np.random.default_rng(0), weights.config.memory_s > 0.0
    assert policy.guard == Guard()
    for _ in range(CALLS):
        distances = np.where(rng.random(180) < 0.5, rng.uniform(0.4, 3.0, 180), np.inf)
        waypoints, velocity, beta = rng.uniform(-4, 4, (2, 2)), rng.uniform(-0.2, 0.6, 2), -2.0 * rng.random()
        for name, driver in drivers.items():
            start = time.process_time()
            driver.act(distances, waypoints, velocity, beta)
            took[name].append(time.process_time() - start)
        inputs = [torch.from_numpy(rng.random((1, size), dtype=np.float32)) for size in (180, 6, 4, 1)]
        remembered = torch.from_numpy(rng.random((1, REMEMBERED_SIZE), dtype=np.float32)) if remembers else None
        start = time.process_time()
        with torch.no_grad():
            action, memory = actor(*inputs, memory, remembered)
            _, memories = critics(*inputs, action, memories, remembered)
        took["torch_networks_alone"].append(time.process_time() - start)
    results: dict[str, Any] = {
        "import_and_load_s": min(seconds for seconds, _, _ in imports),
        "modules_imported": imports[0][1],
        "imports_torch": imports[0][2],
        "calls": CALLS,
    }
    for name, seconds in took.items():
        milliseconds = 1e3 * np.array(seconds[CALLS // 10 :])
        for what, share in (("median", 50), ("p99", 99)):
            results[f"{name}_{what}_ms"] = float(np.percentile(milliseconds, share))
    bench.report(results, options)


def imported(weights: Path) -> list[Any]:
    """Return what a process of its own needs to import the package and load an agent."""
    done = subprocess.run([sys.executable, "-c", _IMPORT, str(weights)], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def untrained(folder: Path) -> Path:
    """Write weights with the default networks."""
    from rcdsac_trl.config.compose import compose
    from rcdsac_trl.config.run_config import training_settings
    from rcdsac_trl.deploy.policy.weights import packed
    from rcdsac_trl.release.run_weights import weights_of_run
    from rcdsac_trl.rollout.make_agent import make_average, make_loss
    from rcdsac_trl.storage.checkpoint import Checkpoints
    from rcdsac_trl.storage.checkpoint_record import Progress
    from rcdsac_trl.training.run_folder import start_run_folder

    cfg = compose("train", ["+algo=rcdsac_pow", "logger=none"])
    settings = training_settings(cfg)
    run, out = folder / "run", folder / "weights"
    start_run_folder(run, cfg, {})
    loss = make_loss(settings, "cpu")
    parts = {"loss": loss, "average": make_average(loss, settings.learner)}
    Checkpoints(run / "checkpoints", parts, replay=None, keep=1).save(Progress(), {})
    out.mkdir()
    for name, content in packed(weights_of_run(run, "last")).items():
        (out / name).write_bytes(content)
    return out


if __name__ == "__main__":
    main()
