"""Operations of a tape against CasADi's own evaluation of the same operation."""

import numpy as np
import pytest

from coopoc.kernels.graphs.graph_tape import Operation, Tape, accumulate

ca = pytest.importorskip("casadi")

BINARY = {
    *("ADD", "SUB", "MUL", "DIV", "ATAN2", "POW", "CONSTPOW", "FMIN", "FMAX", "REMAINDER"),
    *("LT", "LE", "EQ", "NE", "AND", "OR", "IF_ELSE_ZERO"),
}
UNARY = [one.name for one in Operation if one > Operation.ASSIGN and one.name not in BINARY]


@pytest.mark.parametrize("name", [*UNARY, *sorted(BINARY)])
def test_an_operation_is_casadis(name):
    """For numbers of both signs, equal ones and zeros, in more measurements than stand side by side."""
    a, b = np.random.default_rng(1).uniform(-2, 2, (2, 75))
    a[:5], b[:3], b[20:25] = 0.0, 0.0, a[20:25]
    x, y, number = ca.SX.sym("x"), ca.SX.sym("y"), getattr(ca, f"OP_{name}")
    made = ca.SX.binary(number, x, y) if name in BINARY else ca.SX.unary(number, x)
    with np.errstate(all="ignore"):
        expected = np.array(ca.Function("f", [x, y], [made]).map(len(a))(a[None], b[None])).ravel()
    code = [Operation.INPUT, Operation.INPUT, Operation[name], Operation.OUTPUT]
    place = [[0, 0, 0], [1, 1, 0], [2, 0, 1 if name in BINARY else 0], [0, 2, 0]]
    found = np.zeros(len(a))
    accumulate(
        Tape(np.array(code, np.int64), np.array(place), np.zeros(4), 3),
        np.c_[a, b],
        np.arange(len(a))[:, None],
        np.empty((0, len(a))),
        np.arange(len(a))[None],
        found,
    )
    np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-15)
