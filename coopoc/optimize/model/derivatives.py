"""Derivatives of a problem: measurements as CasADi expressions, their tapes of scalar operations, and linearisations.

CasADi runs the measurement's own formula, differentiates what it costs and hands over a list of scalar operations,
which the kernel in kernels/graphs/graph_tape.py runs for all measurements.
"""

from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations_with_replacement
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from ...arrays import Bools, Floats, Ints
from ...errors import InputError
from .factor import LOSSES, Factor, Loss
from .measurements import CONVERTED, Measurement, converted_rows, product
from .space import Space

if TYPE_CHECKING:
    from ...kernels.graphs.graph_tape import Tape

Numbers = list[Any]
"""CasADi's scalars."""
Model = Literal["cost", "gauss-newton", "newton", "converted", "jacobian"]
"""What a tape gives: the cost alone, with J^T J, with the exact Hessian; J^T J of the converted measurement; or the
whitened residuals and their Jacobian."""


class Kind(NamedTuple):
    """All that the formula of a factor's cost depends on.

    Attributes:
        measurement: of its kind.
        space: of the problem.
        full: its weight is a matrix.
        loss: rho.
        bound: a constraint, which costs its numbers times their weights, the multipliers.
    """

    measurement: Measurement
    space: Space
    full: bool = False
    loss: Loss | None = None
    bound: bool = False

    @property
    def widths(self) -> tuple[int, int, int]:
        """How many numbers z, constants and weights a measurement has."""
        measurement, d = self.measurement, self.space.dimension
        return measurement.width(d), measurement.constants, measurement.size(d) ** (1 + self.full)


class Term(NamedTuple):
    """Structure of a factor or a constraint.

    Attributes:
        kind: of it.
        raw: nodes (M, arity) int64 as bytes.
        steered: (M, size) as bytes, see `steerable`; of a constraint.
    """

    kind: Kind
    raw: bytes
    steered: bytes = b""

    @property
    def nodes(self) -> Ints:
        """(M, arity)."""
        return np.frombuffer(self.raw, int).reshape(-1, self.kind.measurement.arity)


class Structure(NamedTuple):
    """All of a problem that is no number: problems that share it share one solver.

    Attributes:
        nodes: n.
        space: where they live.
        moves: `movable` as bytes.
        factors: in the problem's order.
        constraints: as `factors`.
    """

    nodes: int
    space: Space
    moves: bytes
    factors: tuple[Term, ...]
    constraints: tuple[Term, ...]

    @property
    def movable(self) -> Bools:
        """(n, dof) True where a node can move."""
        return np.frombuffer(self.moves, bool).reshape(self.nodes, self.space.dof)


def numbers_of(factor: Factor) -> Floats:
    """(P, M) z, constants and weights of the measurements of a factor."""
    weight = np.asarray(factor.sqrt_information) if factor.std is None else 1.0 / factor.std
    parts = factor.z, np.asarray(factor.constants), weight.reshape(len(weight), -1)
    return np.hstack([np.broadcast_to(part, (len(factor.nodes), part.shape[1])) for part in parts]).T.copy()


def residual_of(kind: Kind, converted: bool = False) -> tuple[list[Any], Any]:
    """The whitened residual (size,) of one measurement by CasADi's symbols of its nodes (arity ambient,), its numbers
    (P,), see `numbers_of`, and steps (arity dof,) of the nodes. Of converted ones those without a linear form have
    none.

    A step (dp, w) moves a node to (p + dp, R C(w)), C the Cayley map in space, which like Exp starts as I + [w]x but is
    rational, and the angle itself in the plane.

    Returns:
        the three symbols, and the residual.

    Raises:
        InputError: CasADi cannot run the formula.
    """
    import casadi as ca

    measurement, space = kind.measurement, kind.space
    arity, (z_width, constants, _) = measurement.arity, kind.widths
    nodes, steps = ca.SX.sym("nodes", arity * space.ambient), ca.SX.sym("steps", arity * space.dof)
    number: Any = ca.SX.sym("number", sum(kind.widths))
    numbers, d = ca.vertsplit(number), space.dimension
    at = [*map(ca.vertsplit, ca.vertsplit(nodes, space.ambient))]
    z, assumed, weight = numbers[:z_width], numbers[z_width : z_width + constants], numbers[z_width + constants :]
    origin = dict(enumerate(at[0])) if arity == 2 and measurement.frame != "nodes" else {}
    if arity == 1 and measurement.linear:
        origin, z = dict(zip(measurement.kept(d), z, strict=True)), [0.0] * z_width
    moves = map(ca.vertsplit, ca.vertsplit(steps, space.dof))
    places = [_moved(space, *each, origin) for each in zip(at, moves, strict=True)]
    vectors, m = converted and measurement.name == CONVERTED, _namespace()
    try:
        local = _local(measurement, places)
        if vectors:
            distance, rows = converted_rows(z, m)
            [gap] = product([local], zip(*rows, strict=True))
            gap[0] -= distance
        else:  # angles in [-pi, pi]: the derivative of the remainder is 1
            parts = zip(measurement.residual(local, z, assumed, m), measurement.angles(d), strict=True)
            gap = [m.remainder(part, 2.0 * np.pi) if angle else part for part, angle in parts]
        size = len(gap)
        if kind.full:
            gap = [sum(weight[size * k + j] * gap[j] for j in range(size)) for k in range(size)]
        elif kind.bound:  # what has no multiplier may have no derivative
            gap = [ca.if_else(w != 0.0, w * g, 0.0) for g, w in zip(gap, weight, strict=True)]
        else:
            gap = [g * w for g, w in zip(gap, weight, strict=True)]
        white = ca.vertcat(*gap)
    except Exception as problem:  # the formula is the user's, who must learn what it raised
        hint, why = "Take its functions from the namespace m, such as m.sqrt.", " ".join(str(problem).split())[:80]
        raise InputError("kind", repr(measurement.name), f"must run on CasADi's numbers: {why}", hint) from problem
    if converted and not (vectors or measurement.linear):
        white = ca.SX(white.numel(), 1)
    return [nodes, number, steps], white


def robust(square: Any, loss: Loss | None) -> Any:
    """rho of the squared residual; that of a truncated loss has a kink, with nothing beyond."""
    return square if loss is None else LOSSES[loss.name][0](square, loss.scale, _namespace())


def expressions(structure: Structure) -> dict[str, Any]:
    """CasADi's x (the free steps), p (centres, numbers of factors and of constraints), f (cost) and g (what the
    constraints bound)."""
    import casadi as ca

    space, n = structure.space, structure.nodes
    centre = ca.SX.sym("centre", space.ambient, n)
    steps = ca.SX.sym("dx", int(structure.movable.sum()))
    step = ca.SX.zeros(space.dof, n)
    step[np.flatnonzero(structure.movable).tolist()] = steps

    cost, numbers, bounds = 0.0, list[Any](), []

    def each(term: Term) -> list[Any]:
        """The whitened residuals of all measurements of a term, whose numbers (M, P) come last."""
        numbers.append(ca.SX.sym("number", len(term.nodes), sum(term.kind.widths)))
        symbols, one = residual_of(term.kind)
        white = ca.Function("white", symbols, [one])
        places = [(ca.vec(centre[:, nodes]), ca.vec(step[:, nodes])) for nodes in term.nodes.tolist()]
        return [white(at, numbers[-1][k, :].T, moved) for k, (at, moved) in enumerate(places)]

    for term in structure.factors:
        for white in each(term):
            cost += 0.5 * robust(ca.sumsqr(white), term.kind.loss)
    for term in structure.constraints:
        bounds.append(ca.vertcat(*each(term))[np.flatnonzero(np.frombuffer(term.steered, bool)).tolist()])
    f, g = ca.cse([ca.SX(cost), ca.vertcat(*bounds)])  # a node's turn is that of all its measurements
    return {"x": steps, "p": ca.veccat(centre, *numbers), "f": f, "g": g}


@lru_cache(maxsize=1)
def _namespace() -> Any:
    """CasADi as the namespace of a formula."""
    import casadi as ca

    return SimpleNamespace(**vars(ca), where=ca.if_else)


def _moved(space: Space, node: Numbers, step: Numbers, origin: dict[int, Any]) -> tuple[Numbers, list[Numbers]]:
    """Position from an origin, so that far away its digits are those of a step, and rotation (d rows of d) of a node
    after a step."""
    d = space.dimension
    at = [node[k] - origin.get(k, 0.0) + step[k] for k in range(d)]
    if not space.has_rotation:
        return at, []
    return at, product([node[d + d * i :][:d] for i in range(d)], cayley(step[d:]))


def cayley(w: Numbers) -> list[Numbers]:
    """C(w)."""
    import casadi as ca

    if len(w) == 1:
        c, s = ca.cos(w[0]), ca.sin(w[0])
        return [[c, -s], [s, c]]
    x, y, z = w
    zero = 0.0 * x
    skew = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    twice = product(skew, skew)
    share = 1.0 / (1.0 + 0.25 * (x * x + y * y + z * z))
    return [[float(i == j) + share * (skew[i][j] + 0.5 * twice[i][j]) for j in range(3)] for i in range(3)]


def _local(measurement: Measurement, places: list[tuple[Numbers, list[Numbers]]]) -> Numbers:
    """Inputs of the formula: the vector and, if the frame is relative, the rotation; or those of every node."""
    (first, body), (last, other) = places[0], places[-1]
    vector = [b - a for a, b in zip(first, last, strict=True)] if measurement.arity == 2 else last
    if measurement.frame == "world":
        return vector
    if measurement.frame == "nodes" or measurement.arity == 1:
        return [c for at, turned in places for row in (at, *turned) for c in row]
    [vector] = product([vector], body)
    turned = product(zip(*body, strict=True), other)
    return vector if measurement.frame == "body" else [*vector, *(c for row in turned for c in row)]


class Written(NamedTuple):
    """A tape and what its outputs are: the cost, then entries (row, column) of the gradient (column -1) and of the
    upper triangle of the curvature, by the dof of the first node and then of the second; or entries of the residual
    (column -1) and of its Jacobian.

    Attributes:
        tape: for the kernel.
        entries: (outputs, 2); the cost has -1 twice.
    """

    tape: "Tape"
    entries: Ints


@lru_cache(maxsize=256)
def write(kind: Kind, model: Model) -> Written:
    """The tape of a kind.

    Raises:
        InputError: CasADi cannot run the formula, or no tape has an operation of it.
    """
    import casadi as ca

    if model == "converted":
        kind = kind._replace(loss=None)
    (nodes, number, steps), white = residual_of(kind, model == "converted")
    square = ca.SX.sym("square")
    rho = robust(square, kind.loss)
    cost = ca.sum1(white) if kind.bound else 0.5 * ca.substitute(rho, square, ca.sumsqr(white))
    J, outputs, entries = ca.jacobian(white, steps), [cost], [(-1, -1)]
    if model == "jacobian":
        whole = ca.horzcat(white, J)
        entries = [(i, j - 1) for i in range(whole.size1()) for j in range(whole.size2())]
        outputs = [whole[i, j + 1] for i, j in entries]
    elif model != "cost":
        curvature = ca.mtimes(J.T, J) * ca.substitute(ca.jacobian(rho, square), square, ca.sumsqr(white))
        if model == "newton":
            curvature = ca.hessian(cost, steps)[0]
        upper = [*combinations_with_replacement(range(steps.size1()), 2)]
        outputs += [*ca.vertsplit(ca.gradient(cost, steps)), *(curvature[i, j] for i, j in upper)]
        entries += [*((i, -1) for i in range(steps.size1())), *upper]
    here = ca.cse(ca.substitute(ca.vertcat(*outputs), steps, ca.SX.zeros(steps.size1())))
    kept = [k for k in range(here.size1()) if k == 0 or not here[k].is_zero()]
    function = ca.Function("tape", [ca.vertcat(nodes, number)], [ca.densify(here[kept])])
    return Written(_tape(function, kind.measurement.name), np.array([entries[k] for k in kept], int))


def _tape(function: Any, name: str) -> "Tape":
    """The operations of a CasADi function of one vector."""
    import casadi as ca

    from ...kernels.graphs.graph_tape import Operation, Tape

    operations, count = {getattr(ca, f"OP_{each.name}"): each for each in Operation}, function.n_instructions()
    operations |= {ca.OP_SQ: Operation.MUL, ca.OP_TWICE: Operation.ADD}  # of one slot, which is read twice
    code, operands, value = np.zeros(count, int), np.zeros((count, 3), int), np.zeros(count)
    for k in range(count):
        instruction = function.instruction_id(k)
        if instruction not in operations:
            allowed = f"must not use CasADi's operation {instruction}"
            raise InputError("kind", repr(name), allowed, "Use +, -, *, /, ** and the functions of m.")
        code[k] = operation = operations[instruction]
        read, written = function.instruction_input(k), function.instruction_output(k)
        if operation == Operation.CONST:
            operands[k, 0], value[k] = written[0], function.instruction_constant(k)
        elif operation == Operation.INPUT:
            operands[k, :2] = written[0], read[1]
        elif operation == Operation.OUTPUT:
            operands[k, :2] = written[1], read[0]
        else:
            operands[k] = written[0], read[0], read[-1]
    return Tape(code, operands, value, function.sz_w())


class Linear(NamedTuple):
    """A problem around x: per factor, whitened residuals and their derivative by the steps of its nodes.

    A robust factor's residual and derivatives carry the root of its weight rho'.

    Attributes:
        residual: per factor (M, size).
        jacobian: per factor (M, size, arity dof).
        cost: 1/2 sum of rho.
    """

    residual: tuple[Floats, ...]
    jacobian: tuple[Floats, ...]
    cost: float


def linearise(space: Space, factors: Sequence[Factor], x: Floats) -> Linear:
    """Factors around x (n, ambient)."""
    from ...kernels.graphs.graph_tape import accumulate

    wholes, cost = [], 0.0
    for factor in factors:
        nodes, kind = factor.nodes, Kind(factor.measurement, space, factor.std is None)
        whole = np.zeros((len(nodes), factor.size, 1 + nodes.shape[1] * space.dof))
        tape, goal = write(kind, "jacobian").tape, _goal(kind, *whole.shape)
        accumulate(tape, x, nodes, numbers_of(factor), goal, whole.reshape(-1))
        square = np.vecdot(whole[..., 0], whole[..., 0])
        if factor.loss is not None:
            whole *= np.sqrt(factor.loss.weight(square))[:, None, None]
            square = factor.loss.cost(square)
        cost += 0.5 * float(square.sum())
        wholes.append(whole)
    return Linear(tuple(w[..., 0] for w in wholes), tuple(w[..., 1:] for w in wholes), cost)


@lru_cache(maxsize=64)
def _goal(kind: Kind, rows: int, size: int, width: int) -> Any:
    """(outputs, rows) int32, where a tape's outputs go: (rows, size, width) residuals, each before its derivatives."""
    component, column = write(kind, "jacobian").entries.T
    return ((component * width + 1 + column)[:, None] + size * width * np.arange(rows)).astype(np.int32)
