"""The built wheel, installed elsewhere and used from outside the repository: imports, data, workers, types."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PARTS = ["coopoc", "learned", "studies", "data", "pyproject.toml", "README.md", "LICENSE", "NOTICE"]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with nothing but the installed wheel; built from a copy, so that the tree stays clean."""
    source, site = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("site")
    for part in PARTS:
        copy = shutil.copytree if (ROOT / part).is_dir() else shutil.copy
        copy(ROOT / part, source / part)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--no-deps"]
    subprocess.run([*pip, "--no-build-isolation", "--target", str(site), str(source)], check=True)
    return site


def outside(site: Path, tmp_path: Path, *command: str) -> str:
    """Output of a command run in an empty folder that sees the installed wheel first."""
    env = {**os.environ, "PYTHONPATH": str(site), "MYPYPATH": str(site)}
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-3000:]
    return done.stdout


def test_everything_imports_from_the_wheel(site: Path, tmp_path: Path) -> None:
    code = """
import coopoc, coopoc.learned, coopoc.studies, coopoc.data, joblib
from coopoc.data.registry import load_fleet as load
from coopoc.learned.recipes import load_method
print(load_method("fedkalmannet").name)
print(coopoc.__file__, coopoc.learned.__file__, coopoc.studies.__file__, coopoc.data.__file__)
print(load("town04"), joblib.Parallel(n_jobs=2)(joblib.delayed(load)(n) for n in ("town10", "town10-clients")))
"""
    out = outside(site, tmp_path, sys.executable, "-W", "error", "-c", code)
    assert out.splitlines()[0] == "fedkalmannet"
    assert out.splitlines()[1].count(str(site)) == 4
    assert "town04: 60 vehicles" in out
    assert "town10: 60 vehicles" in out


@pytest.mark.slow
def test_installed_package_is_strictly_typed(site: Path, tmp_path: Path) -> None:
    config = str(ROOT / "pyproject.toml")
    outside(site, tmp_path, sys.executable, "-m", "mypy", "--strict", "--config-file", config, "-p", "coopoc")
