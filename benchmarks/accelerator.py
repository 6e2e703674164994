"""All that is to be known of an accelerator, in one call of at most five minutes: is it right, and how fast is it?

Run ``python benchmarks/accelerator.py`` on a machine with one; it prints one JSON object and writes it to
``results/accelerator.json``, which ``make tables`` puts into docs/speed.md. ``--device=cpu --out=check.json`` checks
the program itself where there is none: the same, with small batches and short episodes.

- *correctness*: losses and gradients of one batch, against the same on the CPU; the same random numbers for both.
- *laptop*, *paper*: updates a second with the mini-batch of either preset, as they are, as one CUDA graph, and with
  ``torch.compile``.
- *collection*: agent steps a second of ten agents whose policy is there.
- *iteration*: the parts of one iteration of the laptop preset's training.

Each part is a process of its own with a share of the time, so that one that hangs or dies costs no other.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
ROW = "rcdsac_pow"
LARGEST_DIFFERENCE = 1e-3
"""Of a loss or a gradient, relative to its size: single precision, sums in another order."""
SECONDS_OF_A_RATE = {"cuda": 6.0, "cpu": 0.2}
"""For how long updates are counted."""
# On a CPU the program is checked, and nothing is measured.
SMALL: dict[str, list[str]] = {
    "learner": ["learner.batch_size=2", "task.episode_steps=80"],
    "collection": ["num_episodes=2", "task.episode_steps=20"],
    "iteration": [
        "learner.batch_size=2",
        "task.episode_steps=20",
        "world.num_agents=2",
        "schedule.updates_per_iteration=2",
        "collector.num_processes=0",
        "validation.processes=0",
    ],
}

Lines = Iterator[dict[str, Any]]


# ------------------------------------------------------------------------------------------------ the parts
def small(part: str, device: str) -> list[str]:
    """Return the overrides that make a part small where it is only checked."""
    return SMALL[part] if device == "cpu" else []


def facts(device: str) -> Lines:
    """Say what it is."""
    import torch

    from rcdsac_trl.system.provenance import commit

    found: dict[str, Any] = {"torch": torch.__version__, "commit": commit(), "cpu_threads": torch.get_num_threads()}
    if device.startswith("cuda"):
        properties = torch.cuda.get_device_properties(device)
        found |= {
            "name": properties.name,
            "memory_gb": properties.total_memory / 1e9,
            "cuda": torch.version.cuda,
            "cudnn": torch.backends.cudnn.version(),
        }
    yield found


def correctness(device: str) -> Lines:
    """Compare one batch's losses and gradients with the CPU's, in full single precision and as trainings have it."""
    import torch

    for name, full in (("full_precision", True), ("as_trained", False)):
        torch.backends.cudnn.allow_tf32 = not full
        torch.backends.cuda.matmul.allow_tf32 = False
        worst = largest_difference(device)
        yield {f"{name}_largest_relative_difference": worst}
        if full:
            yield {"agrees": worst <= LARGEST_DIFFERENCE}


def largest_difference(device: str) -> float:
    """Return by how much a loss or a gradient differs at most, relative to the largest of its tensor."""
    from bench_common import make_learner
    from rcdsac_trl.seeding import torch_stream

    overrides = ["preset=laptop", *small("learner", device)]
    here, there = make_learner(ROW, overrides), make_learner(ROW, overrides, device)
    batch = prepared(here)
    for learner in (here, there):
        learner.loss._generator = torch_stream(0, "loss")
    there.loss.load_state_dict(here.loss.state_dict())
    found = []
    for learner, place in ((here, "cpu"), (there, device)):
        with only_layers(learner is there):
            losses = total(learner.loss(batch.to(place)))
            losses.backward()
        gradients = {name: p.grad for name, p in learner.loss.named_parameters() if p.grad is not None}
        found.append({"losses": losses.detach()} | gradients)
    ours, theirs = found
    assert ours.keys() == theirs.keys()
    return max(
        float((value - theirs[name].to("cpu")).abs().max() / value.abs().max().clamp_min(1e-12))
        for name, value in ours.items()
    )


class only_layers:
    """Run the layers that an accelerator runs, also on a CPU, where compiled twins would take their place."""

    def __init__(self, on: bool) -> None:
        self.on = on

    def __enter__(self) -> None:
        from rcdsac_trl.agent.kernels import dispatch

        self.kept = dispatch._is_ours
        if self.on:
            dispatch._is_ours = lambda inputs: False

    def __exit__(self, *_: object) -> None:
        from rcdsac_trl.agent.kernels import dispatch

        dispatch._is_ours = self.kept


def updates(device: str, preset: str) -> Lines:
    """Do updates of a preset in every way there is."""
    from bench_common import make_learner

    ways: dict[str, Callable[[Any], Callable[[], Any]]] = {"plain": lambda learner: learner.update}
    if device.startswith("cuda"):
        ways |= {"cuda_graph": graphed, "compiled": compiled}
    for name, way in ways.items():
        learner = make_learner(ROW, [f"preset={preset}", *small("learner", device)], device)
        try:
            yield {f"{name}_updates_per_second": rate(way(learner), device)}
        except Exception as error:  # what one way cannot do is a result, too
            yield {name: f"does not work: {type(error).__name__}: {str(error).splitlines()[0][:200]}"}


def rate(update: Callable[[], Any], device: str) -> float:
    """Return how often a second something can be done, over some seconds."""
    for _ in range(3):
        update()
    wait(device)
    number, started = 0, time.perf_counter()
    while (spent := time.perf_counter() - started) < SECONDS_OF_A_RATE[device.partition(":")[0]] or number < 2:
        for _ in range(2):  # the program is ahead of the device, as in training, but not by many
            update()
        number += 2
        wait(device)
    return number / spent


def wait(device: str) -> None:
    """Wait until the device has done what it was given."""
    import torch

    if device.startswith("cuda"):
        torch.cuda.synchronize(device)


def prepared(learner: Any) -> Any:
    """Return a batch as an update's loss gets it."""
    batch = learner.replay.sample()
    for transform in (learner.mirror, learner.relabel):
        batch = batch if transform is None else transform(batch)
    return batch


def total(losses: Any) -> Any:
    """Return the sum that an update goes backward from."""
    import torch

    from rcdsac_trl.training.learner import LOSS_KEYS

    return torch.stack([losses[key] for key in LOSS_KEYS]).sum()


def compiled(learner: Any) -> Callable[[], Any]:
    """Return an update whose loss is compiled."""
    import torch

    learner.loss = torch.compile(learner.loss)
    return learner.update


def graphed(learner: Any) -> Callable[[], Any]:
    """Return an update whose losses, gradients and optimiser step are one CUDA graph.

    Sampling stays outside of it, as do target critics and average, which are a kernel or two.
    """
    import torch

    from rcdsac_trl.seeding import torch_seed

    for group in learner.optimizer.param_groups:
        group["capturable"] = True
    # A graph replays what the device draws, and nothing that comes from the CPU.
    device = next(learner.loss.parameters()).device
    learner.loss._generator = torch.Generator(device).manual_seed(torch_seed(0, "graph"))
    static = prepared(learner).apply(held)

    def learn() -> None:
        total(learner.loss(static)).backward()
        learner.optimizer.step()

    beside = torch.cuda.Stream()
    beside.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(beside):
        for _ in range(3):
            learn()
            learner.optimizer.zero_grad(set_to_none=True)
    torch.cuda.current_stream().wait_stream(beside)
    graph = torch.cuda.CUDAGraph()
    graph.register_generator_state(learner.loss._generator)
    with torch.cuda.graph(graph):
        learn()

    def update() -> None:
        refill(static, prepared(learner))
        graph.replay()
        learner.targets.step()
        learner.average.update_parameters(learner.loss.actor_network)

    return update


def held(value: Any) -> Any:
    """Copy a tensor; what is repeated along its sequences stays so, for the loss tells a shared beta by its stride."""
    return value[:, :1].clone().expand_as(value) if value.stride(1) == 0 else value.clone()


def refill(static: Any, batch: Any) -> None:
    """Put a batch in the place of another, whose tensors stay where they are."""
    for key, value in batch.items(True, True):
        target = static.get(key)
        shared = target.stride(1) == 0
        (target[:, :1] if shared else target).copy_(value[:, :1] if shared else value)


def collection(device: str) -> Lines:
    """Drive ten agents with the policy on the device, and on the CPU beside."""
    from rcdsac_trl.config.compose import compose
    from rcdsac_trl.evaluation.evaluation import make_evaluation

    given = ["run=rcdsac_pow-narrow", "beta=[-1]", "split=validation", "num_maps=2", "num_workers=0"]
    given += small("collection", device)
    for place in dict.fromkeys((device, "cpu")):
        with tempfile.TemporaryDirectory() as folder:
            evaluation = make_evaluation(compose("evaluate", [*given, f"device={place}", f"out={folder}/out"]))
            ends = []
            for rows in evaluation.measure(lambda _: None):
                ends.append(time.perf_counter())
                steps = len(rows) * json.loads(evaluation.results.described)["task"]["episode_steps"]
        # The first map pays for all that happens once.
        yield {f"policy_on_{place.partition(':')[0]}_agent_steps_per_second": steps / (ends[1] - ends[0])}


def iteration(device: str) -> Lines:
    """Train for one iteration, and say how long its parts take."""
    import whole_job

    once = ["schedule.iterations=1", *(f"schedule.{name}_iterations=0" for name in ("pursuit", "neutral", "ramp"))]
    given = [f"+algo={ROW}", f"device={device}", *once, "schedule.decay_iterations=0", "validation.num_maps=1"]
    whole_job.run([*given, *SMALL["iteration"]])  # compiles what is compiled
    found = whole_job.run([*given, *small("iteration", device)])
    yield {f"{name}_seconds": found[name] for name in ("startup", "collection", "replay_insertion", "updates", "wall")}


# What does each, and its share of the five minutes, s.
PARTS: dict[str, tuple[Callable[[str], Lines], float]] = {
    "facts": (facts, 20.0),
    "correctness": (correctness, 40.0),
    "laptop": (lambda device: updates(device, "laptop"), 70.0),
    "paper": (lambda device: updates(device, "paper"), 70.0),
    "collection": (collection, 45.0),
    "iteration": (iteration, 50.0),
}


# ------------------------------------------------------------------------------------------------ the parent
def measured(name: str, device: str, seconds: float) -> dict[str, Any]:
    """Run a part in a process of its own, and return what it has said by its end, or by the end of its time."""
    command = [sys.executable, __file__, f"--device={device}", f"--part={name}"]
    with tempfile.TemporaryFile("w+") as said, tempfile.TemporaryFile("w+") as errors:
        try:
            code = subprocess.run(command, stdout=said, stderr=errors, timeout=seconds).returncode
            ended = None if code == 0 else f"ended with code {code}: {last_line(errors)}"
        except subprocess.TimeoutExpired:
            ended = f"took longer than its {seconds:g} s"
        said.seek(0)
        found: dict[str, Any] = {}
        for line in said:
            if line.startswith("{"):
                found |= json.loads(line)
    return found if ended is None else found | {"ended": ended}


def last_line(file: Any) -> str:
    """Return the last line of a file that says anything."""
    file.seek(0)
    lines = [line.strip() for line in file if line.strip()]
    return lines[-1][:300] if lines else "it said nothing"


def main() -> None:
    """Read the command line and run."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--device", default="cuda", help="what is measured: cuda, cuda:<number>, or cpu as a check")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "accelerator.json", help="file to write")
    parser.add_argument("--part", choices=PARTS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.part is not None:
        from rcdsac_trl.system import runtime

        runtime.quiet_libraries()
        measure, _ = PARTS[arguments.part]
        for line in measure(arguments.device):
            print(json.dumps(line), flush=True)
        return
    refuse_what_is_not_there(arguments.device)
    found: dict[str, Any] = {"device": arguments.device}
    for name, (_, seconds) in PARTS.items():
        print(f"{name}: at most {seconds:g} s", file=sys.stderr, flush=True)
        found[name] = measured(name, arguments.device, seconds)
    text = json.dumps(found, indent=2)
    print(text)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(text + "\n", encoding="utf-8")


def refuse_what_is_not_there(device: str) -> None:
    """End with a sentence where there is no such device."""
    from rcdsac_trl.errors import UserInputError
    from rcdsac_trl.system import runtime

    try:
        if runtime.resolve_device(device) != device:
            raise UserInputError(f"device={device} names none: say which is measured, such as cuda")
    except UserInputError as error:
        print(f"{error}; --device=cpu --out=check.json checks the program without one", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
