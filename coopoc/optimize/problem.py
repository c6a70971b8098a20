"""Problem: points and factors between them; whitened residuals, their exact Jacobian and the cost."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..arrays import Bools, Floats, Ints
from ..errors import InputError
from .factor import Factor, numbers

if TYPE_CHECKING:
    from ..world.recording import Recording
    from .sights import Noise


@dataclass(frozen=True, eq=False)
class Linear:
    """The problem around a point x: per factor, whitened residuals and their derivative by the factor's vector.

    The vector is the point itself or second - first, so the first point's derivative is minus the second's.

    Args:
        x: (B, n, 3) m. residual: per factor (B, M, size). slope: per factor (B or 1, M, size, 3).
    """

    x: Floats
    residual: tuple[Floats, ...]
    slope: tuple[Floats, ...]

    @property
    def cost(self) -> Floats:
        """(B,) 1/2 sum of squared residuals."""
        return half_squares(self.residual, len(self.x))

    def pick(self, which: Bools | Ints) -> Linear:
        """The realisations `which` of B."""
        slope = tuple(s[which] if len(s) > 1 else s for s in self.slope)
        return Linear(self.x[which], tuple(r[which] for r in self.residual), slope)


@dataclass(frozen=True, eq=False)
class Problem:
    """minimise over n points 1/2 sum_k |W_k (h_k(x) - z_k)|^2, for one or for B noise realisations at once.

    Args:
        names: (n,) unique names of the points.
        factors: the measurements.
        x0: (n, 3) or (B, n, 3) m where the solver starts; None: the converted measurements' linear solution.
        hub: points that the others hang on, such as the ego at each step. What remains without them must fall into
            small groups (the neighbours); they are eliminated last; the last of them is the one a Solution shows.

    Raises:
        InputError: repeated names, factors or a hub on unknown points, shapes that do not agree.

    >>> problem = Problem(("a", "b")).add("position", "a", [0, 0, 0], std=1.0)
    >>> problem = problem.add("displacement", ("a", "b"), [5, 0, 0], std=1.0)
    >>> problem.cost(np.array([[0, 0, 0], [6.0, 0, 0]]))
    0.5
    """

    names: tuple[str, ...]
    factors: tuple[Factor, ...] = ()
    x0: Floats | None = None
    hub: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(str(name) for name in self.names))
        if len(set(self.names)) != len(self.names):
            twice = sorted({n for n in self.names if self.names.count(n) > 1})
            raise InputError("names", twice[:3], "must be unique", "Rename the points that share a name.")
        object.__setattr__(self, "hub", tuple(self.index(point) for point in self.hub))
        if len(set(self.hub)) < len(self.hub):
            raise InputError("hub", self.hub, "must not name a point twice", "Name each point of the hub once.")
        for factor in self.factors:
            _check_nodes(self, factor.nodes)
        if self.x0 is not None:
            object.__setattr__(self, "x0", _points(self, "x0", self.x0))
        sizes = {b for b in (*(f.batch for f in self.factors), self._start_batch) if b is not None and b > 1}
        if len(sizes) > 1:
            mend = "Use the same number of realisations throughout."
            raise InputError("factors", f"{sorted(sizes)} realisations", "must agree", mend)

    @property
    def _start_batch(self) -> int | None:
        return len(self.x0) if self.x0 is not None and self.x0.ndim == 3 else None

    @property
    def batch(self) -> int | None:
        """B noise realisations, or None for a single problem."""
        sizes = [b for b in (*(f.batch for f in self.factors), self._start_batch) if b is not None]
        return max(sizes) if sizes else None

    def index(self, point: str | int) -> int:
        """Index of a point given by name or index; InputError if there is none."""
        if isinstance(point, str) and point in self.names:
            return self.names.index(point)
        if isinstance(point, int | np.integer) and 0 <= point < len(self.names):
            return int(point)
        known = ", ".join(self.names[:8]) + (", ..." if len(self.names) > 8 else "")
        raise InputError("node", repr(point), f"must be an index < {len(self.names)} or one of {known}",
                         "Name the point when the Problem is made.")  # fmt: skip

    def add(
        self,
        kind: str,
        nodes: str | int | Sequence[str | int] | Sequence[Sequence[str | int]],
        z: npt.ArrayLike,
        std: npt.ArrayLike | None = None,
        sqrt_information: npt.ArrayLike | None = None,
    ) -> Problem:
        """The problem with one more measurement, or with M of one kind; the arguments are those of Factor.

        Args:
            nodes: one point ("a"), a pair (("a", "b")), or a list of M points or pairs; names or indices.
            z: (size,), a number, or (M, size).
        """
        factor = Factor(kind, *_rows(self, kind, nodes, z), std=std, sqrt_information=sqrt_information)  # type: ignore[arg-type]
        return replace(self, factors=(*self.factors, factor))

    def pick(self, which: Ints | int) -> Problem:
        """The realisations `which` of B; an int gives a single problem."""
        picked = object.__new__(Problem)
        x0 = self.x0 if self._start_batch is None or self.x0 is None else self.x0[which]
        factors = tuple(f.pick(which) for f in self.factors)
        for name, value in {"names": self.names, "factors": factors, "x0": x0, "hub": self.hub}.items():
            object.__setattr__(picked, name, value)
        return picked

    def residuals(self, x: Floats) -> tuple[Floats, ...]:
        """Whitened residuals (B, M, size) of each factor at x (B, n, 3)."""
        out = []
        for factor in self.factors:
            known = factor.measurement
            gap = known.difference(known.predict(vector(x, factor.nodes)), factor.z)
            out.append(factor.whiten(gap)[0])
        return tuple(out)

    def linearise(self, x: Floats) -> Linear:
        """Whitened residuals and derivatives at x (B, n, 3)."""
        residuals, slopes = [], []
        for factor in self.factors:
            known = factor.measurement
            predicted, slope = known.differentiate(vector(x, factor.nodes))
            residual, slope = factor.whiten(known.difference(predicted, factor.z), slope)  # type: ignore[assignment]
            residuals.append(residual)
            slopes.append(slope if slope.ndim == 4 else slope[None])
        return Linear(x, tuple(residuals), tuple(slopes))

    def whiten(self, x: npt.ArrayLike) -> tuple[Floats, Any]:
        """Residual r (rows,) and sparse Jacobian J (rows, 3n) of a single problem at x (n, 3): cost = 1/2 r.r."""
        linear = self.linearise(_points(self, "x", x, (2,))[None])
        return np.concatenate([r.ravel() for r in linear.residual]), jacobian(self, linear)

    def cost(self, x: npt.ArrayLike) -> float:
        """1/2 sum of squared whitened residuals of a single problem at x (n, 3)."""
        return float(half_squares(self.residuals(_points(self, "x", x, (2,))[None]), 1)[0])

    @classmethod
    def from_snapshot(
        cls, recording: Recording, step: int, ego: int | str, run: int | None = 0, noise: Noise | None = None
    ) -> Problem:
        """The star of one step: fixes of the ego and its linked neighbours, spherical factors between them.

        All messages of the step are taken as received; `CooperativeMAP` obeys the channel instead.

        Args:
            recording: what was measured. step: t. ego: column or id. run: realisation, None for all R at once.
            noise: what is assumed of it, default the recording's sensors.

        Raises:
            InputError: unknown ego, step or run.
        """
        from .sights import window_problem

        return window_problem(recording, step, ego, 1, run, noise)

    @classmethod
    def from_window(
        cls, recording: Recording, step: int, ego: int | str, length: int, run: int | None = 0,
        noise: Noise | None = None,
    ) -> Problem:  # fmt: skip
        """The stars of the last `length` steps, one point per vehicle and step, joined by odometry dt u.

        Arguments and errors as `from_snapshot`; the first step of the window must exist.
        """
        from .sights import window_problem

        return window_problem(recording, step, ego, length, run, noise)

    def __repr__(self) -> str:
        kinds = ", ".join(f"{len(f.nodes)} {f.kind}" for f in self.factors)
        runs = "" if self.batch is None else f", {self.batch} realisations"
        return f"Problem({len(self.names)} points; {kinds or 'no factors'}{runs})"


def half_squares(residuals: Sequence[Floats], batch: int) -> Floats:
    """(B,) 1/2 sum of squares over all factors."""
    total = np.zeros(batch)
    for residual in residuals:
        total += 0.5 * np.einsum("bmk,bmk->b", residual, residual)
    return total


def jacobian(problem: Problem, linear: Linear, which: int = 0) -> Any:
    """Sparse Jacobian (rows, 3n) of one realisation, CSR."""
    from scipy.sparse import csr_array

    data, rows, cols, top = [np.empty(0)], [np.empty(0, np.int64)], [np.empty(0, np.int64)], 0
    for factor, slope in zip(problem.factors, linear.slope, strict=True):
        block = slope[which if len(slope) > 1 else 0]
        block = np.broadcast_to(block, (len(factor.nodes), *block.shape[1:]))
        count, size = block.shape[:2]
        row = top + np.arange(count * size).reshape(count, size, 1) + np.zeros(3, np.int64)
        for column, sign in zip(factor.nodes.T, (1.0,) if factor.nodes.shape[1] == 1 else (-1.0, 1.0), strict=True):
            data.append(sign * block.ravel())
            rows.append(row.ravel())
            cols.append((3 * column[:, None, None] + np.arange(3) + np.zeros((size, 1), np.int64)).ravel())
        top += count * size
    entries = (np.concatenate(data), (np.concatenate(rows), np.concatenate(cols)))
    return csr_array(entries, shape=(top, 3 * len(problem.names)))


def vector(x: Floats, nodes: Ints) -> Floats:
    """(B, M, 3) the vector that each row of nodes measures."""
    if nodes.shape[1] == 1:
        return x[:, nodes[:, 0]]
    vector: Floats = x[:, nodes[:, 1]] - x[:, nodes[:, 0]]
    return vector


def _rows(problem: Problem, kind: str, nodes: Any, z: npt.ArrayLike) -> tuple[Ints, Floats]:
    """Nodes (M, arity) as indices and z (M, size), from what a user writes."""
    from .measurements import lookup

    known = lookup(kind)
    flat = [nodes] if isinstance(nodes, str) or not isinstance(nodes, Iterable) else list(nodes)
    flat = [p for row in flat for p in (row if isinstance(row, list | tuple | np.ndarray) else [row])]
    if len(flat) % known.arity or not flat:
        raise InputError("nodes", nodes, f"must name {known.arity} points per {kind}", "Give points by name or index.")
    index = np.array([problem.index(p) for p in flat]).reshape(-1, known.arity)
    values = numbers(f"z of {kind}", z)
    return index, values.reshape(len(index), -1) if values.ndim < 2 and values.size % len(index) == 0 else values


def _check_nodes(problem: Problem, nodes: Ints) -> None:
    bad = (nodes < 0) | (nodes >= len(problem.names))
    if bad.any():
        problem.index(int(nodes[bad][0]))


def _points(problem: Problem, field: str, x: npt.ArrayLike, ranks: tuple[int, ...] = (2, 3)) -> Floats:
    array = numbers(field, x)
    if array.ndim not in ranks or array.shape[-2:] != (len(problem.names), 3) or not np.isfinite(array).all():
        shape = f"must be finite with shape ({len(problem.names)}, 3)" + (", or (B, n, 3)" if 3 in ranks else "")
        given = f"shape {array.shape}" if np.isfinite(array).all() else "not finite"
        raise InputError(field, given, shape, "Give one row of metres per point.")
    return array
