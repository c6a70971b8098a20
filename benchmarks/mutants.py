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
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path

from mutant_tests import affected, tests_of
from mutations import ROOT, Mutant, mutants
from tqdm import tqdm

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
    from coopoc.kernels.compiling import compile

    compile._stamp = lambda folder: ()  # whatever machine code there is holds: what a change makes stale was removed
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
