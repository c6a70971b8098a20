"""Export: one step of a GainNet as a pure function in ONNX, derived from `GainNet.step` and checked against it.

python examples/export_onnx.py learned/weights/fedkalmannet.safetensors fedkalmannet.onnx
"""

import importlib
import json
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from coopoc.arrays import AnyArray
from coopoc.errors import InputError, MissingLibraryError
from coopoc.learned.checkpoint import Checkpoint, load
from coopoc.learned.engine.forward import State
from coopoc.learned.nets.gain_net import GainNet
from coopoc.paths import given_path, replaceable
from coopoc.world.sensors import stream

INPUTS = (*State._fields, "gnss", "velocity", "dt")
"""Memory (B, 9) and (B, 3) m, fix (B, 3) m or NaN, velocity (B, 3) m/s, dt s without a dimension."""
OUTPUTS = (*(f"next_{name}" for name in State._fields), "gain")
"""Memory after the step, of which `next_x` (B, 3) m is the estimate, and the gain (B, 3, 3)."""
AGREE = 1e-5
"""Largest difference of any number of any step from the net's own, m where it is a position."""
STEPS, LANES = 50, 3
Run = Callable[[Sequence[AnyArray]], Sequence[AnyArray]]
"""One exported step: arrays in the order of INPUTS -> arrays in the order of OUTPUTS."""


class Step(nn.Module):
    """`GainNet.step` with the memory as separate tensors, in the order of INPUTS -> in that of OUTPUTS."""

    def __init__(self, net: GainNet) -> None:
        super().__init__()
        self.net = net

    def forward(
        self,
        process: Tensor,
        prior: Tensor,
        innovation: Tensor,
        x: Tensor,
        x_before: Tensor,
        prior_before: Tensor,
        gnss_before: Tensor,
        gnss: Tensor,
        velocity: Tensor,
        dt: Tensor,
    ) -> tuple[Tensor, ...]:
        """One step."""
        memory = State(process, prior, innovation, x, x_before, prior_before, gnss_before)
        new, gain = self.net.step(memory, gnss, velocity, dt)
        return (*new, gain)


def to_onnx(model: GainNet | Checkpoint, path: Path | str) -> Path:
    """Write one step of the net to an ONNX file of INPUTS and OUTPUTS, any number of lanes B at once.

    The first memory is that of `GainNet.start`: process and innovation the unit matrix (9 numbers), prior zeros, and
    the four positions x0. Give fixes relative to the start: the file computes in the net's float32. Its metadata
    holds the checkpoint's card under "card" if there is one. onnxruntime runs it against the net over 50 random steps
    before the file is kept.

    Args:
        model: net, or checkpoint of one.
        path: of the file, which is written whole or not at all.

    Raises:
        InputError: no GainNet, or the exported step differs by more than 1e-5.
        MissingLibraryError: onnx, onnxruntime or onnxscript is not installed.

    >>> INPUTS[-3:], OUTPUTS[3]
    (('gnss', 'velocity', 'dt'), 'next_x')
    """
    net, card = _parts(model)
    onnx, runtime = (_library(name) for name in ("onnx", "onnxruntime"))
    _library("onnxscript")
    lanes = tuple({0: torch.export.Dim.DYNAMIC} for _ in INPUTS[:-1])
    with _quiet(FutureWarning, "`isinstance.treespec, LeafSpec.` is deprecated"):
        program = torch.onnx.export(
            Step(net).eval(),
            _example(net),
            dynamo=True,
            dynamic_shapes=(*lanes, {}),
            input_names=INPUTS,
            output_names=OUTPUTS,
            verbose=False,
        )
    assert program is not None
    file = program.model_proto
    graph = file.graph
    for part in (*graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer):
        del part.metadata_props[:]  # source lines of this machine
    onnx.helper.set_model_props(file, dict(card))

    def run(session: Any) -> Run:
        return lambda arrays: session.run(None, dict(zip(INPUTS, arrays, strict=True)))

    return _kept(
        path,
        lambda part: onnx.save(file, part),
        net,
        lambda part: run(runtime.InferenceSession(part, providers=["CPUExecutionProvider"])),
    )


def first_inputs(net: GainNet, x0: Sequence[Sequence[float]]) -> list[AnyArray]:
    """INPUTS of a step right after the start at x0 (B, 3) m: no motion, the fix there, dt 0.1 s."""
    start = torch.tensor(x0, dtype=next(net.parameters()).dtype)
    rest = (start, torch.zeros_like(start), torch.tensor(0.1, dtype=start.dtype))
    return [a.detach().clone().numpy() for a in (*net.start(start), *rest)]


def agree(net: GainNet, run: Run) -> float:
    """Largest difference of any number between an exported step and the net's own over 50 random steps of a drive.

    Raises:
        InputError: it is more than 1e-5, or not a number.
    """
    draw, dtype = stream(0, "export", 0, "steps"), next(net.parameters()).detach().numpy().dtype
    mine = theirs = first_inputs(net, draw.normal(0, 2, (LANES, 3)).tolist())
    where, worst = mine[3].astype(float), 0.0
    for number in range(STEPS):
        dt, velocity = draw.uniform(0.02, 0.3), draw.normal(0, 8, (LANES, 3)) * (-1) ** (number // 5)
        where = where + dt * velocity
        fix = np.where(draw.uniform(size=(LANES, 1)) < 0.1, np.nan, where + draw.normal(0, 2, (LANES, 3)))
        given = [np.asarray(a, dtype=dtype) for a in (fix, velocity, dt)]
        with torch.inference_mode():
            own = [a.numpy() for a in Step(net)(*(torch.from_numpy(a) for a in (*mine[:-3], *given)))]
        outputs = list(run([*theirs[:-3], *given]))
        gaps = [float(np.abs(a - b).max()) for a, b in zip(own, outputs, strict=True)]
        worst = max(worst, *gaps) if np.isfinite(gaps).all() else np.nan
        if not worst <= AGREE:
            raise InputError(
                "export",
                f"differs by {worst:g} at step {number + 1}",
                f"must agree to {AGREE:g}",
                "Nothing was written; try another version of the exporting library.",
            )
        mine, theirs = [*own[:-1], *given], [*outputs[:-1], *given]
    return worst


def _example(net: GainNet) -> tuple[Tensor, ...]:
    """Inputs to trace: two lanes, as a single one may be taken for a constant."""
    return tuple(torch.from_numpy(a) for a in first_inputs(net, [[0.0, 0.0, 0.0], [1.0, 2.0, 0.0]]))


def _kept(path: Path | str, write: Callable[[Path], None], net: GainNet, load: Callable[[Path], Run]) -> Path:
    """Write beside `path`, check, and only then put it there."""
    path = given_path(path)
    replaceable(path).parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        write(part)
        agree(net, load(part))
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
    return path


def _parts(model: GainNet | Checkpoint) -> tuple[GainNet, Mapping[str, str]]:
    """The net, and its card as text under "card"."""
    net = model.model if isinstance(model, Checkpoint) else model
    if not isinstance(net, GainNet):
        raise InputError(
            "model",
            type(net).__name__,
            "must be a GainNet",
            "No other net has an exported step; stream it: method.start().",
        )
    return net, {"card": json.dumps(dict(model.card), sort_keys=True)} if isinstance(model, Checkpoint) else {}


@contextmanager
def _quiet(category: type[Warning], message: str) -> Iterator[None]:
    """Without torch's own warnings of that kind, and without its log of libraries that it does not need."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message, category)
            yield
    finally:
        log.setLevel(level)


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingLibraryError(name, "exporting to ONNX", "'coopoc[export]'") from error


if __name__ == "__main__":
    print(to_onnx(load(sys.argv[1]), sys.argv[2]))
