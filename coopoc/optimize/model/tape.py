"""The tapes of a kind: its cost, gradient and curvature by the steps of its nodes, written from its one definition.

CasADi runs the measurement's own formula, differentiates what it costs and hands over a list of scalar operations,
which the kernel in kernels/graphs/graph_tape.py runs for all measurements.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from ...arrays import Ints
from ...errors import InputError
from .symbolic import Kind, cost_of

if TYPE_CHECKING:
    from ...kernels.graphs.graph_tape import Tape

Model = Literal["cost", "gauss-newton", "newton", "converted", "jacobian"]
"""What a tape gives: the cost alone, with J^T J, with the exact Hessian; J^T J of the converted measurement; or the
whitened residuals and their Jacobian."""


class Written(NamedTuple):
    """A tape and what its outputs are: the cost, then entries (row, column) of the gradient (column -1) and of the
    upper triangle of the curvature, by the dof of the first node and then of the second; or entries of the residual
    (column -1) and of its Jacobian.

    Attributes:
        tape: for the kernel.
        entries: (outputs, 2); the cost has -1 twice.
    """

    tape: Tape
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
    nodes, number, steps, white, square, rho = cost_of(kind, model == "converted")
    cost = 0.5 * ca.substitute(rho, square, ca.sumsqr(white))
    zero = ca.SX.zeros(steps.size1())
    outputs, entries = [cost], [(-1, -1)]
    if model == "jacobian":
        whole = ca.horzcat(white, ca.jacobian(white, steps))
        entries = [(i, j - 1) for i in range(whole.size1()) for j in range(whole.size2())]
        outputs = [whole[i, j + 1] for i, j in entries]
    elif model != "cost":
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
    together = [ca.vertcat(*(ca.densify(here[k]) for k in kept))]
    tape = _tape(ca.Function("tape", [ca.vertcat(nodes, number)], together), kind.measurement.name)
    return Written(tape, np.array([entries[k] for k in kept], dtype=np.int64).reshape(-1, 2))


def _tape(function: Any, name: str) -> Tape:
    """The operations of a CasADi function of one vector."""
    from ...kernels.graphs.graph_tape import Operation, Tape

    operations, constant = _operations(), int(Operation.CONST)
    read_in, write_out = int(Operation.INPUT), int(Operation.OUTPUT)
    count = function.n_instructions()
    code, place, value = np.zeros(count, np.int64), np.zeros((count, 3), np.int64), np.zeros(count)
    for k in range(count):
        instruction = function.instruction_id(k)
        if instruction not in operations:
            allowed = f"must not use CasADi's operation {instruction}"
            raise InputError("kind", repr(name), allowed, "Use +, -, *, /, ** and the functions of m.")
        code[k] = operation = operations[instruction]
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
def _operations() -> dict[int, int]:
    """CasADi's number of an operation -> ours."""
    import casadi as ca

    from ...kernels.graphs.graph_tape import Operation

    operations = {getattr(ca, f"OP_{operation.name}"): int(operation) for operation in Operation}
    # the two of one slot, which is read twice
    return operations | {ca.OP_SQ: int(Operation.MUL), ca.OP_TWICE: int(Operation.ADD)}
