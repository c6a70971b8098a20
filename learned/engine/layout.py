"""Where the compiled kernels find everything: the layers in theta and as matrices, the fields of the tape."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np

from coopoc.arrays import AnyArray, Bools, Ints

from ..nets.gain_net import CELLS, GainNet
from . import places as on
from .arithmetic import PAD, Index, whole
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


class Layout(NamedTuple):
    """`fields` of `tape.Tape`, and the lengths of its memory that is not kept and of what is kept."""

    fields: Ints
    passing: int
    kept: int


@dataclass(frozen=True, eq=False)
class Plan:
    """For nets of one shape: `layers` of `tape.Net` and its `places` where all matrices are turned, none, or those with
    more outputs than inputs (3, P); the lengths of theta and of the memory of the matrices."""

    layers: Ints
    places: AnyArray
    parameters: int
    size: int

    @lru_cache(maxsize=64)  # noqa: B019  (plans live as long as the process)
    def tape(self, lanes: int, kept: int, passing: int = 1) -> Layout:
        """Of B lanes, with slots for so many steps; if there are several, wide fields are computed again, not kept."""
        wide, hidden = self.layers[on.UPDATE, 2], self.layers[on.HIDDEN, 2]
        widths = np.array([PAD, PAD, whole(wide), whole(wide + PAD), whole(2 * wide + PAD), *[PAD] * 3, *[4 * PAD] * 3,
                           3 * PAD, whole(hidden), PAD])  # fmt: skip
        again = np.zeros(len(widths), np.bool_)
        again[[on.CORRECTED, on.PRIOR_IN, on.INNOVATION_IN, on.HIDDEN_OUT]] = lanes > 1
        return _layout(lanes * widths * np.where(again, passing, kept), widths, ~again)

    @lru_cache(maxsize=64)  # noqa: B019
    def deltas(self, lanes: int, steps: int) -> Layout:
        """Of the gradients of the layers' outputs, none of which is kept."""
        wide, hidden = self.layers[on.UPDATE, 2], self.layers[on.HIDDEN, 2]
        widths = np.array([whole(wide), whole(wide), whole(2 * wide + PAD), *[3 * PAD] * 6, whole(hidden), *[PAD] * 3])
        return _layout(lanes * widths * steps, widths, widths < 0)


def _layout(sizes: Ints, widths: Ints, kept: Bools) -> Layout:
    """Fields one after the other in the memory that is kept or in the other; products read a bit behind their end."""
    begin = np.where(kept, np.cumsum(sizes * kept), np.cumsum(sizes * ~kept)) - sizes
    fields = np.stack([begin, widths, kept], axis=1).astype(np.int64)
    return Layout(fields, int(sizes[~kept].sum()) + 2 * PAD, int(sizes[kept].sum()) + 2 * PAD)


@cache
def plan_of(settings: tuple[tuple[str, Any], ...]) -> Plan:
    """The plan of nets with these settings."""
    begin, shapes, at = {}, {}, 0
    for name, parameter in GainNet(**dict(settings)).named_parameters():
        begin[name], shapes[name] = at, parameter.shape
        at += parameter.numel()
    found, size = [], 0
    for name, last, relu, field, column, delta in LAYERS:
        outputs, inputs = shapes[name]
        behind = shapes["observation.weight"][0] if name == "prior_to_innovation.weight" else 0
        found.append([begin[name], begin[name.replace("weight", "bias")], outputs, inputs, size, last, relu, field,
                      column, delta, behind])  # fmt: skip
        size += room(outputs, inputs)
    layers = np.array(found)
    return Plan(layers, np.stack([_places(layers, at, which) for which in range(3)]), at, size)


def _places(layers: Ints, parameters: int, which: int) -> AnyArray:
    """(P,) a row of `Plan.places`."""
    places = np.empty(parameters, np.uint32)  # numba asks of every signed index whether it counts from the end
    for weight, bias, outputs, inputs, at, last, *_ in layers:
        o, i = np.arange(outputs)[:, None], (np.arange(inputs) - last) % inputs
        turned = (True, False, outputs > inputs)[which]
        places[weight : weight + outputs * inputs] = (
            at + (i * whole(outputs) + o if turned else o * whole(inputs + PAD - 9) + i)).ravel()  # fmt: skip
        places[bias : bias + outputs] = at + room(outputs, inputs) - whole(outputs) + o[:, 0]
    return places
