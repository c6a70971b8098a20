"""The engine: resume, failures, processes. The study is a real one that is installed as a third party's."""

import errno
import os
import shutil
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import refused
from joblib.externals.loky import reusable_executor
from small_runs import files, numbers, shown

import coopoc as co
from coopoc.cli import _status
from coopoc.study.publish import views
from coopoc.study.run import WorkerDiedError, compute, plan, run_study, schedule, write_tracks
from coopoc.study.study import Cell, Study
from coopoc.world.storage import save_recording

RECORDING = co.observe(co.load_fleet("town10").between(0, 3).select([0, 1]), co.Sensors())


def test_two_processes_compute_what_one_computes(study, tmp_path):
    one = run_study(study, tmp_path / "one", jobs=1)
    with pytest.MonkeyPatch.context() as before:  # workers that are left over know not where the study is
        before.setattr(sys, "path", [place for place in sys.path if not place.endswith("distribution")])
        assert len(list(compute(repr, [Cell({}, {}, "a"), Cell({}, {}, "b")], 64))) == 2  # type: ignore[arg-type]
        assert reusable_executor._executor._max_workers == 2
    assert numbers(one.frame).equals(numbers(run_study(study, tmp_path / "two", jobs=2).frame))
    for name in ("tables/rt_le.csv", "tables/rt_le.tex", "figures/rt_le.pdf", "figures/rt_le.png", "figures/rt_le.svg"):
        assert (tmp_path / "one/small" / name).read_bytes() == (tmp_path / "two/small" / name).read_bytes()


def test_a_failed_cell_is_a_row_with_its_reason_and_stays_one_until_it_is_asked_for(study, tmp_path):
    trouble = tmp_path / "trouble"
    trouble.write_text("raise")
    changes = {"trouble": str(trouble)}
    first = run_study(study, tmp_path, settings=changes)
    assert first.failed == 1
    row = first.failures.iloc[0]
    assert (row["method"], row["max_neighbours"], row["status"]) == ("kalman", 1, "failed")
    assert row["reason"] == "FloatingPointError: the filter diverged at step 3"
    assert "small_study.py" in row["traceback"]
    assert set(first.frame["status"]) == {"ok"}
    assert "–" in (tmp_path / "small/tables/rt_le.md").read_text()
    finished, failed = files(tmp_path / "small"), files(tmp_path / "small", "failed")
    trouble.unlink()
    assert run_study(study, tmp_path, settings=changes).failed == 1
    assert files(tmp_path / "small", "failed") == failed
    second = run_study(study, tmp_path, settings=changes, retry_failed=True)
    assert second.failed == 0
    assert len(second.frame) == 9 * 2 * 4
    assert not list((tmp_path / "small/failed").iterdir())
    assert {name: files(tmp_path / "small")[name] for name in finished} == finished


def test_tables_of_other_settings_than_the_last_ones_are_not_shown(study, tmp_path):
    run_study(study, tmp_path)
    with pytest.raises(ZeroDivisionError):
        run_study(replace(study, prepare=lambda cells, jobs: 1 / 0), tmp_path, settings={"max_neighbours": 7})
    with refused("has tables and figures of other cells"):
        views(tmp_path / "small")


def test_a_view_that_needs_a_failed_cell_is_named_with_its_reason(study, tmp_path):
    trouble = tmp_path / "trouble"
    trouble.write_text("exit")
    results = run_study(study, tmp_path, settings={"trouble": str(trouble), "max_neighbours": 1, "method": "kalman"})
    with refused("1 cells failed. SystemExit"):
        results.values("rt_le_m")
    assert set(views(tmp_path / "small")["missing"]) == {"rt_le", "findings"}


def test_a_view_that_fails_is_raised_and_named_beside_the_others(study, tmp_path):
    def broken(results):
        raise ZeroDivisionError("of the study")

    wrong = replace(study, figures={"broken": broken, **study.figures})
    with pytest.raises(ZeroDivisionError, match="of the study"):
        run_study(wrong, tmp_path, settings={"max_neighbours": 0, "method": "kalman"})
    found = views(tmp_path / "small")
    assert found["missing"] == {"broken": "ZeroDivisionError: of the study"}
    assert len(found["tables"]) == len(study.tables)


def test_a_worker_that_is_killed_is_an_error_and_the_run_resumes(study, tmp_path):
    trouble = tmp_path / "trouble"
    trouble.write_text("kill")
    with pytest.raises(WorkerDiedError, match="repeat the command"):
        run_study(study, tmp_path, jobs=2, settings={"trouble": str(trouble)})
    trouble.unlink()
    assert run_study(study, tmp_path, settings={"trouble": str(trouble)}).failed == 0


@pytest.mark.parametrize("damage", ["truncated", "empty", "of another cell"])
def test_a_damaged_file_is_computed_again(study, tmp_path, damage):
    whole = run_study(study, tmp_path)
    first, second = sorted((tmp_path / "small/cells").iterdir())[:2]
    content = first.read_bytes()
    bad = {"truncated": content[: len(content) // 2], "empty": b"", "of another cell": second.read_bytes()}[damage]
    first.write_bytes(bad)
    with pytest.warns(RuntimeWarning, match=f"{first.name} is damaged and will be computed again"):
        again = run_study(study, tmp_path)
    assert numbers(again.frame).equals(numbers(whole.frame))


def test_what_cells_share_is_prepared_once_and_only_for_those_that_need_it(study, tmp_path):
    asked: list[list[int]] = []
    study = replace(study, prepare=lambda cells, jobs: asked.append(sorted({p["max_neighbours"] for p in cells})))
    run_study(study, tmp_path, settings={"max_neighbours": "0"})
    run_study(study, tmp_path, settings={"max_neighbours": "0,2"})
    run_study(study, tmp_path, settings={"max_neighbours": "0,2"})
    assert asked == [[0], [2]]


def test_files_of_cells_may_be_copied_between_folders(study, tmp_path):
    """Half of the cells beside those of other settings; one is damaged, and is computed again as the rest is."""
    run_study(study, tmp_path / "whole")
    run_study(study, tmp_path / "other", settings={"runs": 2})
    cells = tmp_path / "all/small/cells"
    shutil.copytree(tmp_path / "other/small/cells", cells)
    for path in sorted((tmp_path / "whole/small/cells").glob("[!.]*"))[:4]:
        shutil.copy2(path, cells)
    assert plan(study, tmp_path / "all")["finished"] == 4
    (cells / path.name).write_bytes(b"")
    with pytest.warns(RuntimeWarning, match="is damaged and will be computed again"):
        run_study(study, tmp_path / "all")
    assert shown(tmp_path / "all/small") == shown(tmp_path / "whole/small")


def test_plan_counts_and_writes_nothing(study, tmp_path):
    found = plan(study, tmp_path / "new", {"max_neighbours": "0,2"})
    assert (found["cells"], found["finished"], found["to_compute"]) == (6, 0, 6)
    assert not (tmp_path / "new").exists()


def test_changed_settings_compute_anew_and_keep_what_is_there(study, tmp_path):
    run_study(study, tmp_path, settings={"max_neighbours": 0})
    before = files(tmp_path / "small")
    more = run_study(study, tmp_path, settings={"max_neighbours": 0, "runs": 5})
    assert sorted(set(more.frame["run"])) == [0, 1, 2, 3, 4]
    after = files(tmp_path / "small")
    assert len(after) == 6
    assert {name: after[name] for name in before} == before


def test_bad_input_is_named_before_any_work(study, tmp_path):
    with refused("max_neighbours = -1: must be >= 0"):
        run_study(study, tmp_path, settings={"max_neighbours": -1})
    with refused("jobs = 100000: must be in 1..10000"):
        run_study(study, tmp_path, jobs=10**5)
    with refused(r"study = 'smal'.*Did you mean small\?"):
        run_study("smal", tmp_path)
    (tmp_path / "file").write_text("")
    with refused("cannot be written"):
        run_study(study, tmp_path / "file")
    assert not (tmp_path / "small").exists()


def test_rows_that_a_study_may_not_return_fail_the_cell(tmp_path):
    study = Study(
        "odd",
        "?",
        lambda p: {"none": [], "own": [{"x": 1}], "mixed": [{"y": 1}, {"y": "a"}], "one": {"y": 1}, "once": iter([{}])}[
            p["x"]
        ],
        {"x": ("none", "own", "mixed", "one", "once")},
    )
    reasons = list(run_study(study, tmp_path).failures["reason"])
    assert "at least one row" in reasons[0]
    assert "rows = 'y': must be a mapping" in reasons[3]
    assert "must be a sequence" in reasons[4]
    assert "must not repeat a parameter" in reasons[1]
    assert reasons[2].startswith("Arrow")

    def half(params):
        raise ValueError("\ud800, half a pair")

    assert "half a pair" in run_study(Study("half", "?", half, {"x": (1,)}), tmp_path).failures["reason"][0]


def test_each_track_has_a_file_of_its_own(tmp_path):
    track = "ego", [0, 1], np.zeros((2, 3))
    study = Study("s", "?", lambda p: [{"y": 1}], {"k": ("a b", "a_b")}, tracks=lambda p: [track])
    run_study(study, tmp_path)
    assert len([*write_tracks(study, tmp_path, {}).iterdir()]) == 2


def test_cells_of_one_recording_follow_each_other_in_a_lane_the_last_first():
    cells = [Cell({}, {"k": k, "m": m}, f"{k}{m}") for m in "ab" for k in range(4)]
    assert [c.name for c in schedule(cells, ("k",), 1)] == ["3a", "3b", "2a", "2b", "1a", "1b", "0a", "0b"]
    two = [c.name for c in schedule(cells, ("k",), 2)]
    assert two[0::2] == ["3a", "3b", "1a", "1b"]
    assert two[1::2] == ["2a", "2b", "0a", "0b"]
    assert sorted(c.name for c in schedule(cells[:5], ("k",), 3)) == sorted(c.name for c in cells[:5])


def test_a_cell_runs_on_one_thread(tmp_path):
    def cell(p):
        from threadpoolctl import threadpool_info

        return [{"threads": max(library["num_threads"] for library in threadpool_info())}]

    assert set(run_study(Study("threads", "?", cell, {"x": (1, 2)}), tmp_path, jobs=1).frame["threads"]) == {1}


def learned(path):
    pytest.importorskip("torch")
    from coopoc.learned import checkpoint, recipes

    checkpoint.save(path, checkpoint.load(recipes.shipped_weights()["okf"]))


WRITERS = {
    "a.tum": lambda path: co.write_tum(path, [0.0, 0.1], np.eye(2, 3)),
    "a.npz": lambda path: save_recording(RECORDING, path),
    "a.json": lambda path: _status(["solve", "two.pyfg", "--output", path]),
    "a.safetensors": learned,
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_is_written_whole_or_not_at_all(name, tmp_path, monkeypatch):
    def full(_file):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    Path("two.pyfg").write_text("VERTEX_XY L0 11 19\nVERTEX_XY L1 11 21\nEDGE_RANGE 0 L0 L1 2 1\n")
    WRITERS[name](f"~/made/{name}")
    written = (tmp_path / "made" / name).read_bytes()
    monkeypatch.setattr(os, "fsync", full)
    with suppress(OSError):
        WRITERS[name](f"~/made/{name}")
    assert {path.name: path.read_bytes() for path in (tmp_path / "made").iterdir()} == {name: written}
    assert not (tmp_path / "~").exists()


def test_views_of_an_earlier_run_do_not_stay_among_those_of_this_one(study, tmp_path):
    run_study(replace(study, tables={**study.tables, "extra": study.tables["rt_le"]}), tmp_path)
    (tmp_path / "small/tables/mine.md").write_text("by hand")
    assert len(list((tmp_path / "small/tables").glob("extra.*"))) == 4
    run_study(study, tmp_path)
    left = {path.name for path in (tmp_path / "small/tables").iterdir()}
    assert left == {"rt_le.md", "rt_le.csv", "rt_le.tex", "rt_le.html", "mine.md"}
