"""The tapes of a small problem, run by CasADi's own machine: nothing is compiled for ten measurements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...arrays import Floats, Ints
from .tape import Written


class TapeCall:
    """(x (n, ambient), numbers of each factor (P, M)) -> the outputs of all tapes, added up in (length,) numbers.

    Not for several threads at once: inputs and outputs have one place in memory.

    Args:
        written: the tape of each factor.
        nodes: (M, arity) of each.
        places: (outputs, M) of each, where its outputs are added.
        length: of the sums.
    """

    def __init__(self, written: Sequence[Written], nodes: Sequence[Ints], places: Sequence[Ints], length: int) -> None:
        self._length = length
        self._touched = np.concatenate([np.empty(0, np.int64), *(touched.ravel() for touched in nodes)])
        self._places = np.concatenate([np.empty(0, np.int64), *(place.T.ravel() for place in places)])
        ambient = written[0].function.size1_in(0) // nodes[0].shape[1] if written else 0
        self._local, self._out = np.empty((len(self._touched), ambient)), np.empty(len(self._places))
        self._numbers, self._triggers, self._buffers = [], [], []
        top = end = 0
        for tape, touched, place in zip(written, nodes, places, strict=True):
            top, first, end, begin = top + touched.size, top, end + place.size, end
            number = np.empty((len(touched), tape.function.size1_in(1)))
            buffer, trigger = tape.function.map(len(touched)).buffer()
            for k, memory in enumerate((self._local[first:top], number)):
                buffer.set_arg(k, _bound(memory.reshape(-1)))
            buffer.set_res(0, _bound(self._out[begin:end]))
            self._numbers.append(number.T)
            self._triggers.append(trigger)
            self._buffers.append(buffer)

    def __call__(self, x: Floats, numbers: Sequence[Floats]) -> Floats:
        if self._buffers:
            x.take(self._touched, 0, self._local, "clip")  # without "clip" NumPy copies through a buffer
        for own, given, trigger in zip(self._numbers, numbers, self._triggers, strict=True):
            own[:] = given
            trigger()
        total: Any = np.bincount(self._places, self._out, self._length)
        return np.asarray(total)


def _bound(memory: Any) -> Any:
    return memoryview(memory)
