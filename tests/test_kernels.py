"""Machine code: when it is made anew, and that the package imports no numba."""

import importlib
import pickle
import sys
from pathlib import Path

import pytest
from shell import ran

from coopoc import Sensors
from coopoc.kernels.compiling import compile as kernels

pytest.importorskip("numba")
S2 = Sensors.paper_scenario2()


def test_machine_code_is_stale_after_a_change_of_a_file_that_it_imports_and_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """a calls b, which calls c; d is beside them."""
    monkeypatch.syspath_prepend(tmp_path)
    for name, text in (("a", "from b import x"), ("b", "from c import (\n    x,\n)"), ("c", "x = 1"), ("d", "x = 2")):
        (tmp_path / f"stale_{name}.py").write_text(text.replace("from ", "from stale_") + "\n")
    for name in "ad":
        importlib.import_module(f"stale_{name}")

    def stamp() -> object:
        return kernels._stamp.__wrapped__("stale_a")

    before = stamp()
    (tmp_path / "stale_d.py").write_text("x = 33")
    assert stamp() == before
    (tmp_path / "stale_c.py").write_text("x = 333")
    assert stamp() != before


def test_a_kernel_depends_on_all_kernels_below_it() -> None:
    importlib.import_module("coopoc.kernels.stars.joint_filter")
    names = {name for name, *_ in kernels._stamp("coopoc.kernels.stars.joint_filter")}
    assert {"joint.py", "messages.py", "relative.py", "small.py", "compile.py"} <= names
    assert "horizon.py" not in names


def test_importing_the_package_imports_no_numba() -> None:
    code = "import sys, coopoc; print('numba' in sys.modules)"
    done = ran([sys.executable, "-c", code], check=True)
    assert done.stdout.strip() == "False"


def test_machine_code_of_types_that_are_gone_is_made_again(tmp_path: Path) -> None:
    """A cache from before a type was renamed cannot be read: the kernel compiles anew and is kept again."""
    (tmp_path / "own.py").write_text(
        "from coopoc.kernels.compiling.compile import compiled\n\n\n@compiled\ndef twice(x):\n    return 2.0 * x\n\n\n"
        "print(twice(4.0), sum(twice.stats.cache_hits.values()))\n"
    )

    def run() -> str:
        command = [sys.executable, tmp_path / "own.py"]
        return ran(command, check=True).stdout

    assert (run(), run()) == ("8.0 0\n", "8.0 1\n")
    (index,) = tmp_path.glob("__pycache__/*.nbi")
    with index.open("rb") as file:
        version = pickle.load(file)
    index.write_bytes(pickle.dumps(version) + b"cno_such_module\nThing\n.")
    assert (run(), run()) == ("8.0 0\n", "8.0 1\n")
