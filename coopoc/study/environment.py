"""The environment of a result, and revisions of source code for the names of cells."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import subprocess
from functools import lru_cache
from importlib import metadata
from pathlib import Path

from ..errors import InputError

_LIBRARIES = (
    "numpy",
    "scipy",
    "numba",
    "torch",
    "gtsam",
    "casadi",
    "cvxpy-base",
    "osqp",
    "pandas",
    "pyarrow",
    "joblib",
    "matplotlib",
)


def environment() -> dict[str, str]:
    """Versions of Python, coopoc and the libraries that compute, the processor, and the git revision if any."""
    found = {
        "coopoc": metadata.version("coopoc"),
        "git revision": git_revision(),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
    }
    for library in _LIBRARIES:
        try:
            found[library] = metadata.version(library)
        except metadata.PackageNotFoundError:
            continue
    return {name: value for name, value in found.items() if value}


def git_revision() -> str:
    """Commit of the checkout this package runs from, with "+ changes" if files differ; "" if it is none."""
    here = Path(__file__).resolve()

    def git(*words: str) -> str:
        try:
            done = subprocess.run(["git", "-C", str(here.parent), *words], capture_output=True, text=True, timeout=20)
        except (OSError, subprocess.TimeoutExpired):
            return ""
        return done.stdout.strip() if done.returncode == 0 else ""

    if not git("ls-files", "--error-unmatch", here.name):
        return ""
    return git("rev-parse", "--short=12", "HEAD") + (" + changes" if git("status", "--porcelain") else "")


@lru_cache
def revision(*modules: str) -> str:
    """Hash of the source files of modules or packages: cells that name it are computed again when the code changes.

    Args:
        modules: dotted names, such as "coopoc.methods".

    Raises:
        InputError: no such module.

    >>> len(revision("coopoc.world", "coopoc.errors"))
    20
    """
    sha = hashlib.sha256()
    for module in modules:
        spec = importlib.util.find_spec(module)
        if spec is None or spec.origin is None:
            raise InputError("module", repr(module), "must be importable from source", "Give its dotted name.")
        folders = spec.submodule_search_locations
        files = [Path(spec.origin)] if folders is None else sorted(p for f in folders for p in Path(f).rglob("*.py"))
        for file in files:
            sha.update(file.name.encode() + file.read_bytes())
    return sha.hexdigest()[:20]


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "")
    except OSError:
        model = ""
    return f"{model or platform.processor() or platform.machine()}, {os.cpu_count()} cores"
