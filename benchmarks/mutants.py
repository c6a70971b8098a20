"""Mutation testing on a seeded sample: how many small faults do the tests that touch a file find?

    python benchmarks/mutants.py --count 40 --seed 1 coopoc/world coopoc/evaluate --out mutants.csv

A mutant is one change of one node of a file's syntax tree: a sign, a comparison, an operator, a constant, a term or a
check that is left out. Tests that mention what the file defines, for a kernel those that compare with an oracle, run
until the first fails. The file is put back after each; the tree must be clean. Without a mutant all these tests run
first and must pass; the machine code that they leave serves the mutants, but for files that import the changed one. A
mutant that survives is equivalent or shows a missing test.
"""

import argparse
import ast
import copy
import csv
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib import import_module
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


MOST_TESTS = 3
"""Files of tests, those that mention the file's names most."""
LONG = re.compile("^(?!studies).*test_(study|studies|cli|install|extend|site|examples|reliability|layering)")
"""Tests of whole studies or of conventions, behind a file that is no study: they take minutes and see little of a
formula."""
FOLDERS = ("coopoc", "data", "learned", "studies")
ORACLE = re.compile(r"^from (oracles|coopoc\.kernels)|callable_part", re.MULTILINE)
"""In tests that compare kernels with an oracle."""


def tests_of(file: str) -> list[str]:
    """Files of tests that mention most what a file defines, what files define that import it, and those that import
    these, each less than the one before; a shared word in the names of the files counts as ten mentions. For a kernel
    two, first those that compare with an oracle and mention at least a quarter as much as the best."""
    weights, level, scores = {ROOT / file: 9}, {ROOT / file}, Counter[str]()
    for weight in (3, 1):
        level = {user for used in level for user in _importers(used)} - weights.keys()
        weights |= dict.fromkeys(level, weight)
    for used, weight in weights.items():
        for test, words in _words().items():
            shared = set(used.stem.split("_")) & set(Path(test).stem.split("_")[1:])
            scores[test] += weight * (sum(words[name] for name in _defined(used)) + 10 * len(shared))
    tests = [test for test, score in scores.most_common() if score and not LONG.search(f"{file} {test}")]
    if file.startswith("coopoc/kernels/"):
        much = scores.most_common(1)[0][1] / 4
        near = [test for test in tests if scores[test] >= much]
        oracles = [test for test in near if "test_kernels" in test or ORACLE.search((ROOT / test).read_text())]
        return [*dict.fromkeys([*oracles, *tests])][:2]
    return [*tests[:MOST_TESTS], file]


@cache
def _words() -> dict[str, Counter[str]]:
    """How often each word stands in each file of tests."""
    tests = (ROOT / "tests").glob("test_*.py")
    return {str(test.relative_to(ROOT)): Counter(re.findall(r"\w+", test.read_text())) for test in tests}


@cache
def _defined(file: Path) -> tuple[str, ...]:
    """Public names of a file that are more than a common word, and its own."""
    body = ast.parse(file.read_text()).body
    names = [node.name for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
    return (file.stem, *(name for name in names if name[0] != "_" and (name != name.lower() or "_" in name)))


@cache
def _importers(file: Path) -> tuple[Path, ...]:
    """Files that import from a file."""
    every = [other for folder in FOLDERS for other in (ROOT / folder).rglob("*.py") if other.name != "__init__.py"]
    return tuple(other for other in every if file in _imported(other))


@cache
def _imported(file: Path) -> frozenset[Path]:
    """Files that a file imports from, among others that there are not."""
    found = set[Path]()
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.ImportFrom):
            above = file.parents[node.level - 1] if node.level else ROOT
            named = re.sub(r"^coopoc\.(?=data|learned|studies)", "", node.module or "")
            module = above.joinpath(*named.split("."))
            found |= {module.with_suffix(".py"), *(module / f"{name.name}.py" for name in node.names)}
    return frozenset(found)


def affected(file: Path) -> set[Path]:
    """A file and all that import it, directly or through others."""
    found, level = {file}, {file}
    while level := {user for used in level for user in _importers(used)} - found:
        found |= level
    return found


LIBRARIES = ("numba", "pandas", "pytest", "scipy.optimize", "scipy.sparse.linalg", "torch")
"""What every run of tests has loaded when it begins."""
UNFINISHED = "unfinished"


def run(tests: Iterable[str], limit: int, machine_code: Path) -> tuple[int, str]:
    """Run tests until the first fails, `limit` s of CPU at most, in a fork: minus the signal that ended it or the exit
    status, and the output."""
    with tempfile.TemporaryFile("w+") as out:
        if not (child := os.fork()):
            os.dup2(out.fileno(), 1)
            os.dup2(out.fileno(), 2)
            os._exit(_tested(list(tests), limit, machine_code))
        _, status = os.waitpid(child, 0)
        out.seek(0)
        return os.waitstatus_to_exitcode(status), out.read()


def _tested(tests: list[str], limit: int, machine_code: Path) -> int:
    import numba
    import pytest

    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit))
    os.chdir(ROOT)
    os.environ["NUMBA_CACHE_DIR"] = numba.config.CACHE_DIR = str(machine_code)
    from coopoc.kernels.compiling import machine_code as kept

    kept.stamp = lambda function: ""  # whatever machine code there is holds: what a change makes stale was removed
    return pytest.main(["-x", "-q", "-m", "not slow", "-k", "not stale", "-p", "no:cacheprovider", "-rfE", *tests])


def found_by(mutant: Mutant, limit: int, tests: Iterable[str], machine_code: Path) -> str:
    """The test that fails with the mutant in its place; "" if all pass, UNFINISHED if they take longer than `limit` s
    of CPU. The machine code is that of the file as it was."""
    file = ROOT / mutant.file
    original, times = file.read_bytes(), file.stat()
    with tempfile.TemporaryDirectory(dir=machine_code.parent) as own:
        shutil.copytree(machine_code, own, copy_function=os.link, dirs_exist_ok=True)
        for stem in {"test_*", *(other.stem for other in affected(file))}:
            for stale in Path(own).rglob(f"*{stem}.*.nb[ic]"):
                stale.unlink()
        try:
            file.write_text(mutant.text)
            status, output = run(tests, limit, Path(own))
        finally:
            file.write_bytes(original)
            os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))
    if -status in (signal.SIGXCPU, signal.SIGKILL):
        return UNFINISHED
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", output, re.MULTILINE)
    return "" if status == 0 else failed[1] if failed else f"exit {status}"


def main() -> None:
    """Try a sample, print survivors and the share that was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", help="folders or files, relative to the project")
    parser.add_argument("--count", type=int, default=300, help="mutants (default 300)")
    parser.add_argument("--skip", type=int, default=0, help="mutants of the sample that were tried before (default 0)")
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
    for library in LIBRARIES:
        import_module(library)
    sample = _sample(files, random.Random(given.seed), given.count)[given.skip :]
    tests = {mutant: dict.fromkeys([*tests_of(mutant.file), *given.tests]) for mutant in sample}
    found = tried = 0
    with tempfile.TemporaryDirectory() as kept, given.out.open("w", newline="") as out:
        machine_code = Path(kept) / "as_committed"
        every = sorted({test for chosen in tests.values() for test in chosen})
        status, output = run(every, 3600, machine_code)
        if status:
            parser.error(f"tests fail without a mutant:\n{output[-3000:]}")
        table = csv.writer(out)
        table.writerow(["file", "line", "change", "found by"])
        for mutant in (bar := tqdm(sample, unit="mutant")):
            by = found_by(mutant, given.limit, tests[mutant], machine_code)
            found, tried = found + (by not in ("", UNFINISHED)), tried + (by != UNFINISHED)
            bar.set_postfix(found=f"{found}/{tried}")
            table.writerow([mutant.file, mutant.line, mutant.change, by])
            out.flush()
            if not by:
                tqdm.write(f"survives: {mutant.file}:{mutant.line}: {mutant.change}", file=sys.stdout)
    print(f"{found} of {tried} mutants were found, {len(sample) - tried} took too long.")


def _sample(files: list[Path], drawn: random.Random, count: int) -> list[Mutant]:
    """Different mutants, each of a file that is drawn by its size."""
    sample: dict[Mutant, None] = {}
    sizes = [file.stat().st_size for file in files]
    while len(sample) < count:
        if all_ := list(mutants(drawn.choices(files, sizes)[0])):
            sample[drawn.choice(all_)] = None
    return list(sample)


if __name__ == "__main__":
    main()
