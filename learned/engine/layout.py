"""Where the compiled kernels find everything: the layers in theta and as matrices, the fields of the tape."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np

from coopoc.arrays import AnyArray, Bools, Ints
from coopoc.learned.engine.arguments import Matrices, Memory

from . import places as on
from .arithmetic import PAD, Index, whole
from .places import CELLS
from .tape import room

LAYERS: tuple[tuple[str, int, bool, Index, Index, int], ...] = (
    ("update.weight", 0, True, on.FEATURES, 12, 0),
    ("evolution.weight", 0, True, on.FEATURES, 8, 1),
    ("observation.weight", 0, True, on.FEATURES, 0, 2),
    ("process.weight_ih", 0, False, on.CORRECTED, 0, 3),
    ("process.weight_hh", 0, False, on.PROCESS_OLD, 0, 4),
    ("prior.weight_ih", CELLS, False, on.PRIOR_IN, 0, 5),
    ("prior.weight_hh", 0, False, on.PRIOR_OLD, 0, 6),
    ("prior_to_innovation.weight", 0, True, on.CORE, on.CORE_PRIOR, 2),
    ("innovation.weight_ih", CELLS, False, on.INNOVATION_IN, 0, 7),
    ("innovation.weight_hh", 0, False, on.INNOVATION_OLD, 0, 8),
    ("gain_hidden.weight", 0, True, on.CORE, on.CORE_PRIOR, 9),
    ("gain.weight", 0, False, on.HIDDEN_OUT, 0, 10),
    ("posterior_hidden.weight", 0, True, on.CORE, on.CORE_INNOVATION, 11),
    ("posterior.weight", CELLS, True, on.CORE, 0, 12),
)
"""The layers in the order of the kernels: how many of their inputs, the first ones, come last on the tape; whether a
ReLU follows; field and first column of their inputs; and the field of the deltas for the gradient of their outputs."""


Shapes: TypeAlias = tuple[tuple[str, tuple[int, ...]], ...]
"""Names and shapes of a net's parameters, in the order of theta."""
PRODUCT = 128
"""Rows of one weight-gradient product, so few that they stay in the cache until it."""


class Layout(NamedTuple):
    """`fields` of `tape.Tape`, and the lengths of its memory for a few steps and for all."""

    fields: Ints
    passing: int
    kept: int


@dataclass(frozen=True, eq=False)
class Plan:
    """For nets of one shape: layout of the matrices, number of parameters, length of the memory of the matrices."""

    matrices: Matrices
    parameters: int
    size: int

    @lru_cache(maxsize=64)  # noqa: B019  (plans live as long as the process)
    def memory(self, lanes: int, steps: int, gradient: bool) -> Memory:
        """Memory for B lanes: for a gradient the tape has all steps, else one.

        With several lanes the wide fields are computed again, not kept.
        """
        slots = min(steps, -(-PRODUCT // lanes)) if gradient else 1
        wide, hidden = (whole(self.matrices.layers[layer, 2]) for layer in (on.UPDATE, on.HIDDEN))
        seen, moved = whole(2 * wide + PAD), whole(wide + PAD)
        widths = np.array([PAD, PAD, wide, moved, seen, *[PAD] * 3, *[4 * PAD] * 3, 3 * PAD, hidden, PAD])
        again = np.zeros(len(widths), np.bool_)
        again[[on.CORRECTED, on.PRIOR_IN, on.INNOVATION_IN, on.HIDDEN_OUT]] = lanes > 1
        tape = _layout(lanes * widths * np.where(again, slots, steps if gradient else 1), widths, ~again)
        widths = np.array([wide, wide, seen, *[3 * PAD] * 6, hidden, *[PAD] * 3])
        deltas = _layout(lanes * widths * slots, widths, widths < 0)
        return Memory(tape.fields, deltas.fields, self.size, tape.kept, tape.passing, deltas.passing, slots)


def _layout(sizes: Ints, widths: Ints, kept: Bools) -> Layout:
    """Fields one after the other in the memory that is kept or in the other; products read a bit behind their end."""
    begin = np.where(kept, np.cumsum(sizes * kept), np.cumsum(sizes * ~kept)) - sizes
    fields = np.stack([begin, widths, kept], axis=1).astype(np.int64)
    return Layout(fields, int(sizes[~kept].sum()) + 2 * PAD, int(sizes[kept].sum()) + 2 * PAD)


@cache
def plan_of(shapes: Shapes) -> Plan:
    """The plan of nets with parameters of these names and shapes."""
    begin, at, size, found = {}, 0, 0, []
    for name, shape in shapes:
        begin[name] = at
        at += math.prod(shape)
    sizes = dict(shapes)
    for name, last, relu, field, column, delta in LAYERS:
        outputs, inputs = sizes[name]
        behind = sizes["observation.weight"][0] if name == "prior_to_innovation.weight" else 0
        starts = begin[name], begin[name.replace("weight", "bias")]
        found.append([*starts, outputs, inputs, size, last, relu, field, column, delta, behind])
        size += room(outputs, inputs)
    layers = np.array(found)
    tall = layers[:, 2] > layers[:, 3]
    transposed = np.stack([tall | True, tall & False, tall])
    return Plan(Matrices(layers, transposed, np.stack([_places(layers, at, rows) for rows in transposed])), at, size)


def _places(layers: Ints, parameters: int, transposed: Bools) -> AnyArray:
    """(P,) a row of `Matrices.places`."""
    places = np.empty(parameters, np.uint32)  # numba asks of every signed index whether it counts from the end
    for (weight, bias, outputs, inputs, at, last, *_), across in zip(layers, transposed, strict=True):
        o, i = np.arange(outputs)[:, None], (np.arange(inputs) - last) % inputs
        padded = i * whole(outputs) + o if across else o * whole(inputs + PAD - 9) + i
        places[weight : weight + outputs * inputs] = (at + padded).ravel()
        places[bias : bias + outputs] = at + room(outputs, inputs) - whole(outputs) + o[:, 0]
    return places
