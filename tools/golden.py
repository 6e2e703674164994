"""Hash what the refactoring must not change; every number comes from the commands that a user calls.

    python tools/golden.py             # prints "<sha256>  <what>", a line each
    python tools/golden.py --check     # compares with tools/golden.txt

Two smoke trainings (final weights, tables, CSV scalars), an evaluation of a shipped agent's run, a drive over the
office course, and the outputs of an exported ONNX agent. Floating-point results are those of one machine.
"""

import hashlib
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

RECORD = Path(__file__).with_suffix(".txt")
SMOKE = ["preset=smoke", "logger=default", "logger.backends=[csv]", "map=easy", "seed=3"]


def call(verb: str, *arguments: str) -> None:
    """Run a command, and show what it says if it fails."""
    done = subprocess.run([sys.executable, "-m", f"rcdsac_trl.{verb}", *arguments], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{verb} {' '.join(arguments)}\n{done.stdout}{done.stderr}")


def digest(content: bytes) -> str:
    """Return the hash of some bytes."""
    return hashlib.sha256(content).hexdigest()


def run_digests(run: Path) -> Iterator[tuple[str, str]]:
    """Hash a run's newest tensors, tables and scalars; of what holds times, only the other lines."""
    newest = sorted((run / "checkpoints").glob("iteration-*"))[-1]
    for path in sorted(newest.rglob("*")):
        if path.suffix == ".tdc":
            yield path.relative_to(newest).as_posix(), digest(path.read_bytes())
    for path in sorted([*run.glob("*_episodes.csv"), *run.glob("csv/scalars/**/*.csv")]):
        if "time" not in path.parts:
            yield path.relative_to(run).as_posix(), digest(path.read_bytes())
    yield "config.yaml", digest((run / "config.yaml").read_bytes())


def onnx_outputs(name: str) -> bytes:
    """Return what the exported programs of a shipped agent answer to fixed inputs."""
    import onnxruntime

    from rcdsac_trl.deploy import find_weights, read_weights

    try:
        from rcdsac_trl.deploy.export.exported import export_agent
    except ModuleNotFoundError:  # where it was before the move
        from rcdsac_trl.deploy.exported import export_agent
    answers = []
    for program, content in export_agent(read_weights(find_weights(name))).files.items():
        if program.endswith(".onnx"):
            session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
            random = np.random.default_rng(0)
            inputs = {i.name: random.uniform(0.0, 1.0, i.shape).astype(np.float32) for i in session.get_inputs()}
            answers += [np.ascontiguousarray(answer).tobytes() for answer in session.run(None, inputs)]
    return b"".join(answers)


def record() -> Iterator[tuple[str, str]]:
    """Yield name and hash of everything."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for row, sensor in (("rcdsac_pow", "narrow"), ("rcwr", "sparse")):
            run = folder / row
            call("train", f"+algo={row}", f"sensor={sensor}", *SMOKE, f"hydra.run.dir={run}")
            for name, value in run_digests(run):
                yield f"{row}-{sensor}: {name}", value
        run, results = folder / "rcdsac_pow", folder / "evaluation"
        call("evaluate", f"run={run}", "beta=[-2,-1]", "num_maps=2", "num_episodes=2", f"out={results}")
        yield "evaluation: episodes.csv", digest((results / "episodes.csv").read_bytes())
        call("course", "run=rcdsac_pow-narrow", "beta=[-2]", "repetitions=1", "time_limit_s=12", f"out={folder / 'c'}")
        for name in ("runs.csv", "traces.csv"):
            yield f"course: {name}", digest((folder / "c" / name).read_bytes())
        yield "export: answers of ONNX", digest(onnx_outputs("rcdsac_pow-narrow"))


def main() -> None:
    """Print or compare."""
    found = dict(record())
    if "--check" not in sys.argv[1:]:
        print("\n".join(f"{value}  {name}" for name, value in found.items()))
        return
    wanted = dict(line.split("  ", 1)[::-1] for line in RECORD.read_text(encoding="utf-8").splitlines())
    for name in sorted(wanted.keys() | found.keys()):
        if wanted.get(name) != found.get(name):
            print(f"differs: {name}: {wanted.get(name)} then, {found.get(name)} now")
    same = wanted == found
    print(f"{len(found)} hashes, {'all equal' if same else 'NOT all equal'}")
    raise SystemExit(0 if same else 1)


if __name__ == "__main__":
    main()
