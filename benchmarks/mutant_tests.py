"""The tests that look at a file, and the files that its change reaches: by imports, and by the words of the tests."""

from __future__ import annotations

import ast
import re
from collections import Counter
from functools import cache
from pathlib import Path

from mutations import ROOT

MOST_TESTS = 3
"""Files of tests, those that mention the file's names most."""
LONG = re.compile("test_(study|studies|cli|install|extend|site|examples|reliability|layering)")
"""Files of tests that run whole studies or look at conventions: they take minutes and see little of a formula."""
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
    tests = [test for test, score in scores.most_common() if score]
    if file.startswith("coopoc/kernels/"):
        much = scores.most_common(1)[0][1] / 4
        near = [test for test in tests if scores[test] >= much]
        oracles = [test for test in near if "test_kernels" in test or ORACLE.search((ROOT / test).read_text())]
        return [*dict.fromkeys([*oracles, *tests])][:2]
    return [*tests[:MOST_TESTS], file]


@cache
def _words() -> dict[str, Counter[str]]:
    """How often each word stands in each file of tests that is not LONG."""
    texts = {str(test.relative_to(ROOT)): test.read_text() for test in (ROOT / "tests").glob("test_*.py")}
    return {test: Counter(re.findall(r"\w+", text)) for test, text in texts.items() if not LONG.search(test)}


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
