"""The tapes of a kind: its cost, gradient and curvature by the steps of its nodes, written from its one definition.

CasADi runs the measurement's own formula, differentiates what it costs and hands over a list of scalar operations,
which the kernel in kernels/graphs/graph_tape.py runs for all measurements.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from ...arrays import Floats, Ints
from ...errors import InputError
from ..model.converted import is_converted
from ..model.factor import Factor
from ..model.losses import Loss
from ..model.measurements import Measurement
from ..model.space import Space

if TYPE_CHECKING:
    from ...kernels.graphs.graph_tape import Tape

Model = Literal["cost", "gauss-newton", "newton", "converted"]
"""What a tape gives: the cost alone, with J^T J, with the exact Hessian; or J^T J of the converted measurement."""


class Kind(NamedTuple):
    """All that the tape of a factor depends on.

    Attributes:
        measurement: of its kind.
        space: of the problem.
        full: its weight is a matrix.
        loss: rho.
    """

    measurement: Measurement
    space: Space
    full: bool
    loss: Loss | None


class Written(NamedTuple):
    """A tape and what its outputs are: the cost, then entries (row, column) of the gradient (column -1) and of the
    upper triangle of the curvature, by the dof of the first node and then of the second.

    Attributes:
        tape: for the kernel.
        entries: (outputs, 2); the cost has -1 twice.
    """

    tape: Tape
    entries: Ints


def kind_of(factor: Factor, space: Space) -> Kind:
    """The kind of a factor."""
    return Kind(factor.measurement, space, factor.std is None, factor.loss)


def numbers_of(factor: Factor) -> Floats:
    """(P, M) the tape's inputs that are no nodes: z, constants and weights of a single realisation."""
    weight = 1.0 / factor.std if factor.std is not None else factor.sqrt_information
    assert weight is not None
    assert factor.constants is not None
    first, second = factor.z.shape[1], factor.z.shape[1] + factor.constants.shape[1]
    out = np.empty((second + weight[0].size, len(factor.nodes)))
    out[:first], out[first:second], out[second:] = factor.z.T, factor.constants.T, weight.reshape(len(weight), -1).T
    return out


@lru_cache(maxsize=256)
def write(kind: Kind, model: Model) -> Written:
    """The tape of a kind.

    Raises:
        InputError: CasADi cannot run the formula, or no tape has an operation of it.
    """
    import casadi as ca

    if model == "converted":
        kind = kind._replace(loss=None)
    nodes, number, steps, parts = _cost(kind, model == "converted")
    cost, white, square, rho = parts
    zero = ca.SX.zeros(steps.size1())
    outputs, entries = [cost], [(-1, -1)]
    if model != "cost":
        slope = ca.gradient(cost, steps)
        if model == "newton":
            curvature = ca.hessian(cost, steps)[0]
        else:
            J = ca.jacobian(white, steps)
            curvature = ca.mtimes(J.T, J) * ca.substitute(ca.jacobian(rho, square), square, ca.sumsqr(white))
        for i in range(steps.size1()):
            outputs.append(slope[i])
            entries.append((i, -1))
        for i in range(steps.size1()):
            for j in range(i, steps.size1()):
                outputs.append(curvature[i, j])
                entries.append((i, j))
    here = ca.substitute(ca.vertcat(*outputs), steps, zero)
    here = ca.cse(here)
    kept = [k for k in range(here.size1()) if k == 0 or not here[k].is_zero()]
    found = [ca.vertcat(*(ca.densify(here[k]) for k in kept))]
    tape = _tape(ca.Function("tape", [ca.vertcat(nodes, number)], found), kind.measurement.name)
    return Written(tape, np.array([entries[k] for k in kept], dtype=np.int64).reshape(-1, 2))


def _cost(kind: Kind, converted: bool) -> tuple[Any, Any, Any, tuple[Any, Any, Any, Any]]:
    """Symbols of the nodes, the numbers and the steps; the cost, the whitened residual, and rho of its square.

    Of converted measurements those without a linear form have no residual.
    """
    import casadi as ca

    from ..model import symbolic

    known, space = kind.measurement, kind.space
    arity, size = known.arity, known.size(space.dimension)
    nodes = ca.SX.sym("nodes", arity * space.ambient)
    steps = ca.SX.sym("steps", arity * space.dof)
    widths = known.given(space.dimension), known.constants, size ** (1 + kind.full)
    number, square = ca.SX.sym("number", sum(widths)), ca.SX.sym("square")
    given = [number[sum(widths[:k]) : sum(widths[: k + 1])] for k in range(3)]
    try:
        vectors = converted and is_converted(known)
        white = symbolic.white(known, space, nodes, steps, given, kind.full, vectors)
        if converted and not (vectors or known.linear):
            white = ca.SX(size, 1)
        rho = symbolic.robust(square, kind.loss)
    except Exception as problem:  # the formula is the user's, who must learn what it raised
        hint = "Take its functions from the namespace m, such as m.sqrt, and choose by m.where."
        why = " ".join(str(problem).split())[:80]
        raise InputError("kind", repr(known.name), f"must run on CasADi's numbers: {why}", hint) from problem
    cost = 0.5 * ca.substitute(rho, square, ca.sumsqr(white))
    return nodes, number, steps, (cost, white, square, rho)


def _tape(function: Any, name: str) -> Tape:
    """The operations of a CasADi function of one vector."""
    from ...kernels.graphs.graph_tape import Operation, Tape

    known, constant, read_in, write_out = _known(), int(Operation.CONST), int(Operation.INPUT), int(Operation.OUTPUT)
    count = function.n_instructions()
    code, place, value = np.zeros(count, np.int64), np.zeros((count, 3), np.int64), np.zeros(count)
    for k in range(count):
        found = function.instruction_id(k)
        if found not in known:
            allowed = f"must not use CasADi's operation {found}"
            raise InputError("kind", repr(name), allowed, "Use +, -, *, /, ** and the functions of m.")
        code[k] = operation = known[found]
        read, written = function.instruction_input(k), function.instruction_output(k)
        if operation == constant:
            place[k, 0], value[k] = written[0], function.instruction_constant(k)
        elif operation == read_in:
            place[k, :2] = written[0], read[1]
        elif operation == write_out:
            place[k, :2] = written[1], read[0]
        else:
            place[k] = written[0], read[0], read[-1]
    return Tape(code, place, value, function.sz_w())


@lru_cache(maxsize=1)
def _known() -> dict[int, int]:
    """CasADi's number of an operation -> ours."""
    import casadi as ca

    from ...kernels.graphs.graph_tape import Operation

    known = {getattr(ca, f"OP_{operation.name}"): int(operation) for operation in Operation}
    return known | {ca.OP_SQ: int(Operation.MUL), ca.OP_TWICE: int(Operation.ADD)}  # of one slot, which is read twice
