"""Machine code: when it is made anew, and what its compiling says."""

import importlib
import os
import pickle
import sys

import pytest
from shell import python

from coopoc import workers
from coopoc.kernels.compiling import machine_code

pytest.importorskip("numba")


def test_machine_code_is_stale_after_a_change_of_a_file_that_it_imports_and_no_other(tmp_path, monkeypatch):
    """a calls b, which calls c; d is beside them."""
    monkeypatch.syspath_prepend(tmp_path)
    for name, text in (
        ("a", "from b import x\ndef f(): ..."),
        ("b", "from c import (\n    x,\n)"),
        ("c", "x = 1"),
        ("d", "x = 2"),
    ):
        (tmp_path / f"stale_{name}.py").write_text(text.replace("from ", "from stale_") + "\n")
    for name in "ad":
        importlib.import_module(f"stale_{name}")

    def stamp():
        machine_code._digest.cache_clear()
        return machine_code.stamp(sys.modules["stale_a"].f)

    before = stamp()
    (tmp_path / "stale_d.py").write_text("x = 33")
    os.utime(tmp_path / "stale_c.py", (0, 0))
    assert stamp() == before
    (tmp_path / "stale_c.py").write_text("x = 3")
    assert stamp() != before


def test_a_kernel_depends_on_all_kernels_below_it():
    importlib.import_module("coopoc.kernels.stars.joint_filter")
    names = {name.rpartition(".")[2] for name in machine_code.sources("coopoc.kernels.stars.joint_filter")}
    assert {"messages", "geometry", "small", "compile"} <= names
    assert "smoother" not in names


def test_stale_machine_code_of_types_that_are_gone_is_made_again(tmp_path):
    """A cache from before a type was renamed cannot be read: the kernel compiles anew and is kept again."""
    (tmp_path / "own.py").write_text(
        "from coopoc.kernels.compiling.compile import compiled\n\n\n@compiled\ndef twice(x):\n    return 2.0 * x\n\n\n"
        "print(twice(4.0), sum(twice.stats.cache_hits.values()))\n"
    )

    def run():
        return python(tmp_path / "own.py")

    assert (run(), run()) == ("8.0 0\n", "8.0 1\n")
    (index,) = tmp_path.glob("__pycache__/*.nbi")
    with index.open("rb") as file:
        version = pickle.load(file)
    index.write_bytes(pickle.dumps(version) + b"cno_such_module\nThing\n.")
    assert (run(), run()) == ("8.0 0\n", "8.0 1\n")


def test_a_bar_fills_no_log_with_carriage_returns(capsys):
    for seldom, last in ((60.0, ""), (0.0, "steps: 100%")):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(workers, "LINE_SECONDS", seldom)
            assert [*workers.progress_bar(range(2), desc="steps")] == [0, 1]
        said = capsys.readouterr().err
        assert not {"\r", "\x1b"} & {*said}
        assert last in said
        assert bool(said) == bool(last)
