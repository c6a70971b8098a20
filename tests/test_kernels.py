"""Machine code: when it is made anew, and that the package imports no numba."""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path

import pytest

from coopoc import Sensors
from coopoc.kernels.compiling import compile as kernels

pytest.importorskip("numba")
S2 = Sensors.paper_scenario2()


def test_machine_code_is_stale_after_a_change_of_any_file_beside_it(tmp_path: Path) -> None:
    file = tmp_path / "a.py"
    file.write_text("one")
    before = kernels._stamp.__wrapped__(tmp_path)
    file.write_text("other")
    assert kernels._stamp.__wrapped__(tmp_path) != before


def test_importing_the_package_imports_no_numba() -> None:
    code = "import sys, coopoc; print('numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_machine_code_of_types_that_are_gone_is_made_again(tmp_path: Path) -> None:
    """A cache from before a type was renamed cannot be read: the kernel compiles anew and is kept again."""
    (tmp_path / "own.py").write_text(
        "from coopoc.kernels.compiling.compile import compiled\n\n\n@compiled\ndef twice(x):\n    return 2.0 * x\n\n\n"
        "print(twice(4.0), sum(twice.stats.cache_hits.values()))\n"
    )

    def run() -> str:
        command = [sys.executable, tmp_path / "own.py"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    assert (run(), run()) == ("8.0 0\n", "8.0 1\n")
    (index,) = tmp_path.glob("__pycache__/*.nbi")
    with index.open("rb") as file:
        version = pickle.load(file)
    index.write_bytes(pickle.dumps(version) + b"cno_such_module\nThing\n.")
    assert (run(), run()) == ("8.0 0\n", "8.0 1\n")
