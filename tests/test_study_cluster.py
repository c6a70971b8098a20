"""Dask: a real scheduler and worker processes on loopback; tables are those of one process, whatever happens."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pandas as pd
import pytest
from conftest import refused
from small_runs import ENV, numbers, shown, start

from coopoc.study.compute import WorkerDiedError
from coopoc.study.run import plan, run_study
from coopoc.study.study import Study

pytestmark = pytest.mark.slow

pytest.importorskip("distributed")

Process = "subprocess.Popen[bytes]"


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a scheduler."""
    file = tmp_path_factory.mktemp("scheduler") / "scheduler.json"
    words = ["scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)]
    process = dask(words, file.parent)
    wait_for(lambda: file.is_file() and file.read_text().rstrip().endswith("}"))  # it is there before it is written
    yield json.loads(file.read_text())["address"]
    end(process)


@pytest.fixture
def worker(scheduler: str, tmp_path: Path) -> Iterator[Callable[..., Process]]:
    """Starts a worker; ends those that are left."""
    started = []

    def start(*words: str, **env: str) -> Process:
        place = ["--local-directory", str(tmp_path / f"worker{len(started)}"), "--no-dashboard", "--no-nanny"]
        started.append(dask(["worker", scheduler, *place, *(words or ("--nthreads", "1"))], tmp_path, **env))
        return started[-1]

    yield start
    for process in started:
        end(process)


def dask(words: list[str], cwd: Path, **env: str) -> Process:
    command = [sys.executable, "-m", "dask", *words]
    return subprocess.Popen(command, cwd=cwd, env={**ENV, **env}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def end(process: Process) -> None:
    process.kill()
    process.wait()


def wait_for(happened: Callable[[], object], seconds: float = 40.0) -> None:
    for _ in range(int(seconds / 0.02)):
        if happened():
            return
        time.sleep(0.02)
    raise AssertionError(f"did not happen in {seconds:g} s")


def test_a_worker_that_is_killed_in_mid_run_changes_no_table(
    study: Study, worker: Callable[..., Process], scheduler: str, tmp_path: Path
) -> None:
    whole = run_study(study, tmp_path / "whole", progress=False)
    first, _ = worker(), worker()
    driver = start(tmp_path, "--cluster", scheduler, "--set", "pause=0.3")
    folder = tmp_path / "small"
    wait_for(lambda: len(list(folder.glob("cells/*.parquet"))) >= 2)
    os.kill(first.pid, signal.SIGKILL)
    left = 9 - len(list(folder.glob("cells/*.parquet")))
    stdout, stderr = driver.communicate(timeout=60)
    assert driver.returncode == 0, stderr
    assert left >= 2
    assert "| Neighbours K" in stdout
    assert "9/9" in stderr
    assert shown(folder) == shown(tmp_path / "whole/small")
    found = pd.read_parquet(folder / "results.parquet")
    pd.testing.assert_frame_equal(numbers(found), numbers(whole.frame), check_exact=True)


def test_failures_come_back_as_rows_and_a_killer_ends_the_run(
    study: Study, worker: Callable[..., Process], scheduler: str, tmp_path: Path
) -> None:
    """A cell that kills its worker takes the next one with it, until Dask gives it up or no worker is left."""
    trouble = tmp_path / "trouble"
    trouble.write_text("raise")
    changes = {"trouble": str(trouble)}
    for _ in range(2):
        worker()
    failed = run_study(study, tmp_path, settings=changes, progress=False, cluster=scheduler)
    row = failed.failures.iloc[0]
    assert (failed.failed, row["reason"]) == (
        1,
        "FloatingPointError: the filter diverged at step 3",
    )
    assert "small_study.py" in row["traceback"]
    trouble.write_text("kill")
    for _ in range(2):
        worker()
    with pytest.raises(WorkerDiedError, match=r"stopped \(KilledWorker.*Finished cells are kept"):
        run_study(study, tmp_path, settings=changes, progress=False, cluster=scheduler, retry_failed=True)
    assert plan(study, tmp_path, changes)["finished"] == 8


def test_a_run_ends_when_no_worker_is_left(
    study: Study, worker: Callable[..., Process], scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coopoc.study.cluster.PATIENCE", 6.0)
    (tmp_path / "trouble").write_text("kill")
    worker()
    with pytest.raises(WorkerDiedError, match="no worker is left for 6 s"):
        run_study(study, tmp_path, settings={"trouble": str(tmp_path / "trouble")}, progress=False, cluster=scheduler)
    (tmp_path / "trouble").unlink()
    found = run_study(study, tmp_path, settings={"trouble": str(tmp_path / "trouble")}, progress=False)
    assert (found.failed, found.pending) == (0, 0)


def test_a_cluster_that_cannot_compute_is_named_before_any_work(
    study: Study, worker: Callable[..., Process], scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coopoc.study.cluster.PATIENCE", 3.0)

    def not_run(match: str, address: str = scheduler) -> None:
        with refused(match):
            run_study(study, tmp_path / "new", progress=False, cluster=address)
        assert not (tmp_path / "new").exists()

    not_run("has no Dask scheduler", "tcp://127.0.0.1:9")
    not_run("has no Dask scheduler", "nowhere at all")
    not_run("has no Dask scheduler", "tcp://127.0.0.1:99999")
    not_run(r"has no worker\. Start one on each machine: dask worker tcp://")
    monkeypatch.setattr("coopoc.study.cluster.PATIENCE", 30.0)
    several = worker("--nthreads", "2")
    not_run("has a worker of several threads.*Start workers with --nthreads 1")
    end(several)
    worker(PYTHONPATH="")
    not_run("that cannot load the study .*small_study.*Install the same coopoc")
