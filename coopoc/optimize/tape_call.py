"""The tapes of a small problem, run by CasADi's own machine: nothing is compiled for ten measurements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..arrays import Floats, Ints
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
        self._calls, self._length = [], length
        self._out = np.empty(sum(place.size for place in places))
        self._places = np.concatenate([np.empty(0, np.int64), *(place.T.ravel() for place in places)])
        end = 0
        for tape, touched, place in zip(written, nodes, places, strict=True):
            end, begin = end + place.size, end
            self._calls.append(_Call(tape.function.map(len(touched)), touched, self._out[begin:end]))

    def __call__(self, x: Floats, numbers: Sequence[Floats]) -> Floats:
        for call, own in zip(self._calls, numbers, strict=True):
            call.run(x, own)
        total: Any = np.bincount(self._places, self._out, self._length)
        return np.asarray(total)


class _Call:
    """A CasADi function of (inputs, M) numbers whose memory is bound once."""

    def __init__(self, function: Any, nodes: Ints, out: Floats) -> None:
        self._nodes, self._width = nodes, function.size1_in(0)
        self._inputs = np.empty((len(nodes), self._width))
        flat: Any = self._inputs.reshape(-1)
        held: Any = out
        self._buffer, self._trigger = function.buffer()
        self._buffer.set_arg(0, memoryview(flat))
        self._buffer.set_res(0, memoryview(held))

    def run(self, x: Floats, numbers: Floats) -> None:
        """Fill the outputs."""
        split = self._width - len(numbers)
        self._inputs[:, :split] = x[self._nodes].reshape(len(self._nodes), -1)
        self._inputs[:, split:] = numbers.T
        self._trigger()
