"""Mutation testing on a seeded sample: how many small faults do the tests that touch a file find?

    python benchmarks/mutants.py --count 40 --seed 1 coopoc/world coopoc/evaluate --out mutants.csv

A mutant is one change of one node of a file's syntax tree: a sign, a comparison, an operator, a constant, a term or a
check that is left out. Tests that mention what the file defines, for a kernel those that compare with an oracle, run
until the first fails. The file is put back after each; the tree must be clean. Without a mutant all these tests run
first and must pass; the machine code that they leave serves the mutants, but for files that import the changed one. A
mutant that survives is equivalent or shows a missing test.
"""

from __future__ import annotations

import argparse
import ast
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
from collections.abc import Iterable
from functools import cache
from importlib import import_module
from pathlib import Path

from mutations import ROOT, Mutant, mutants
from tqdm import tqdm

MOST_TESTS = 3
"""Files of tests, those that mention the file's names most."""
LONG = re.compile("test_(study|studies|cli|install|extend|site|examples|reliability|layering)")
"""Files of tests that run whole studies or look at conventions: they take minutes and see little of a formula."""
ORACLE = re.compile(r"^from (oracles|coopoc\.kernels)|callable_part", re.MULTILINE)
"""In tests that compare kernels with an oracle."""
LOADED = ("numba", "pandas", "pytest", "scipy.optimize", "scipy.sparse.linalg", "torch")
"""What every run of tests has loaded when it begins."""
UNFINISHED = "unfinished"


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
    tests = [test for test, score in scores.most_common() if score]
    if file.startswith("coopoc/kernels/"):
        much = scores.most_common(1)[0][1] / 4
        oracles = [
            t for t in tests if scores[t] >= much and ("test_kernels" in t or ORACLE.search((ROOT / t).read_text()))
        ]
        return [*dict.fromkeys([*oracles, *tests])][:2]
    return [*tests[:MOST_TESTS], file]


@cache
def _words() -> dict[str, Counter[str]]:
    """How often each word stands in each file of tests that is not LONG."""
    tests = {str(test.relative_to(ROOT)): test for test in (ROOT / "tests").glob("test_*.py")}
    return {
        name: Counter(re.findall(r"\w+", test.read_text())) for name, test in tests.items() if not LONG.search(name)
    }


@cache
def _defined(file: Path) -> tuple[str, ...]:
    """Public names of a file that are more than a common word, and its own."""
    kinds = ast.FunctionDef | ast.ClassDef
    names = [node.name for node in ast.parse(file.read_text()).body if isinstance(node, kinds)]
    return (file.stem, *(name for name in names if name[0] != "_" and (name != name.lower() or "_" in name)))


@cache
def _importers(file: Path) -> tuple[Path, ...]:
    """Files that import from a file."""
    folders = (ROOT / "coopoc", ROOT / "learned")
    every = [other for folder in folders for other in folder.rglob("*.py") if other.name != "__init__.py"]
    return tuple(other for other in every if file in _imported(other))


@cache
def _imported(file: Path) -> frozenset[Path]:
    """Files that a file imports from, among others that there are not."""
    found = set[Path]()
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.ImportFrom):
            above = file.parents[node.level - 1] if node.level else ROOT
            module = above.joinpath(*(node.module or "").split("."))
            found |= {module.with_suffix(".py"), *(module / f"{name.name}.py" for name in node.names)}
    return frozenset(found)


def affected(file: Path) -> set[Path]:
    """A file and all that import it, directly or through others."""
    found, level = {file}, {file}
    while level := {user for used in level for user in _importers(used)} - found:
        found |= level
    return found


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
    from coopoc.kernels import compile

    compile._stamp = lambda folders: ()  # whatever machine code there is holds: what a change makes stale was removed
    return pytest.main(["-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", "-rfE", *tests])


def found_by(mutant: Mutant, limit: int, tests: Iterable[str], machine_code: Path) -> str:
    """The test that fails with the mutant in its place; "" if all pass, UNFINISHED if they take longer than `limit` s
    of CPU. The machine code is that of the file as it was."""
    file = ROOT / mutant.file
    original, times = file.read_bytes(), file.stat()
    with tempfile.TemporaryDirectory(dir=machine_code.parent) as own:
        shutil.copytree(machine_code, own, copy_function=os.link, dirs_exist_ok=True)
        for stem in {"test_*", *(other.stem for other in affected(file))}:
            for stale in Path(own).rglob(f"{stem}.*.nb[ic]"):
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
    for library in LOADED:
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
