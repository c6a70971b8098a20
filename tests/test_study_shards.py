"""Shards of a study: one folder or several, one after another or all at once; the tables are those of one run."""

import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from conftest import refused
from small_runs import ENV, files, numbers, shown, start

from coopoc.study.compute import part_of
from coopoc.study.manifest import Manifest, locked
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
    with locked(folder, manifest(study)), refused("is in use by another run"):
        run_study(study, tmp_path, shard="1/3", progress=False)
    assert Results.load(folder).pending == 6


def test_files_of_cells_from_several_machines_make_the_tables_of_one_run(study: Study, tmp_path: Path) -> None:
    """Beside cells of other settings and one that is damaged, which is computed again."""
    run_study(study, tmp_path / "whole", progress=False)
    run_study(study, tmp_path / "m0", settings={"runs": 2}, shard="1/3", progress=False)
    for index in (1, 2, 3):
        run_study(study, tmp_path / f"m{index}", progress=False, shard=f"{index}/3")
    for index in range(4):
        shutil.copytree(tmp_path / f"m{index}/small/cells", tmp_path / "all/small/cells", dirs_exist_ok=True)
    known = files(tmp_path / "m3/small")
    (tmp_path / "all/small/cells" / next(iter(known))).write_bytes(b"")
    with pytest.warns(RuntimeWarning, match="is damaged and will be computed again"):
        run_study(study, tmp_path / "all", progress=False)
    assert shown(tmp_path / "all/small") == shown(tmp_path / "whole/small")


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
