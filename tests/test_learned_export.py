"""Exported steps: ONNX by onnxruntime, against the net."""

import builtins
import json
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import refused
from export_onnx import AGREE, INPUTS, OUTPUTS, STEPS, agree, first_inputs, to_onnx
from shell import ROOT, python

from coopoc.arrays import AnyArray
from coopoc.errors import MissingLibraryError
from coopoc.learned import GainNet, OptimisedKF, checkpoint
from coopoc.learned.recipes import WEIGHTS

onnx, onnxruntime = pytest.importorskip("onnx"), pytest.importorskip("onnxruntime")
Step = Callable[[Sequence[AnyArray]], Sequence[AnyArray]]


@pytest.fixture(scope="module")
def shipped():
    return checkpoint.load(WEIGHTS / "fedkalmannet.safetensors")


@pytest.fixture(scope="module")
def file(shipped, tmp_path_factory):
    return to_onnx(shipped, tmp_path_factory.mktemp("export") / "step.onnx")


def steps(file):
    """The step of an exported file."""
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    return lambda arrays: session.run(list(OUTPUTS), dict(zip(INPUTS, arrays, strict=True)))


@pytest.mark.parametrize("lanes", [1, 7])
def test_any_number_of_lanes_with_missing_fixes(lanes, file, shipped):
    net, step, draw = shipped.model, steps(file), np.random.default_rng(3)
    assert isinstance(net, GainNet)
    inputs = first_inputs(net, draw.normal(0, 2, (lanes, 3)).tolist())
    inputs[7] = np.where(np.arange(lanes)[:, None] % 2 == 0, np.nan, inputs[7] + 1).astype(np.float32)
    memory, gain = net.step(net.start(torch.from_numpy(inputs[3])), *(torch.from_numpy(a) for a in inputs[-3:]))
    for ours, theirs in zip(step(inputs), (*memory, gain), strict=True):
        np.testing.assert_allclose(ours, theirs.detach().numpy(), atol=1e-5)


def test_the_file_is_checked_before_it_is_kept(tmp_path, monkeypatch):
    """A step that is off by 2e-5 m in one number after twenty steps is refused, and no file appears."""
    net, calls = GainNet(2, 1), iter(range(10 * STEPS))
    good = steps(to_onnx(net, tmp_path / "good.onnx"))
    assert agree(net, good) <= AGREE

    def off(arrays):
        found = [np.array(a) for a in good(arrays)]
        found[3][0, 0] += 2e-5 * (next(calls) == 20)
        return found

    with refused(r"export = differs by .* at step 21"):
        agree(net, off)
    with refused("export = differs by nan"):
        agree(net, lambda arrays: [np.full_like(a, np.nan) for a in good(arrays)])
    other = onnxruntime.InferenceSession(to_onnx(GainNet(2, 1, seed=1), tmp_path / "other.onnx"))
    monkeypatch.setattr(onnxruntime, "InferenceSession", lambda part, providers: other)
    with refused("export"):
        to_onnx(net, tmp_path / "bad.onnx")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["good.onnx", "other.onnx"]


def test_the_card_travels_along(file, shipped):
    assert json.loads({p.key: p.value for p in onnx.load(file).metadata_props}["card"]) == dict(shipped.card)


def test_the_file_names_its_arrays_and_no_machine(file):
    graph = onnx.load(file).graph
    onnx.checker.check_model(onnx.load(file), full_check=True)
    assert [i.name for i in graph.input] == list(INPUTS)
    assert [o.name for o in graph.output] == list(OUTPUTS)
    shapes = [[d.dim_param or d.dim_value for d in i.type.tensor_type.shape.dim] for i in graph.input]
    lanes = shapes[0][0]
    assert isinstance(lanes, str)
    assert shapes == [*[[lanes, 9]] * 3, *[[lanes, 3]] * 6, []]
    for place in (ROOT, Path(torch.__file__).parent, Path.cwd()):
        assert os.fsencode(place) not in file.read_bytes()


def test_other_models_and_a_missing_library_are_named(tmp_path, monkeypatch):
    okf = OptimisedKF((0.1,) * 3, (0.1,) * 3, (1.5,) * 3)
    with refused("model = OptimisedKF"):
        to_onnx(okf, tmp_path / "a.onnx")  # type: ignore[arg-type]
    find = builtins.__import__
    for name in ("onnx", "onnxruntime", "onnxscript"):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, name, None)
            with pytest.raises(MissingLibraryError, match=rf"needs {name}.*pip install .*\[export\]'"):
                to_onnx(GainNet(2, 1), tmp_path / "a.onnx")
    assert builtins.__import__ is find
    assert not list(tmp_path.iterdir())


def test_the_documented_program_needs_onnxruntime_and_numpy_only(file, tmp_path):
    """The last block of docs/streaming.md, as it stands, in a Python that cannot import coopoc, torch or onnx."""
    text = (ROOT / "docs" / "streaming.md").read_text()
    (block,) = [b for b in re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL) if "onnxruntime" in b]
    (tmp_path / "fedkalmannet.onnx").write_bytes(file.read_bytes())
    (tmp_path / "run.py").write_text(
        "import sys\nfor name in ('torch', 'coopoc', 'onnx'):\n    sys.modules[name] = None\n" + block
    )
    out = python("-W", "error", "run.py", cwd=tmp_path)
    x = np.array([float(word) for word in re.findall(r"-?\d+\.\d+", out)])
    assert x.shape == (3,)
    assert np.linalg.norm(x - [1090.0, 2000.0, 0.0]) < 3.0, "it drove 10 s at 9 m/s"
