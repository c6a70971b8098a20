"""Mutation testing on a seeded sample: how many small faults do the tests that touch a file find?

    python benchmarks/mutants.py --count 40 --seed 1 coopoc/world coopoc/evaluate --out mutants.csv

A mutant is one change of one node of a file's syntax tree: a sign, a comparison, an operator, a constant, a term or a
check that is left out. Tests that mention what the file defines run until the first fails. The file is put back after
each; the tree must be clean. A mutant that survives is equivalent or shows a missing test.
"""

from __future__ import annotations

import argparse
import ast
import copy
import csv
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import cast

from tqdm import tqdm

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
MOST_TESTS = 3
"""Files of tests, those that mention the file's names most."""
LONG = re.compile("test_(study|studies|cli|install|extend|site|examples|reliability|layering)")
"""Files of tests that run whole studies or look at conventions: they take minutes and see little of a formula."""
UNFINISHED = "unfinished"


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


def tests_of(file: str) -> list[str]:
    """Files of tests that mention most what a file defines, what files define that import it, and those that import
    these, each less than the one before; a shared word in the names of the files counts as ten mentions."""
    weights, level, scores = {ROOT / file: 9}, {ROOT / file}, Counter[str]()
    for weight in (3, 1):
        level = {user for used in level for user in _importers(used)} - weights.keys()
        weights |= dict.fromkeys(level, weight)
    texts = {str(test.relative_to(ROOT)): test.read_text() for test in (ROOT / "tests").glob("test_*.py")}
    texts = {test: text for test, text in texts.items() if not LONG.search(test)}
    for used, weight in weights.items():
        words = re.compile("|".join(rf"\b{re.escape(word)}\b" for word in _defined(used)))
        for test, text in texts.items():
            shared = set(used.stem.split("_")) & set(Path(test).stem.split("_")[1:])
            scores[test] += weight * (len(words.findall(text)) + 10 * len(shared))
    return [*(test for test, score in scores.most_common(MOST_TESTS) if score), file]


@cache
def _defined(file: Path) -> tuple[str, ...]:
    """Public names of a file that are more than a common word, and its own."""
    kinds = ast.FunctionDef | ast.ClassDef
    names = [node.name for node in ast.parse(file.read_text()).body if isinstance(node, kinds)]
    return (file.stem, *(name for name in names if name[0] != "_" and (name != name.lower() or "_" in name)))


@cache
def _importers(file: Path) -> tuple[Path, ...]:
    """Files that import from a file."""
    line = re.compile(rf"^\s*from \S*\b{file.stem} import|^\s*from \.+\S* import .*\b{file.stem}\b", re.MULTILINE)
    folders = (ROOT / "coopoc", ROOT / "learned")
    every = [other for folder in folders for other in folder.rglob("*.py") if other.name != "__init__.py"]
    return tuple(other for other in every if other != file and line.search(other.read_text()))


def found_by(mutant: Mutant, limit: int, more: list[str]) -> str:
    """The test that fails with the mutant in its place; "" if all of the file's tests and `more` pass, UNFINISHED if
    they take longer than `limit` s of CPU."""
    file = ROOT / mutant.file
    original, times = file.read_bytes(), file.stat()
    names = dict.fromkeys([*tests_of(mutant.file), *more])
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", "-rfE", *names]
    with _machine_code(file.parent):
        try:
            file.write_text(mutant.text)
            done = subprocess.run(
                ["prlimit", f"--cpu={limit}", *command], cwd=ROOT, capture_output=True, text=True, check=False
            )
        finally:
            file.write_bytes(original)
            os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))
    if -done.returncode in (signal.SIGXCPU, signal.SIGKILL):
        return UNFINISHED
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    return "" if done.returncode == 0 else failed[1] if failed else f"exit {done.returncode}"


@contextmanager
def _machine_code(folder: Path) -> Iterator[None]:
    """Keep the machine code of a folder, whose kernels compile anew after a change of any of its files."""
    cache = folder / "__pycache__"
    cache.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as kept:
        shutil.copytree(cache, kept, dirs_exist_ok=True)
        try:
            yield
        finally:
            shutil.rmtree(cache)
            shutil.copytree(kept, cache)


def main() -> None:
    """Try a sample, print survivors and the share that was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", help="folders or files, relative to the project")
    parser.add_argument("--count", type=int, default=300, help="mutants (default 300)")
    parser.add_argument("--seed", type=int, default=0, help="of the sample (default 0)")
    parser.add_argument("--tests", nargs="*", default=[], help="files of tests that run for every mutant, too")
    parser.add_argument("--limit", type=int, default=300, help="s of CPU for one mutant (default 300)")
    parser.add_argument(
        "--out", type=Path, default=Path("mutants.csv"), help="one row per mutant (default mutants.csv)"
    )
    given = parser.parse_args()
    if subprocess.run(["git", "status", "--porcelain"], cwd=ROOT, capture_output=True, text=True, check=True).stdout:
        parser.error("the tree has changes: commit them first, for files are changed and put back")
    named = [ROOT / name for name in given.folders]
    files = sorted(file for name in named for file in ([name] if name.is_file() else name.rglob("*.py")))
    drawn = random.Random(given.seed)
    found = tried = 0
    with given.out.open("w", newline="") as out:
        table = csv.writer(out)
        table.writerow(["file", "line", "change", "found by"])
        for _ in (bar := tqdm(range(given.count), unit="mutant")):
            mutant = _drawn(files, drawn)
            by = found_by(mutant, given.limit, given.tests)
            found, tried = found + (by not in ("", UNFINISHED)), tried + (by != UNFINISHED)
            bar.set_postfix(found=f"{found}/{tried}")
            table.writerow([mutant.file, mutant.line, mutant.change, by])
            out.flush()
            if not by:
                tqdm.write(f"survives: {mutant.file}:{mutant.line}: {mutant.change}", file=sys.stdout)
    print(f"{found} of {tried} mutants were found, {given.count - tried} took too long.")


def _drawn(files: list[Path], drawn: random.Random) -> Mutant:
    """A mutant of a file that is drawn by its size."""
    while True:
        (file,) = drawn.choices(files, [file.stat().st_size for file in files])
        if all_ := list(mutants(file)):
            return drawn.choice(all_)


if __name__ == "__main__":
    main()
