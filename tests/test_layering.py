"""Imports run one way: world, optimize, methods, evaluate, study, cli; and the core names no plug-in package."""

import ast

import pytest
from shell import ROOT, python

FLOORS = ["kernels", "formats", "world", "optimize", "methods", "evaluate", "study", "cli"]


FOLDERS = {"coopoc.learned": "learned", "coopoc.studies": "studies", "coopoc.data": "data"}
"""Packages that stand in a folder of their own, as pyproject.toml maps them."""


def modules(package):
    """Dotted name -> file of every module in a package."""
    folder = ROOT / FOLDERS.get(package, package)
    files = {".".join([package, *p.relative_to(folder).with_suffix("").parts]): p for p in folder.rglob("*.py")}
    return {name.removesuffix(".__init__"): path for name, path in files.items()}


CORE = modules("coopoc")


def imports(name, path):
    """Of every import in a module, also in a function or for types only: the module, and the names taken from it."""
    package = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from ((alias.name, set()) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            yield source, {f"{source}.{alias.name}" for alias in node.names}


ROOMS = {
    "optimize": ["model", "algebra", "assess", "descent", "starts", "robust", "convex", "backends"],
    "kernels": ["compiling", "graphs", "stars", "poses"],
}
"""Folders of a floor, each of which imports those before it only; modules beside them stand above or below all."""


@pytest.mark.parametrize("floor", ROOMS)
def test_rooms_of_a_floor_import_one_way(floor):
    order = ROOMS[floor]
    assert {p.parent.name for p in (ROOT / "coopoc" / floor).glob("*/__init__.py")} == set(order)
    for module, path in CORE.items():
        if path.parent.parent != ROOT / "coopoc" / floor:
            continue
        for target in {name for source, names in imports(module, path) for name in (source, *names)}:
            room = target.removeprefix(f"coopoc.{floor}.").split(".")[0]
            if target.startswith(f"coopoc.{floor}.") and room in order:
                assert order.index(room) <= order.index(path.parent.name), f"{path} imports {target}"


@pytest.mark.parametrize("module", CORE)
def test_imports_run_one_way(module):
    floor = module.split(".")[1] if "." in module else ""
    for target in {name for source, names in imports(module, CORE[module]) for name in (source, *names)}:
        assert not target.startswith(tuple(FOLDERS)), f"{module} imports {target}"
        other = target.split(".")[1] if target.startswith("coopoc.") else ""
        if floor in FLOORS and other in FLOORS:
            assert FLOORS.index(other) <= FLOORS.index(floor), f"{module} imports {target}"
            assert {floor, other} != {"formats", "world"}, f"{module} imports {target}: the two stand side by side"


def circles(package):
    """Modules of a package that import each other in a circle, whatever place an import stands at."""
    files = modules(package)
    arrows: dict[str, set[str]] = {}
    for name, path in files.items():
        taken = (names if names & files.keys() else {source} for source, names in imports(name, path))
        arrows[name] = set().union(*taken) & files.keys() - {name}
    reached = {name: set(targets) for name, targets in arrows.items()}
    for middle in arrows:
        for targets in reached.values():
            if middle in targets:
                targets |= reached[middle]
    groups = {tuple(sorted({name, *(o for o in reached[name] if name in reached[o])})) for name in reached}
    return sorted(list(group) for group in groups if group[0] in reached[group[-1]] and len(group) > 1)


@pytest.mark.parametrize("package", ["coopoc", *FOLDERS])
def test_no_file_imports_in_a_circle(package):
    assert circles(package) == []


def test_import_is_light():
    """`import coopoc` and the core nouns load none of the heavy libraries."""
    heavy = {"numba", "torch", "cvxpy", "gtsam", "casadi", "osqp", "pandas", "matplotlib", "sklearn"}
    assert not heavy & set(
        python("-c", "import sys, coopoc; coopoc.Fleet, coopoc.observe; print(*sys.modules)").split()
    )
