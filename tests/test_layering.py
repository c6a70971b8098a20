"""Imports run one way: world, optimize, methods, evaluate, study, cli; and the core names no plug-in package."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FLOORS = ["kernels", "formats", "world", "optimize", "methods", "evaluate", "study", "cli"]


def imports(path: Path) -> set[str]:
    """Absolute names of what a module imports, anywhere in it."""
    package = ["coopoc", *path.relative_to(ROOT / "coopoc").parts[:-1]]
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            source = [*base, *([node.module] if node.module else [])]
            found |= {".".join(source), *(".".join([*source, alias.name]) for alias in node.names)}
    return found


@pytest.mark.parametrize("path", sorted((ROOT / "coopoc").rglob("*.py")), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_run_one_way(path: Path) -> None:
    floor = path.relative_to(ROOT / "coopoc").parts[0].removesuffix(".py")
    for name in imports(path):
        assert not name.startswith(("coopoc.learned", "coopoc.studies", "coopoc.data")), f"{path} imports {name}"
        target = name.split(".")[1] if name.startswith("coopoc.") else ""
        if floor in FLOORS and target in FLOORS:
            assert FLOORS.index(target) <= FLOORS.index(floor), f"{path} imports {name}"
            assert {floor, target} != {"formats", "world"}, f"{path} imports {name}: the two stand side by side"


def test_import_is_light() -> None:
    """`import coopoc` and the core nouns load none of the heavy libraries."""
    heavy = {"torch", "cvxpy", "gtsam", "casadi", "osqp", "pandas", "matplotlib", "sklearn"}
    code = "import sys, coopoc; coopoc.Fleet, coopoc.observe; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not heavy & set(loaded)
