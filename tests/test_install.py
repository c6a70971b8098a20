"""The built wheel, installed elsewhere and used from outside the repository: imports, data, workers, types."""

import os
import re
import shutil
import subprocess
import sys

import pytest
from shell import ROOT, python, ran

from coopoc.errors import MissingLibraryError

PARTS = ["coopoc", "learned", "studies", "data", "pyproject.toml", "README.md", "LICENSE", "NOTICE"]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder with nothing but the installed wheel; built from a copy, so that the tree stays clean."""
    source, site = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("site")
    for part in PARTS:
        copy = shutil.copytree if (ROOT / part).is_dir() else shutil.copy
        copy(ROOT / part, source / part)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--no-deps"]
    subprocess.run([*pip, "--no-build-isolation", "--target", str(site), str(source)], check=True)
    return site


def outside(site, tmp_path, *command):
    """Output of a command run in an empty folder that sees the installed wheel first."""
    return python(*command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(site), "MYPYPATH": str(site)})


def test_everything_imports_from_the_wheel(site, tmp_path):
    code = """
import coopoc, coopoc.learned, coopoc.studies, coopoc.data, joblib
from coopoc.data.registry import load_fleet as load
from coopoc.learned.recipes import load_method
print(load_method("fedkalmannet").name)
print(coopoc.__file__, coopoc.learned.__file__, coopoc.studies.__file__, coopoc.data.__file__)
print(load("town04"), joblib.Parallel(n_jobs=2)(joblib.delayed(load)(n) for n in ("town10", "town10-clients")))
"""
    out = outside(site, tmp_path, "-W", "error", "-c", code)
    assert out.splitlines()[0] == "fedkalmannet"
    assert out.splitlines()[1].count(str(site)) == 4
    assert "town04: 60 vehicles" in out
    assert "town10: 60 vehicles" in out


@pytest.mark.slow
def test_installed_package_is_strictly_typed(site, tmp_path):
    outside(site, tmp_path, "-m", "mypy", "--strict", "--config-file", str(ROOT / "pyproject.toml"), "-p", "coopoc")


WITHOUT_TORCH = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "safetensors"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Absent())
"""
"""Not installed: `torch` and its extra are left out of the core."""


def test_without_torch_all_but_learned_gains_works(tmp_path):
    code = f"""{WITHOUT_TORCH}
import coopoc as co
from coopoc.cli import main
fleet = co.load_fleet("town10")
v2x = co.V2X(max_neighbours=2)
seen = co.observe(fleet.between(0, 30), co.Sensors.paper_scenario2(), v2x, observers=[24])
print(co.JointFilter()(seen, egos=[24]).x.shape)
print(co.solve(co.Problem.from_snapshot(seen, step=9, ego=24)).status.name)
for words in (["list"], ["run", "side_by_side", "--set", "method=kalman,joint", "runs=1", "max_neighbours=6"]):
    try:
        main(words)
    except SystemExit as end:
        assert not end.code, (words, end.code)
assert "torch" not in sys.modules
for words in (["train", "okf"], ["run", "neighbours", "--set", "method=okf", "runs=1"]):
    try:
        main(words)
    except SystemExit as end:
        assert end.code == 2, (words, end.code)
"""
    done = ran([sys.executable, "-c", code], cwd=tmp_path)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    assert "SOLVED" in done.stdout
    assert "fedkalmannet" in done.stdout
    assert done.stderr.count(str(MissingLibraryError("torch", "a learned gain", "'coopoc[learned]'"))) == 2
    assert re.search(r"pip install (-e )?'/.*\[learned\]'", done.stderr)  # from the folder: no index has it


@pytest.mark.parametrize("library", ["casadi", "pyarrow", "cvxpy", "osqp", "gtsam", "pandas"])
def test_what_is_missing_is_named_and_the_rest_works(tmp_path, library):
    code = f"""
import sys
from functools import partial
import numpy as np
sys.modules[{library!r}] = None  # as if it were not installed
import coopoc as co
from coopoc.cli import main
still = np.zeros((3, 2, 3))
seen = co.observe(co.Fleet(("a", "b"), [0, 0.1, 0.2], still + [[[0, 0, 0], [9, 1, 0]]], still), co.Sensors(), co.V2X(1))
print(co.Kalman()(seen, ["a"]).x.shape)
problem = co.Problem.from_snapshot(seen, step=1, ego="a")
uses = {{
    "casadi": lambda: co.solve(problem),
    "fleet": lambda: co.load_fleet("town10"),
    **{{name: partial(co.solve, problem, name) for name in ("cvxpy", "osqp", "gtsam")}},
}}
for name, use in uses.items():
    try:
        use()
    except ImportError as error:
        print("refused", name, error)
    except co.InputError as error:
        print("another reason", name)
main(["check"])
"""
    done = ran([sys.executable, "-c", code], cwd=tmp_path)
    assert done.returncode == 1
    assert "(1, 3, 1, 3)" in done.stdout
    refused = [line.split()[1] for line in done.stdout.splitlines() if line.startswith("refused")]
    assert refused == {"pyarrow": ["fleet"], "pandas": ["fleet"], "casadi": ["casadi", "osqp", "gtsam"]}.get(
        library, [library]
    )
    assert re.search(f"coopoc: {library}(-base)? is not installed. Run: pip install {library}", done.stderr)
    assert done.stdout.count("SOLVED") == {"casadi": 0, "pyarrow": 5, "pandas": 5}.get(library, 4)
