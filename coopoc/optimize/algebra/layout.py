"""What problems of one structure share: the pattern of their Hessians, tapes, and analyses of the factorisation."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple, TypeAlias
from weakref import WeakValueDictionary

import numpy as np

from ...arrays import Bools, Floats, Ints
from ..model.problem import Problem
from .cholesky import Cholesky
from .dense_cholesky import DenseCholesky
from .entries import Entries, entries_of, places_of
from .tape import Kind, Model, NoTape, kind_of, write
from .tape_call import TapeCall

DENSE = 200
"""Unknowns up to which one dense matrix is as fast."""
Total: TypeAlias = Callable[[Floats, Sequence[Floats]], Floats]
"""(x (n, ambient), numbers of each factor) -> the cost, the gradient, the Hessian's values and a last number: waste."""


class Structure(NamedTuple):
    """All of a problem that is no number.

    Attributes:
        shape: n and dof.
        movable: (n, dof) as bytes; empty: all can move.
        factors: the kind of each and its nodes (M, arity) as bytes.
    """

    shape: tuple[int, int]
    movable: bytes
    factors: tuple[tuple[Kind, bytes], ...]


class Layout:
    """What problems of one structure share: the pattern of their Hessians, tapes, and analyses of the factorisation.

    Args:
        structure: of the problems.

    Raises:
        NoTape: a kind has none.
    """

    def __init__(self, structure: Structure) -> None:
        self.kinds = tuple(kind for kind, _ in structure.factors)
        self.nodes = tuple(
            np.frombuffer(raw, np.int64).reshape(-1, kind.measurement.arity) for kind, raw in structure.factors
        )
        for kind in self.kinds:
            write(kind, "newton")
        movable: Bools = np.frombuffer(structure.movable or b"\1" * int(np.prod(structure.shape)), bool)
        self.entries: Entries = entries_of(movable.reshape(structure.shape), self.nodes)
        self._places: dict[tuple[int, Model], Ints] = {}
        self._local = threading.local()

    @property
    def small(self) -> bool:
        """Whether CasADi runs the tapes and LAPACK factors one matrix: nothing must be compiled."""
        return self.entries.size <= DENSE

    @property
    def cholesky(self) -> Cholesky | DenseCholesky:
        """Factors of its Hessians; each thread has its own."""
        if not hasattr(self._local, "cholesky"):
            pattern = self.entries.indptr, self.entries.indices
            group = np.nonzero(self.entries.number >= 0)[0]
            self._local.cholesky = DenseCholesky(*pattern) if self.small else Cholesky(*pattern, group)
        return self._local.cholesky  # type: ignore[no-any-return]

    def total(self, model: Model) -> Total:
        """The sums of a model; each thread has its own."""
        if not hasattr(self._local, "totals"):
            self._local.totals = {}
        if model not in self._local.totals:
            self._local.totals[model] = self._called(model) if self.small else self._by_kernel(model)
        return self._local.totals[model]  # type: ignore[no-any-return]

    def _called(self, model: Model) -> Total:
        written = [write(kind, model) for kind in self.kinds]
        places = [self._place(k, model) for k in range(len(written))]
        return TapeCall(written, self.nodes, places, self._length(model))

    def _by_kernel(self, model: Model) -> Total:
        from ...kernels.graphs.graph_tape import accumulate

        tapes = [write(kind, model).tape for kind in self.kinds]
        places = [self._place(k, model) for k in range(len(tapes))]

        def total(x: Floats, numbers: Sequence[Floats]) -> Floats:
            out = np.zeros(self._length(model))
            with np.errstate(all="ignore"):
                for tape, nodes, own, place in zip(tapes, self.nodes, numbers, places, strict=True):
                    accumulate(tape, x, nodes, own, place, out)
            return out

        return total

    def _length(self, model: Model) -> int:
        return 2 if model == "cost" else self.entries.size + len(self.entries.indices) + 2

    def _place(self, k: int, model: Model) -> Ints:
        if (k, model) not in self._places:
            self._places[k, model] = places_of(self.entries, self.nodes[k], write(self.kinds[k], model).entries)
        return self._places[k, model]


def layout_of(problem: Problem) -> Layout | None:
    """The layout of a single problem, shared with others of its structure; None if a kind has no tape."""
    space, factors = problem.space, problem.factors
    structure = Structure(
        (len(problem.names), space.dof),
        b"" if problem.movable is None else problem.movable.tobytes(),
        tuple((kind_of(factor, space), factor.nodes.tobytes()) for factor in factors),
    )
    if len(problem.names) * space.dof <= DENSE:
        return _small(structure)
    if (layout := _LARGE.get(structure)) is None and (layout := _made(structure)) is not None:
        _LARGE[structure] = layout
    return layout


def _made(structure: Structure) -> Layout | None:
    try:
        return Layout(structure)
    except NoTape:
        return None


_small = lru_cache(maxsize=256)(_made)
"""Small problems come by the thousand with few structures."""
_LARGE: WeakValueDictionary[Structure, Layout] = WeakValueDictionary()
"""Of large ones the problem that is at hand and those that differ from it in numbers alone."""
