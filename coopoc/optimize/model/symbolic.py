"""A problem's cost and constraints as CasADi expressions, by the structure alone; the numbers are parameters."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np

from ...arrays import Bools, Floats, Ints
from .constraint import steerable
from .converted import converted_rows
from .losses import Loss
from .measurements import Measurement
from .problem import Problem
from .space import Space

Columns = list[Any]
"""One CasADi column (M, 1) per number: a formula runs once for all M measurements, as it does on NumPy's arrays."""


@dataclass(frozen=True)
class Term:
    """Structure of a factor or a constraint.

    Args:
        measurement: of the kind.
        raw: nodes (M, arity) int64 as bytes.
        full: the weight is a matrix.
        loss: of a factor.
        steered: (M, size) as bytes, see `steerable`.
    """

    measurement: Measurement
    raw: bytes
    full: bool = False
    loss: Loss | None = None
    steered: bytes = b""

    @cached_property
    def nodes(self) -> Ints:
        """(M, arity)."""
        return np.frombuffer(self.raw, np.int64).reshape(-1, self.measurement.arity)


@dataclass(frozen=True)
class Structure:
    """All of a problem that is no number: problems that share it share one solver.

    Args:
        nodes: n.
        space: where they live.
        fixed: (n, dof) as bytes, True where a node cannot move; empty: all move.
        factors: in the problem's order.
        constraints: as `factors`.
    """

    nodes: int
    space: Space
    fixed: bytes
    factors: tuple[Term, ...]
    constraints: tuple[Term, ...]

    @cached_property
    def movable(self) -> Bools:
        """(n, dof) True where a node can move."""
        shape = (self.nodes, self.space.dof)
        return ~np.frombuffer(self.fixed, bool).reshape(shape) if self.fixed else np.ones(shape, dtype=bool)


def structure_of(problem: Problem) -> Structure:
    """The structure of a problem."""
    factors = (Term(f.measurement, f.nodes.tobytes(), f.std is None, f.loss) for f in problem.factors)
    constraints = (
        Term(c.measurement, c.nodes.tobytes(), steered=steerable(c, problem.movable).tobytes())
        for c in problem.constraints
    )
    fixed = b"" if problem.movable is None else (~problem.movable).tobytes()
    return Structure(len(problem.names), problem.space, fixed, tuple(factors), tuple(constraints))


def numbers_of(problem: Problem, x: Floats) -> Floats:
    """(B, .) parameters of `expressions`: the centres x (B, n, ambient), then z, constants, weights by columns."""
    parts: list[Floats] = []
    for f in problem.factors:
        weight = 1.0 / f.std if f.std is not None else f.sqrt_information
        assert weight is not None
        assert f.constants is not None
        own = weight.shape[-1 - (f.std is None) :]
        weight = np.broadcast_to(weight, (*weight.shape[: -1 - len(own)], len(f.nodes), *own))
        parts += [f.z, f.constants, weight.reshape(*weight.shape[: -len(own)], -1)]
    parts += [c.constants for c in problem.constraints if c.constants is not None]
    wide = (np.broadcast_to(part, (len(x), *part.shape[-2:])) for part in (x, *parts))
    return np.concatenate([np.swapaxes(part, 1, 2).reshape(len(x), -1) for part in wide], axis=1)


def expressions(structure: Structure) -> dict[str, Any]:
    """CasADi's x (the free steps), p (see `numbers_of`), f (cost) and g (what the constraints bound).

    A step (dp, w) moves a node from the centre to (p + dp, R C(w)), C the Cayley map in space, which like Exp starts
    as I + [w]x but is rational, and the angle itself in the plane.
    """
    import casadi as ca

    space, n = structure.space, structure.nodes
    centre = ca.SX.sym("centre", n, space.ambient)
    steps = ca.SX.sym("dx", int(structure.movable.sum()))
    step = ca.SX.zeros(n, space.dof)
    for k, (i, j) in enumerate(np.argwhere(structure.movable).tolist()):
        step[i, j] = steps[k]
    place = _moved(space, ca.horzsplit(centre), ca.horzsplit(step))
    factors = [_factor(term, space, *place) for term in structure.factors]
    bounds = [_constraint(term, space, *place) for term in structure.constraints]
    numbers = [*(number for part in factors for number in part[0]), *(number for number, _ in bounds)]
    return {
        "x": steps,
        "p": ca.veccat(centre, *numbers),
        "f": sum(part[1] for part in factors),
        "g": ca.vertcat(*(value for _, value in bounds)),
    }


def _factor(term: Term, space: Space, at: Columns, turned: list[Columns]) -> tuple[Columns, Any]:
    """z, constants and weights (M, .), and the cost."""
    import casadi as ca

    known, m = term.measurement, _namespace()
    widths = known.given(space.dimension), known.constants, known.size(space.dimension) ** (1 + term.full)
    numbers = [ca.SX.sym("number", len(term.nodes), width) for width in widths]
    z, constants, weight = (ca.horzsplit(number) if number.size2() else [] for number in numbers)
    gap = _residual(known, _seen(known, at, turned, term.nodes), z, constants, m)
    white = _whitened(gap, weight, term.full)
    square = sum(w * w for w in white)
    return numbers, 0.5 * ca.sum1(square if term.loss is None else LOSSES[term.loss.name](square, term.loss.scale, m))


def white(
    known: Measurement, space: Space, nodes: Any, steps: Any, given: list[Any], full: bool, converted: bool = False
) -> Any:
    """Whitened residual (size,) of one measurement after steps of its nodes (arity dof,).

    Args:
        nodes: (arity ambient,).
        given: z, constants and weights.
        converted: take the residual of `converted_rows`.
    """
    import casadi as ca

    place, step = ca.horzsplit(ca.reshape(nodes, space.ambient, -1).T), ca.horzsplit(ca.reshape(steps, space.dof, -1).T)
    at, turned = _moved(space, place, step)
    z, constants, weight = ([v[k] for k in range(v.numel())] for v in given)
    seen = _seen(known, at, turned, np.arange(known.arity)[None])
    gap = _converted(seen, z) if converted else _residual(known, seen, z, constants, _namespace())
    return ca.vertcat(*_whitened(gap, weight, full))


def _converted(vector: Columns, z: Columns) -> Columns:
    d, rows = converted_rows(z, _namespace())
    along, *across = (sum(a * v for a, v in zip(row, vector, strict=True)) for row in rows)
    return [along - d, *across]


def robust(square: Any, loss: Loss | None) -> Any:
    """rho of the squared residual; that of a truncated loss has a kink, with nothing beyond."""
    if loss is None:
        return square
    m = _namespace()
    if loss.name == "truncated":
        return m.where(square > loss.scale**2, loss.scale**2, square)
    return LOSSES[loss.name](square, loss.scale, m)


def _constraint(term: Term, space: Space, at: Columns, turned: list[Columns]) -> tuple[Any, Any]:
    """Constants (M, .) and the numbers that are steered, row by row."""
    import casadi as ca

    known = term.measurement
    number = ca.SX.sym("number", len(term.nodes), known.constants)
    constants, nothing = ca.horzsplit(number) if known.constants else [], [0.0] * known.size(space.dimension)
    seen = _seen(known, at, turned, term.nodes)
    value: Any = ca.horzcat(*_residual(known, seen, nothing, constants, _namespace()))
    return number, ca.vec(value.T)[np.flatnonzero(np.frombuffer(term.steered, bool)).tolist()]


def _namespace() -> Any:
    """CasADi as the namespace of a formula."""
    import casadi as ca

    return SimpleNamespace(
        sqrt=ca.sqrt,
        sin=ca.sin,
        cos=ca.cos,
        atan2=ca.atan2,
        log1p=ca.log1p,
        fabs=ca.fabs,
        fmax=ca.fmax,
        where=ca.if_else,
        remainder=ca.remainder,
    )


LOSSES: dict[str, Any] = {
    "huber": lambda s, c, m: m.where(s > c * c, 2.0 * c * m.sqrt(m.fmax(s, c * c)) - c * c, s),
    "cauchy": lambda s, c, m: c * c * m.log1p(s / (c * c)),
    "geman-mcclure": lambda s, c, m: s / (1.0 + s / (c * c)),
}


def _moved(space: Space, centre: Columns, step: Columns) -> tuple[Columns, list[Columns]]:
    """Columns of the positions and of the rotations (d rows of d) after the steps."""
    d = space.dimension
    at = [centre[k] + step[k] for k in range(d)]
    if not space.has_rotation:
        return at, []
    turn = _chart(step[d:])
    start = [centre[d + d * i : 2 * d + d * i] for i in range(d)]
    return at, _product(start, turn)


def _chart(w: Columns) -> list[Columns]:
    import casadi as ca

    if len(w) == 1:
        c, s = ca.cos(w[0]), ca.sin(w[0])
        return [[c, -s], [s, c]]
    x, y, z = w
    zero = 0.0 * x
    skew = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    twice = _product(skew, skew)
    share = 1.0 / (1.0 + 0.25 * (x * x + y * y + z * z))
    return [[float(i == j) + share * (skew[i][j] + 0.5 * twice[i][j]) for j in range(3)] for i in range(3)]


def _product(a: list[Columns], b: list[Columns]) -> list[Columns]:
    return [[sum(a[i][k] * b[k][j] for k in range(len(b))) for j in range(len(b[0]))] for i in range(len(a))]


def _seen(known: Measurement, at: Columns, turned: list[Columns], nodes: Ints) -> Columns:
    """Inputs of the formula as by `local`: the vector's columns and, if the frame is relative, the rotation's."""
    first, last = nodes[:, 0].tolist(), nodes[:, -1].tolist()
    vector = [c[last] - c[first] if known.arity == 2 else c[last] for c in at]
    if known.frame == "world":
        return vector
    body = [[c[first] for c in row] for row in turned]
    if known.arity == 1:
        return [*vector, *(c for row in body for c in row)]
    back = [list(column) for column in zip(*body, strict=True)]
    vector = [row[0] for row in _product(back, [[v] for v in vector])]
    if known.frame == "body":
        return vector
    other = [[c[last] for c in row] for row in turned]
    return [*vector, *(c for row in _product(back, other) for c in row)]


def _residual(known: Measurement, local: Columns, z: Columns, constants: Columns, m: Any) -> Columns:
    """h - z, angles in [-pi, pi]: the derivative of the remainder is 1."""
    dimension = 2 if len(local) in (2, 6) else 3
    parts = known.residual(local, z, constants, m)
    return [
        m.remainder(part, 2.0 * np.pi) if angle else part
        for part, angle in zip(parts, known.angles(dimension), strict=True)
    ]


def _whitened(gap: Columns, weight: Columns, full: bool) -> Columns:
    size = len(gap)
    if not full:
        return [g * w for g, w in zip(gap, weight, strict=True)]
    return [sum(weight[size * k + j] * gap[j] for j in range(size)) for k in range(size)]
