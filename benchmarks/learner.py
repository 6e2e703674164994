"""Updates per second of the learner and of a plain TorchRL one, side by side, and where the time goes.

Run ``python benchmarks/learner.py`` for a table, ``--json`` for one JSON object. Each learner has a process of its own,
since the product sets up its allocator at a process's start and the reference keeps the system's; they take turns,
so that whatever else the machine does meets all of them, and medians over the turns are reported.
"""

import argparse
import ctypes
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rcdsac_trl.system import runtime

# Mini-batch: overrides of the training's config, updates in a turn, turns.
BATCHES: dict[str, tuple[list[str], int, int]] = {
    "paper": (["preset=paper"], 1, 3),
    "laptop": (["preset=laptop", "threads=1"], 5, 7),
    "laptop, two threads": (["preset=laptop", "threads=2"], 5, 7),
}
#: Name of a learner to (registry row, whether it is the product's).
PLAYERS = {
    "product": ("rcdsac_pow", True),
    "reference": ("rcdsac_pow", False),
    "sac": ("sac", True),
    "counter": ("rcdsac_pow", True),
}
#: Which of them take turns; the other one counts operations, which takes its time.
TURNS = ("product", "reference", "sac")


# ------------------------------------------------------------------------------------------------ the parent
class Player:
    """A process that does updates when told to.

    Args:
        name: key of :data:`PLAYERS`.
        overrides: of the training's config.
    """

    def __init__(self, name: str, overrides: list[str]) -> None:
        clean = {key: value for key, value in os.environ.items() if not key.startswith("MALLOC_")}
        self.process = subprocess.Popen(
            [sys.executable, __file__, "--player", name, *overrides],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=clean,
        )

    def ask(self, what: str, number: int = 0) -> Any:
        """Send a question, wait for its answer."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps([what, number]) + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def close(self) -> None:
        """End the process."""
        self.process.communicate()


def compare(overrides: list[str], updates: int, turns: int) -> dict[str, Any]:
    """Let all players take turns on one mini-batch."""
    from bench_common import median

    players = {name: Player(name, overrides) for name in PLAYERS}
    took: dict[str, list[float]] = {name: [] for name in TURNS}
    peaks = []
    try:
        for name in TURNS:
            players[name].ask("updates", 2)  # compiled passes, optimiser states
        for _ in range(turns):
            for name, seconds in took.items():
                seconds.append(players[name].ask("updates", updates) / updates)
            peaks.append(players["product"].ask("peak"))
        flops = players["counter"].ask("flops")
        facts = players["product"].ask("facts")
        parts = players["product"].ask("parts", 3 * updates)
    finally:
        for player in players.values():
            player.close()
    typical = {name: median(values) for name, values in took.items()}
    return facts | {
        "updates_per_second": 1.0 / typical["product"],
        "reference_updates_per_second": 1.0 / typical["reference"],
        "speedup": median([slow / fast for slow, fast in zip(took["reference"], took["product"], strict=True)]),
        "sac_ratio": median([ours / sac for ours, sac in zip(took["product"], took["sac"], strict=True)]),
        "gflop_per_update": flops / 1e9,
        "gemm_peak_gflops": median(peaks) / 1e9,
        "gemm_fraction": median([flops / t / peak for t, peak in zip(took["product"], peaks, strict=True)]),
        "milliseconds_by_part": parts,
    }


def table(results: dict[str, dict[str, Any]]) -> str:
    """Return the results as text."""
    lines = []
    for name, result in results.items():
        lines += [
            f"{name}: {result['sequences']} sequences x {result['steps']}, {result['threads']} threads, "
            f"allocator: {result['allocator']}",
            f"  {result['updates_per_second']:.2f} updates/s, the reference "
            f"{result['reference_updates_per_second']:.2f}: {result['speedup']:.1f} times as fast; "
            f"{result['sac_ratio']:.2f} times as long as an update of SAC",
            f"  {result['gflop_per_update']:.1f} GFLOP an update: {100 * result['gemm_fraction']:.0f} % of the "
            f"{result['gemm_peak_gflops']:.0f} GFLOP/s of a large matrix product",
        ]
        lines += [f"  {part:<28} {ms:8.1f} ms on one thread" for part, ms in result["milliseconds_by_part"].items()]
    return "\n".join(lines)


def main() -> None:
    """Read the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    parser.add_argument("--out", type=Path, help="also write the JSON object to this file")
    parser.add_argument("--player", choices=PLAYERS, help=argparse.SUPPRESS)
    parser.add_argument("overrides", nargs="*", help="overrides of the training's config, such as sensor=full")
    arguments = parser.parse_args()
    if arguments.player is not None:
        play(arguments.player, arguments.overrides)
        return
    from bench_common import report

    results = {
        name: compare([*overrides, *arguments.overrides], *counts) for name, (overrides, *counts) in BATCHES.items()
    }
    others = {key: result for key, result in results.items() if key != "paper"}
    report(results["paper"] | others, table(results), as_json=arguments.json, out=arguments.out)


# ------------------------------------------------------------------------------------------------ a player
def play(name: str, overrides: list[str]) -> None:
    """Answer the parent's questions until it closes the pipe."""
    row, is_product = PLAYERS[name]
    if is_product:
        runtime.keep_pages()
    runtime.quiet_libraries()
    import torch

    from bench_common import gemm_peak, make_learner, seconds
    from reference import ReferenceLearner

    in_passes = count_products() if name == "counter" else None
    learner = make_learner(row, overrides)
    threads = learner.loss.threads
    # As in a training: the loss has threads of its own. The plain learner knows torch's alone.
    runtime.set_threads(1 if is_product else threads)
    if not is_product:
        learner = ReferenceLearner(learner)
    facts = {
        "sequences": learner.replay.batch_size,
        "steps": learner.replay.sequence_slots - 1,
        "threads": threads,
        "allocator": runtime.allocator(),
        "torch": torch.__version__,
    }

    def on_one_thread(call: Callable[[], Any]) -> Any:
        learner.loss.threads = 1
        result = call()
        learner.loss.threads = threads
        return result

    def peak() -> float:
        torch.set_num_threads(threads)
        result = gemm_peak()
        torch.set_num_threads(1)
        return result

    answers: dict[str, Callable[[int], Any]] = {
        "updates": lambda number: number * seconds(learner.update, number, threads),
        "peak": lambda _: peak(),
        "flops": lambda _: on_one_thread(lambda: count_flops(learner.update, in_passes)),
        "parts": lambda number: on_one_thread(lambda: time_parts(learner, number)),
        "facts": lambda _: facts,
    }
    for line in sys.stdin:
        what, number = json.loads(line)
        print(json.dumps(answers[what](number)), flush=True)


def count_products() -> Callable[[], int]:
    """Count the operations of products within compiled passes that this process is yet to load; return the counter."""
    from rcdsac_trl.agent.kernels import matmul

    routine_type = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 13)
    total = 0

    def counting(routine: Callable[..., None]) -> Callable[..., None]:
        def counted(*addresses: int) -> None:
            nonlocal total
            total += 2 * math.prod(ctypes.c_int.from_address(address).value for address in addresses[2:5])
            routine(*addresses)

        return counted

    for name in matmul.ROUTINES.values():
        address = matmul.find(name, in_torch=matmul.LIBRARY == "torch's")
        callback = routine_type(counting(routine_type(address)))
        _CALLBACKS.append(callback)
        matmul.bind(name, ctypes.cast(callback, ctypes.c_void_p).value)
    return lambda: total


# Compiled passes call these as long as the process lives.
_CALLBACKS: list[Any] = []


def count_flops(call: Callable[[], Any], in_passes: Callable[[], int] | None = None) -> int:
    """Count the floating-point operations of all matrix products and convolutions in a call; nothing else counts.

    What the call does on threads of its own is not seen, nor, without their counter, what compiled passes multiply.
    """
    import torch
    from torch.utils._python_dispatch import TorchDispatchMode
    from torch.utils.flop_counter import addmm_flop, flop_registry

    # The registry lacks the form that adds in place. Its own counter does not get through a TensorDictParams.
    rules = flop_registry | {torch.ops.aten.addmm_: addmm_flop}

    class Counter(TorchDispatchMode):
        total = 0

        def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            result = function(*args, **(kwargs or {}))
            rule = rules.get(function._overloadpacket)
            self.total += 0 if rule is None else rule(*args, **(kwargs or {}), out_val=result)
            return result

    before = 0 if in_passes is None else in_passes()
    with Counter() as counter:
        call()
    return counter.total + (0 if in_passes is None else in_passes() - before)


def time_parts(learner: Any, updates: int) -> dict[str, float]:
    """Return the milliseconds an update on one thread spends in every part, backward passes included.

    A backward pass reaches all heads before the first encoder: the moment it reaches a memory divides it. The
    learner is of no use for anything else afterwards.
    """
    spent: dict[str, float] = {}
    marks: dict[str, float] = {}

    def measure(owner: Any, name: str) -> None:
        function = getattr(owner, name)

        def timed(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            result = function(*args, **kwargs)
            marks[name] = time.perf_counter()
            spent[name] = spent.get(name, 0.0) + marks[name] - start
            if name == "_encode" and result.requires_grad:
                result.register_hook(reached)
            return result

        object.__setattr__(owner, name, timed)

    def reached(_: Any) -> None:
        marks.setdefault("memory", time.perf_counter())

    def optimise() -> None:
        now, memory = time.perf_counter(), marks.pop("memory")
        spent["backward to memories"] = spent.get("backward to memories", 0.0) + memory - marks["forward"]
        spent["backward from memories"] = spent.get("backward from memories", 0.0) + now - memory
        step()

    for name in ("forward", "_encode", "_act", "_evaluate"):
        measure(learner.loss, name)
    measure(learner.replay, "sample")
    measure(learner.targets, "step")
    measure(learner.average, "update_parameters")
    step = learner.optimizer.step
    learner.optimizer.step = optimise
    start = time.perf_counter()
    for _ in range(updates):
        learner.update()
    total = time.perf_counter() - start
    heads, encoders = spent["_act"] + spent["_evaluate"], spent["_encode"]
    parts = {
        "replay sampling": spent["sample"],
        "encoders": encoders + spent["backward from memories"],
        "heads and loss, backward": spent["backward to memories"],
        "heads, forward": heads,
        "loss, forward": spent["forward"] - heads - encoders,
    }
    # Relabelling takes a tenth of a millisecond, and is counted here.
    parts["optimiser, targets, average"] = total - sum(parts.values())
    return {part: 1e3 * value / updates for part, value in parts.items()}


if __name__ == "__main__":
    main()
