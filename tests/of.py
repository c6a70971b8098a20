"""Tests that reach a file or folder, nearest first: `python tests/of.py coopoc/kernels/gate.py [FARTHEST]`.

A step is an import, followed to the file that defines the name, a module's name in a string, or in a test the name of a
plug-in. At one distance, tests that reach fewest files come first. Not followed: pages and examples that run elsewhere.
"""

import ast
import sys
import tomllib
from functools import cache
from importlib.util import resolve_name
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PLUGINS = {k: v.partition(":")[0] for group in PROJECT["project"]["entry-points"].values() for k, v in group.items()}
FILES: dict[str, Path] = {}
BESIDE = [("", folder) for folder in PROJECT["tool"]["pytest"]["ini_options"]["pythonpath"]]
for package, folder in [*PROJECT["tool"]["setuptools"]["package-dir"].items(), *BESIDE]:
    for path in (ROOT / folder).rglob("*.py"):
        parts = filter(None, [package, *path.relative_to(ROOT / folder).with_suffix("").parts])
        FILES[".".join(parts).removesuffix(".__init__")] = path


@cache
def nodes(module):
    """Of a module's text, or of the stub beside it, without imports for types alone."""
    stub = FILES[module].with_suffix(".pyi")
    tree = ast.parse((stub if stub.exists() else FILES[module]).read_bytes())
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body = []
    return tuple(ast.walk(tree))


@cache
def names(module):
    """What each imported name is: a module, and a name there or none."""
    found: dict[str, tuple[str, str]] = {}
    package = module if FILES[module].stem == "__init__" else module.rpartition(".")[0]
    for node in nodes(module):
        if isinstance(node, ast.Import):
            found |= {alias.asname or alias.name: (alias.name, "") for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            source = resolve_name("." * node.level + (node.module or ""), package)
            found |= {alias.asname or alias.name: (source, alias.name) for alias in node.names}
    return found


def home(module, name):
    """Module that defines a name of a module."""
    if f"{module}.{name}" in FILES:
        return f"{module}.{name}"
    above = module in FILES and FILES[module].stem == "__init__" and names(module).get(name)
    return home(*above) if above else module


@cache
def uses(module):
    """Modules of the project that a module needs."""
    known, plugins = names(module), PLUGINS if FILES[module].is_relative_to(ROOT / "tests") else {}
    found = {home(*target) for target in known.values()}
    for node in nodes(module):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in known:
            found.add(home(home(*known[node.value.id]), node.attr))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found |= {node.value if "." in node.value else "", plugins.get(node.value, "")}
    return frozenset(found & FILES.keys() - {module, "coopoc"})  # `import coopoc` loads nothing


def distance(test, goal):
    """Imports from a test to the nearest of some modules, and how many modules are as near; 0 if none is reached."""
    ring, seen, steps = {test}, {test}, 0
    while ring and goal.isdisjoint(ring):
        ring, steps = {other for near in ring for other in uses(near)} - seen, steps + 1
        seen |= ring
    return (steps if ring else 0), len(seen)


if __name__ == "__main__":
    wanted, farthest = Path(sys.argv[1]).resolve(), int([*sys.argv, "99"][2])
    goal = {module for module, path in FILES.items() if wanted in (path, *path.parents)}
    tests = {module: path.relative_to(ROOT) for module, path in FILES.items() if path.match("tests/test_*.py")}
    ranks = sorted((distance(module, goal), str(path)) for module, path in tests.items())
    print(*(path for (steps, _), path in ranks if 0 < steps <= farthest), sep="\n")
