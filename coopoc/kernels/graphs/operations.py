"""Scalar operations of a tape, by the names that CasADi gives them."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from ..compiling.compile import part

Operation = IntEnum(
    "Operation",
    "INPUT OUTPUT CONST ASSIGN ADD SUB MUL DIV NEG INV SQRT SIN COS TAN ASIN ACOS ATAN ATAN2 EXP EXPM1 LOG LOG1P POW "
    "CONSTPOW SINH COSH TANH FABS SIGN FMIN FMAX FLOOR CEIL FMOD REMAINDER HYPOT LT LE EQ NE NOT AND OR IF_ELSE_ZERO",
    start=0,
)
"""What a tape can hold; CasADi's names without "OP_"."""


@part
def transcendental(code: int, a: float, b: float) -> float:
    """SIN to CONSTPOW, and hyperbolic functions."""
    y = a
    if code == Operation.SIN:
        y = np.sin(a)
    elif code == Operation.COS:
        y = np.cos(a)
    elif code == Operation.TAN:
        y = np.tan(a)
    elif code == Operation.ASIN:
        y = np.arcsin(a)
    elif code == Operation.ACOS:
        y = np.arccos(a)
    elif code == Operation.ATAN:
        y = np.arctan(a)
    elif code == Operation.ATAN2:
        y = np.arctan2(a, b)
    elif code == Operation.EXP:
        y = np.exp(a)
    elif code == Operation.EXPM1:
        y = np.expm1(a)
    elif code == Operation.LOG:
        y = np.log(a)
    elif code == Operation.LOG1P:
        y = np.log1p(a)
    elif code == Operation.POW or code == Operation.CONSTPOW:
        y = a**b
    elif code == Operation.SINH:
        y = np.sinh(a)
    elif code == Operation.COSH:
        y = np.cosh(a)
    elif code == Operation.TANH:
        y = np.tanh(a)
    return y


@part
def piecewise(code: int, a: float, b: float) -> float:
    """FABS to IF_ELSE_ZERO: rounding, comparisons and logic, true as 1."""
    y = 0.0
    if code == Operation.FABS:
        y = abs(a)
    elif code == Operation.SIGN:
        y = np.sign(a)
    elif code == Operation.FMIN:
        y = np.fmin(a, b)
    elif code == Operation.FMAX:
        y = np.fmax(a, b)
    elif code == Operation.FLOOR:
        y = np.floor(a)
    elif code == Operation.CEIL:
        y = np.ceil(a)
    elif code == Operation.FMOD:
        y = np.fmod(a, b)
    elif code == Operation.REMAINDER:
        y = a - b * np.rint(a / b)
    elif code == Operation.HYPOT:
        y = np.hypot(a, b)
    elif code == Operation.IF_ELSE_ZERO:
        y = b if a != 0.0 else 0.0
    elif (
        (code == Operation.LT and a < b)
        or (code == Operation.LE and a <= b)
        or (code == Operation.EQ and a == b)
        or (code == Operation.NE and a != b)
        or (code == Operation.NOT and a == 0.0)
        or (code == Operation.AND and a != 0.0 and b != 0.0)
        or (code == Operation.OR and (a != 0.0 or b != 0.0))
    ):
        y = 1.0
    return y
