"""Imports run one way: world, optimize, methods, evaluate, study, cli; and the core names no plug-in package."""

from __future__ import annotations

import ast
import subprocess
import sys
import tempfile
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


ROOMS = {
    "optimize": [
        "model",
        "algebra",
        "assess",
        "descent",
        "starts",
        "robust",
        "convex",
        "backends",
    ],
    "kernels": ["compiling", "graphs", "stars", "windows", "poses", "fleets"],
}
"""Folders of a floor, each of which imports those before it only; modules beside them stand above or below all."""


@pytest.mark.parametrize("floor", ROOMS)
def test_rooms_of_a_floor_import_one_way(floor: str) -> None:
    order = ROOMS[floor]
    assert {p.parent.name for p in (ROOT / "coopoc" / floor).glob("*/__init__.py")} == set(order)
    for path in sorted((ROOT / "coopoc" / floor).glob("*/*.py")):
        for name in imports(path):
            target = name.removeprefix(f"coopoc.{floor}.").split(".")[0]
            if name.startswith(f"coopoc.{floor}.") and target in order:
                assert order.index(target) <= order.index(path.parent.name), f"{path} imports {name}"


@pytest.mark.parametrize("path", sorted((ROOT / "coopoc").rglob("*.py")), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_run_one_way(path: Path) -> None:
    floor = path.relative_to(ROOT / "coopoc").parts[0].removesuffix(".py")
    for name in imports(path):
        assert not name.startswith(("coopoc.learned", "coopoc.studies", "coopoc.data")), f"{path} imports {name}"
        target = name.split(".")[1] if name.startswith("coopoc.") else ""
        if floor in FLOORS and target in FLOORS:
            assert FLOORS.index(target) <= FLOORS.index(floor), f"{path} imports {name}"
            assert {floor, target} != {"formats", "world"}, f"{path} imports {name}: the two stand side by side"


FOLDERS = {"coopoc.learned": "learned", "coopoc.studies": "studies", "coopoc.data": "data"}
"""Packages that stand in a folder of their own, as pyproject.toml maps them."""


def modules(package: str) -> dict[str, Path]:
    """Dotted name -> file of every module in a package."""
    folder = ROOT / FOLDERS.get(package, package.replace(".", "/"))
    found = {".".join([package, *p.relative_to(folder).with_suffix("").parts]): p for p in folder.rglob("*.py")}
    return {name.removesuffix(".__init__"): path for name, path in found.items()}


def imported(name: str, path: Path, known: set[str]) -> set[str]:
    """Modules among `known` that a module imports anywhere: at its top, in a function, or for types only."""
    package = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            names = {f"{source}.{alias.name}" for alias in node.names}
            found |= names if names & known else {source}
    return found & known - {name}


def circles(package: str) -> list[list[str]]:
    """Modules of a package that import each other in a circle, whatever place an import stands at."""
    files = modules(package)
    arrows = {name: imported(name, path, set(files)) for name, path in files.items()}
    reached = {name: set(targets) for name, targets in arrows.items()}
    for middle in arrows:
        for targets in reached.values():
            if middle in targets:
                targets |= reached[middle]
    found = {tuple(sorted({name, *(o for o in reached[name] if name in reached[o])})) for name in reached}
    return sorted(list(group) for group in found if group[0] in reached[group[-1]] and len(group) > 1)


@pytest.mark.parametrize("package", ["coopoc", *FOLDERS])
def test_no_file_imports_in_a_circle(package: str) -> None:
    assert circles(package) == []


def test_a_circle_is_found() -> None:
    """Three files in a circle, one of them inside a function, and a fourth that only leads to them."""
    files = {"a": "from . import b", "b": "def f():\n    from .c import x", "c": "import p.a", "d": "from . import a"}
    with tempfile.TemporaryDirectory(dir=ROOT / "tests", prefix="circle_") as folder:
        package = f"tests.{Path(folder).name}"
        for name, text in files.items():
            (Path(folder) / f"{name}.py").write_text(text.replace("p.a", f"{package}.a"))
        assert circles(package) == [[f"{package}.{name}" for name in "abc"]]


def test_import_is_light() -> None:
    """`import coopoc` and the core nouns load none of the heavy libraries."""
    heavy = {"torch", "cvxpy", "gtsam", "casadi", "osqp", "pandas", "matplotlib", "sklearn"}
    code = "import sys, coopoc; coopoc.Fleet, coopoc.observe; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not heavy & set(loaded)
