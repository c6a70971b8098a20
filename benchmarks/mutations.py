"""The mutants of a file: one change each of one node of its syntax tree."""

from __future__ import annotations

import ast
import copy
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import cast

ROOT = Path(__file__).resolve().parents[1]
COMPARISONS = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.And: ast.Or,
    ast.Or: ast.And,
}
OPERATORS = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}


@dataclass(frozen=True)
class Mutant:
    """A changed file.

    Args:
        file: relative to the project.
        line: of the change.
        change: in words.
        text: of the whole file.
    """

    file: str
    line: int
    change: str
    text: str


def changes(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """Every change of one node, with what it does."""
    match node:
        case ast.Compare(ops=[op]) if type(op) in COMPARISONS:
            other = COMPARISONS[type(op)]
            changed = copy.deepcopy(node)
            changed.ops = [other()]
            yield f"{type(op).__name__} -> {other.__name__}", changed
        case ast.BoolOp(op=op):
            changed = copy.deepcopy(node)
            changed.op = COMPARISONS[type(op)]()
            yield f"{type(op).__name__} -> {type(changed.op).__name__}", changed
        case ast.BinOp(op=op) if type(op) in OPERATORS and not isinstance(node.right, ast.Constant | ast.JoinedStr):
            changed = copy.deepcopy(node)
            changed.op = OPERATORS[type(op)]()
            yield f"{type(op).__name__} -> {type(changed.op).__name__}", changed
            if isinstance(op, ast.Add | ast.Sub):
                yield "second term left out", copy.deepcopy(node.left)
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            yield "sign left out", copy.deepcopy(operand)
        case ast.Constant(value=value) if isinstance(value, int | float) and not isinstance(value, bool):
            other = value + 1 if isinstance(value, int) else value * 10 if value else 1.0
            yield f"{value} -> {other}", ast.Constant(other)
        case ast.If(body=[ast.Raise()], orelse=[]):
            yield "check left out", ast.Pass()


def mutants(file: Path) -> Iterator[Mutant]:
    """All mutants of a file, whose annotations and docstrings stay."""
    text = file.read_bytes()
    starts = [0, *(found.end() for found in re.finditer(rb"\n", text))]
    for node in _inside_functions(ast.parse(text)):
        first = starts[node.lineno - 1] + node.col_offset
        last = starts[cast(int, node.end_lineno) - 1] + cast(int, node.end_col_offset)
        for change, other in changes(node):
            words = ast.unparse(ast.fix_missing_locations(other))
            within = f"({words})" if isinstance(other, ast.expr) else words
            whole = text[:first] + within.encode() + text[last:]
            yield Mutant(str(file.relative_to(ROOT)), node.lineno, change, whole.decode())


def _inside_functions(tree: ast.Module) -> Iterator[ast.expr | ast.stmt]:
    """Nodes of the statements of all functions, but for what words an error."""
    waiting: list[ast.AST] = [node for outer in tree.body for node in _bodies(outer)]
    while waiting:
        node = waiting.pop(0)
        if isinstance(node, ast.Raise | ast.Import | ast.ImportFrom | ast.arguments | ast.JoinedStr):
            continue
        if isinstance(node, ast.expr | ast.stmt):
            yield node
        waiting += [node.value] if isinstance(node, ast.AnnAssign) and node.value else ast.iter_child_nodes(node)


def _bodies(outer: ast.AST) -> list[ast.stmt]:
    if isinstance(outer, ast.FunctionDef):
        return outer.body
    return [part for inner in outer.body for part in _bodies(inner)] if isinstance(outer, ast.ClassDef) else []
