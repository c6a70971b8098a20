"""What may happen to a run: kills at any moment, a full disk, a read-only one, two runners. No cell is lost."""

import multiprocessing
import shutil
import subprocess
import time
from dataclasses import replace

import numpy as np
import pytest
from conftest import refused
from shell import ran
from small_runs import COMMAND, ENV, files, numbers, shown, start

from coopoc.study import store
from coopoc.study.run import plan, run_study


@pytest.mark.slow
def test_ten_kills_at_random_moments_change_nothing(study, tmp_path):
    """Thirty cells; each process goes on where the one before was killed: at its start, in a cell, or in a file."""
    settings = {"max_neighbours": ",".join(map(str, range(10)))}
    whole = run_study(study, tmp_path / "whole", settings=settings)
    rng = np.random.default_rng(6)
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["coopoc.study.run", "coopoc.study.figures"])
    folder, before = tmp_path / "small", {}
    for more, moment in zip(rng.integers(0, 6, 10), rng.uniform(0.0, 0.1, 10), strict=True):
        process = processes.Process(target=run_study, args=("small", tmp_path, 1, settings, False))
        process.start()
        while process.is_alive() and len(list(folder.glob("cells/*.parquet"))) < len(before) + more:
            time.sleep(0.002)
        time.sleep(moment)
        process.kill()
        process.join()
        after = files(folder)
        assert {name: after[name] for name in before} == before
        assert all(store.load(folder, name.removesuffix(".parquet")) is not None for name in after)
        before = after
    assert len(before) >= 10
    resumed = run_study(study, tmp_path, settings=settings)
    after = files(folder)
    assert {name: after[name] for name in before} == before
    assert len(after) == 30
    assert numbers(resumed.frame).equals(numbers(whole.frame))
    assert shown(folder) == shown(tmp_path / "whole/small")
    assert not list(folder.rglob(".*.part"))


def test_a_kill_while_tables_and_figures_are_written_is_mended_by_the_next_run(study, tmp_path):
    run_study(study, tmp_path)
    whole = shown(tmp_path / "small")
    process = multiprocessing.get_context("forkserver").Process(
        target=run_study, args=("small", tmp_path, 1, {}, False)
    )
    (tmp_path / "small/tables/rt_le.md").unlink()
    process.start()
    while not (tmp_path / "small/tables/rt_le.md").exists():
        time.sleep(0.002)
    process.kill()
    process.join()
    (tmp_path / "small/views.json").write_text("")
    run_study(study, tmp_path)
    assert shown(tmp_path / "small") == whole


@pytest.mark.slow
def test_two_runners_that_start_together(study, tmp_path):
    both = [start(tmp_path) for _ in "ab"]
    ends = [(process, *process.communicate(timeout=60)) for process in both]
    assert sorted(process.returncode for process, _, _ in ends) in ([0, 2], [0, 0]), ends
    for process, stdout, stderr in ends:
        assert (process.returncode == 0) == ("| Neighbours K" in stdout)
        assert (process.returncode == 2) == ("is in use by another run. Wait until it ends" in stderr)
    assert plan(study, tmp_path)["finished"] == 9


def in_a_small_disk(script, tmp_path):
    """Lines of a script that runs where `disk` is a file system of its own, which goes with the script."""
    if not shutil.which("unshare"):
        pytest.skip("util-linux is not installed")
    (tmp_path / "disk").mkdir()
    shell = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c"]
    mount = "mount -t tmpfs -o size=10m tmpfs disk"
    if subprocess.run([*shell, mount], cwd=tmp_path, capture_output=True, timeout=20).returncode:
        pytest.skip("this system lets nobody mount a disk of their own")
    done = ran([*shell, f"{mount}\n{script}"], cwd=tmp_path, env={**ENV, "RUN": " ".join(COMMAND)}, timeout=120)
    return (done.stdout + done.stderr).splitlines()


@pytest.mark.slow
def test_a_disk_that_is_full_or_read_only_is_named_and_the_run_goes_on_afterwards(study, tmp_path):
    table = " ".join([*COMMAND[:-2], "table", "disk/small"])
    said = in_a_small_disk(
        f"""
        mount -o remount,size=32k disk
        $RUN --out disk > /dev/null; echo "full: $?"
        mkdir kept; cp -a disk/small/cells kept
        mount -o remount,size=10m disk
        $RUN --out disk > /dev/null; echo "room: $?"
        mount -o remount,ro disk
        $RUN --out disk; echo "read-only: $?"
        {table} | head -3
        cp -a disk/small .
    """,
        tmp_path,
    )
    assert {"full: 1", "room: 0", "read-only: 2"} <= set(said)
    message = next(line for line in said if "No space left" in line)
    assert "No space left on device. Finished files are kept: make room, or choose another folder" in message
    assert "disk/small/cells/" in message
    assert "coopoc: out = disk/small: cannot be written (Read-only file system). Choose another --out." in said
    assert any(line.startswith("| Neighbours K") for line in said)
    kept, after = files(tmp_path / "kept"), files(tmp_path / "small")
    assert 0 < len(kept) < 9
    assert {name: after[name] for name in kept} == kept
    assert not list((tmp_path / "small").glob("failed/*"))
    run_study(study, tmp_path / "whole")
    assert shown(tmp_path / "small") == shown(tmp_path / "whole/small")


def test_cells_that_vanish_during_a_run_end_it_with_their_number_and_no_tables(study, tmp_path):
    def cell(params):
        for finished in sorted((tmp_path / "small/cells").glob("*.parquet"))[:1]:
            finished.unlink()
        return study.cell(params)

    with refused(r"lost \d+ of \d+ cells while it ran"):
        run_study(replace(study, cell=cell), tmp_path)
    assert not (tmp_path / "small/tables").exists()
    assert run_study(study, tmp_path).pending == 0
