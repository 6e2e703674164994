"""What is exported computes what torch computes; the command says by how much, and refuses before it writes."""

import importlib
import importlib.util
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

import rcdsac_trl
from rcdsac_trl.config.compose import compose
from rcdsac_trl.deploy import Policy
from rcdsac_trl.deploy.export.exported import LIMIT, Exported, betas_of, check_extra, differences, export_agent
from rcdsac_trl.deploy.policy.inference import Array
from rcdsac_trl.deploy.policy.weights import packed, read_weights
from rcdsac_trl.errors import FaultError, UserInputError
from rcdsac_trl.release.agent_export import Export, make_export
from robots import AHEAD, OPEN, ROWS, STANDING, full_size
from tiny import untrained_run

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxscript")
pytest.importorskip("onnxruntime")
torch.set_num_threads(1)
PROGRAMS = {"actor.onnx", "actor.pt2", "critics.onnx", "critics.pt2"}
FILES = PROGRAMS | {"README.md", "config.json", "training.yaml", "weights.safetensors"}


@pytest.mark.slow
@pytest.mark.parametrize("name", ROWS)
def test_programs_of_the_paper_s_size_agree_over_1000_steps_at_every_beta(name: str) -> None:
    remembers = {"restart_steps": 4, "memory_s": 12.0, "look_ahead": True} if name == "rcdsac_cvar" else {}
    weights = full_size(**ROWS[name], **remembers)
    found = differences(export_agent(weights, 16), weights, betas=betas_of(weights))
    assert max(found.values()) <= LIMIT, found


def shifted(exported: Exported, by: float) -> Exported:
    actor, critics = exported.runners["ONNX Runtime"]

    def off(inputs: dict[str, Array]) -> tuple[Array, Array]:
        action, memory = actor(inputs)
        return action + np.float32(by), memory

    return Exported(exported.files, exported.runners | {"ONNX Runtime": (off, critics)})


def test_the_command_writes_a_folder_that_load_reads(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    remembers = "network.restart_steps=2", "sensor.memory_s=12", "network.look_ahead=true"
    run, _, _ = untrained_run(tmp_path / "run", "rcdsac_pow", "network.conv=4", "network.range=8", *remembers)
    asked = [f"run={run}", "checkpoint=last", "num_quantiles=4"]
    export = make_export(compose("export", asked))
    # An export takes its time: this one serves both runs.
    made = export_agent(export.weights, 4)
    module = importlib.import_module("rcdsac_trl.release.agent_export")
    monkeypatch.setattr(module, "export_agent", lambda *_: made)
    found = export.run(steps=20)
    assert found.keys() == {"ONNX Runtime", "torch.export", "NumPy"}
    out = run / "export" / "last"
    assert {path.name for path in out.iterdir()} == FILES
    assert f"NumPy: largest difference from torch {found['NumPy']:.1e}" in capfd.readouterr().out
    loaded = rcdsac_trl.load(out).act(OPEN, AHEAD, STANDING, -2.0)
    assert loaded.wanted == Policy(export.weights).act(OPEN, AHEAD, STANDING, -2.0).wanted
    assert packed(read_weights(out)) == packed(export.weights)
    # What docs/robot.md says of them: ONNX Runtime 1.18 is the first that reads these versions, and batches are of 1.
    for name in ("actor.onnx", "critics.onnx"):
        model = onnx.load(out / name)
        assert (model.ir_version, [(opset.domain, opset.version) for opset in model.opset_import]) == (10, [("", 20)])
        sizes = {given.name: [dim.dim_value for dim in given.type.tensor_type.shape.dim] for given in model.graph.input}
        assert sizes["range"] == [1, 180]
        assert sizes.get("memory", [1])[0] == sizes.get("memories", [2, 1])[1] == 1
    with pytest.raises(UserInputError, match="is not empty"):
        make_export(compose("export", asked))

    # What differs is not written.
    monkeypatch.setattr(module, "export_agent", lambda *_: shifted(made, 2.0 * LIMIT))
    with pytest.raises(FaultError, match=r"differs from torch by 2\.\de-05, more than 1e-05: nothing was written"):
        Export(export.weights, tmp_path / "other", 4).run(steps=5)
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ([], "name what to export: run=<folder>"),
        (["run=nowhere"], "there is no agent 'nowhere': .* agents` lists what there is"),
        (["run=x", "num_quantiles=0"], "num_quantiles=0 must be at least 1"),
        (["run=x", "checkpoint=newest"], "checkpoint=newest must be one of best, last"),
    ],
)
def test_what_cannot_be_exported_is_refused(asked: list[str], told: str) -> None:
    with pytest.raises(UserInputError, match=told):
        make_export(compose("export", asked))


def test_a_missing_package_is_named_with_the_line_that_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    there: Callable = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "onnxruntime" else there(name))
    with pytest.raises(UserInputError, match=r"onnxruntime is not installed: pip install 'rcdsac-trl\[export\]'"):
        check_extra()
