"""Shards of a study: one folder or several, one after another or all at once; the tables are those of one run."""

import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from conftest import refused
from small_runs import ENV, files, numbers, shown, start

from coopoc import cli
from coopoc.study import store
from coopoc.study.compute import part_of
from coopoc.study.manifest import Manifest, locked
from coopoc.study.merge import merge
from coopoc.study.results import Results
from coopoc.study.run import plan, run_study
from coopoc.study.study import Cell, Study


def manifest(study: Study) -> Manifest:
    cells = {cell.name: cell.params for cell in study.cells()}
    return Manifest(study.name, study.question, study.axes, study.settings, cells, {}).as_stored()


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 20])
def test_shards_are_disjoint_whole_and_of_equal_size(count: int) -> None:
    grid = [Cell({}, {"k": k, "m": m}, f"{k}{m}") for m in "abc" for k in range(4)]
    parts = [[c.name for c in part_of(grid, ("k",), f"{i}/{count}")] for i in range(1, count + 1)]
    assert sorted(name for part in parts for name in part) == sorted(c.name for c in grid)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    recordings = [{name[0] for name in part} for part in parts]
    assert sum(map(len, recordings)) <= 4 + count - 1


@pytest.mark.parametrize("text", ["0/3", "4/3", "1", "1/", "a/b", "-1/3", "1/0"])
def test_a_shard_that_is_none_is_named(study: Study, tmp_path: Path, text: str) -> None:
    with refused(r"must be i/n with 1 <= i <= n\. Write for example: --shard 2/3"):
        run_study(study, tmp_path / "new", shard=text, progress=False)
    assert not (tmp_path / "new").exists()


def test_three_shards_in_one_folder_make_the_tables_of_one_run(study: Study, tmp_path: Path) -> None:
    whole = run_study(study, tmp_path / "whole", progress=False)
    for index in (3, 1, 2):
        part = run_study(study, tmp_path, progress=False, shard=f"{index}/3")
        assert (part.frame["cell"].nunique(), part.failed, part.pending) == (3, 0, 0)
    assert not (tmp_path / "small/tables").exists()
    before = files(tmp_path / "small")
    found = run_study(study, tmp_path, progress=False)
    assert files(tmp_path / "small") == before
    pd.testing.assert_frame_equal(numbers(found.frame), numbers(whole.frame), check_exact=True)
    assert shown(tmp_path / "small") == shown(tmp_path / "whole/small")


@pytest.mark.slow
def test_shards_work_in_one_folder_at_the_same_time(study: Study, tmp_path: Path) -> None:
    run_study(study, tmp_path / "whole", settings={"pause": 0.1}, progress=False)
    shards = [start(tmp_path, "--shard", f"{i}/2", "--set", "pause=0.1") for i in (1, 2)]
    for index, shard in enumerate(shards, start=1):
        stdout, stderr = shard.communicate(timeout=60)
        assert (shard.returncode, stdout) == (0, ""), stderr
        assert f"coopoc: shard {index}/2 is in {tmp_path / 'small'}. When all shards are: the same command" in stderr
    done = plan(study, tmp_path, {"pause": 0.1})
    assert (done["finished"], done["to_compute"]) == (9, 0)
    run_study(study, tmp_path, settings={"pause": 0.1}, progress=False)
    assert shown(tmp_path / "small") == shown(tmp_path / "whole/small")


def test_who_else_may_come_in_while_a_shard_is_at_work(study: Study, tmp_path: Path) -> None:
    folder = tmp_path / "small"
    with locked(folder, manifest(study), "2/3"):
        with refused("is in use by another run"):
            run_study(study, tmp_path, progress=False)
        with refused(r"in use by shards that differ in runs \(2, 4\), cells \(9 and 9, 0 of"):
            run_study(study, tmp_path, settings={"runs": 2}, shard="1/3", progress=False)
        with refused("in use by another process with shard 2/3"):
            run_study(study, tmp_path, shard="2/3", progress=False)
        assert run_study(study, tmp_path, shard="1/3", progress=False).frame["cell"].nunique() == 3
        with refused("is in use by another run"):
            merge([folder], tmp_path)
    with locked(folder, manifest(study)), refused("is in use by another run"):
        run_study(study, tmp_path, shard="1/3", progress=False)
    assert Results.load(folder).pending == 6


def test_folders_of_several_machines_merge_to_the_tables_of_one_run(study: Study, tmp_path: Path) -> None:
    run_study(study, tmp_path / "whole", progress=False)
    for index in (1, 2, 3):
        run_study(study, tmp_path / f"m{index}", progress=False, shard=f"{index}/3")
    folders = [tmp_path / f"m{index}/small" for index in (1, 2, 3)]
    before = {**files(folders[0]), **files(folders[1]), **files(folders[2])}
    half = merge(folders[:2], tmp_path / "all")
    assert (half.folder, half.cells, half.finished, half.missing) == (tmp_path / "all/small", 9, 6, 3)
    assert cli.merge((folders[2],), tmp_path / "all") == 0
    run_study(study, tmp_path / "all", progress=False)
    after = files(tmp_path / "all/small")
    assert {name: content for name, (_, content) in after.items()} == {name: c for name, (_, c) in before.items()}
    assert shown(tmp_path / "all/small") == shown(tmp_path / "whole/small")
    assert {**files(folders[0]), **files(folders[1]), **files(folders[2])} == before


def test_a_failure_is_merged_unless_the_cell_is_finished_elsewhere(study: Study, tmp_path: Path) -> None:
    trouble = tmp_path / "trouble"
    trouble.write_text("raise")
    changes = {"trouble": str(trouble)}
    run_study(study, tmp_path / "a", settings=changes, progress=False)
    first = merge([tmp_path / "a/small"], tmp_path / "all")
    assert (first.finished, first.failed, first.missing) == (8, 1, 0)
    trouble.unlink()
    run_study(study, tmp_path / "b", settings=changes, progress=False)
    known = next((tmp_path / "a/small/cells").iterdir()).name
    (tmp_path / "b/small/cells" / known).write_bytes(b"")
    with pytest.warns(RuntimeWarning, match="damaged"):
        second = merge([tmp_path / "b/small"], tmp_path / "all")
    assert (second.finished, second.failed) == (9, 0)
    assert not list((tmp_path / "all/small/failed").iterdir())


def test_what_does_not_belong_together_is_not_merged(study: Study, tmp_path: Path) -> None:
    run_study(study, tmp_path / "a", progress=False, shard="1/9")
    run_study(study, tmp_path / "b", settings={"runs": 2}, progress=False, shard="1/9")
    with refused(r"a/small and .*b/small: differ in runs \(4, 2\), cells \(9 and 9, 0 of them"):
        merge([tmp_path / "a/small", tmp_path / "b/small"], tmp_path / "all")
    assert not (tmp_path / "all").exists()
    with refused(r"holds no manifest\.json"):
        merge([tmp_path], tmp_path / "all")
    with refused("must be at least one"):
        merge([], tmp_path / "all")


def test_a_cell_with_two_sets_of_numbers_is_named(study: Study, tmp_path: Path) -> None:
    for name in "ab":
        run_study(study, tmp_path / name, progress=False, shard="1/9")
    cell = part_of(study.cells(), study.shares, "1/9")[0]
    rows = store.load(tmp_path / "b/small", cell.name).to_pylist()
    own = {*store.OWN_COLUMNS, *cell.params}
    merge([tmp_path / "a/small", tmp_path / "b/small"], tmp_path / "same")
    changed = [{k: v for k, v in row.items() if k not in own} | {"rt_le_m": row["rt_le_m"] + 1e-12} for row in rows]
    store.save(tmp_path / "b/small", cell, store.to_table(changed), 1.0)
    with pytest.warns(RuntimeWarning, match=f"cell {cell.name} has other numbers in .*b/small than in .*a/small"):
        merge([tmp_path / "a/small", tmp_path / "b/small"], tmp_path / "all")
    kept = store.load(tmp_path / "all/small", cell.name)
    assert kept.equals(store.load(tmp_path / "a/small", cell.name))


@pytest.mark.slow
def test_what_shards_share_is_prepared_by_one_at_a_time(study: Study, tmp_path: Path) -> None:
    """The second shard waits while the first prepares, and then finds what is there."""
    began = tmp_path / "began"
    code = f"""
import time
from dataclasses import replace
from pathlib import Path
from coopoc.study.run import run_study
from small_study import STUDY
def prepare(cells, jobs):
    with Path({str(began)!r}).open("a") as log:
        log.write("in ")
        log.flush()
        while len(list(Path({str(tmp_path)!r}, "small").glob(".shard-*"))) < 2:
            time.sleep(0.02)
        time.sleep(0.7)
        log.write("out ")
if __name__ == "__main__":
    import sys
    run_study(replace(STUDY, prepare=prepare), {str(tmp_path)!r}, shard=sys.argv[1])
"""
    shards = [
        subprocess.Popen([sys.executable, "-c", code, f"{i}/2"], env=ENV, stderr=subprocess.PIPE, text=True)
        for i in (1, 2)
    ]
    messages = [shard.communicate(timeout=60)[1] for shard in shards]
    assert began.read_text() == "in out in out "
    assert sum("waits for a shard that prepares" in message for message in messages) == 1
