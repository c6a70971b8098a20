"""Deployments on loopback: SuperLink, SuperNodes, TLS and keys; a node that dies; what the wire and the server hold.

The wire, the server's memory and its files are searched for a drive that is distinct from everything else. An app that
gives this drive away shows that the search would find it.
"""

import importlib.util
import os
import re
import signal
import subprocess
import sys
import time
import uuid
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from conftest import winding
from make_fleet import write_table
from shell import ROOT, ran
from test_learned_flower import in_process
from test_learned_flower import pytestmark as flower

from coopoc.learned import load
from coopoc.learned.federation.federate import adapt
from coopoc.learned.flower.client import job_of
from coopoc.learned.recipes import job_clients, untrained

TINY = {"local-epochs": 1, "piece": 10, "net-in-mult": 2, "net-out-mult": 1}
CHANGE = " ".join(f"{key}={value}" for key, value in TINY.items())
pytestmark = [
    *flower,
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="no /proc: processes cannot be counted or searched"),
]


def each(fleet):
    return {vehicle: fleet.select([vehicle]) for vehicle in fleet.ids}


@pytest.fixture(scope="module", autouse=True)
def _compiled():
    """The engine, before four processes compile it side by side."""
    in_process(job_of({"recipe": "fedkalmannet", "rounds": 1, **TINY}), winding(100, 4.0, 4.0))


@pytest.fixture(scope="module")
def example():
    """examples/flower_deployment.py as a module."""
    return importlib.import_module("flower_deployment")


@pytest.fixture
def mark(monkeypatch):
    """A word in the environment of all processes that the test starts; in the end none of them is alive."""
    word = f"FLOWER_TEST={uuid.uuid4().hex}"
    monkeypatch.setenv(*word.split("="))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    yield word
    until(lambda: alive(word) == [], 20)


def alive(word):
    """Command lines of the processes, but this one, with this word in their environment."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if word.encode() in (folder / "environ").read_bytes() and folder.name != str(os.getpid()):
                found.append((folder / "cmdline").read_bytes().replace(b"\0", b" ").decode())
    return found


def until(true, seconds=300):
    """Wait for something."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.1)


def checked(path, job, fleet):
    """The card of a checkpoint whose weights are, round by round, NumPy's average of what the clients that counted
    made."""
    plan, found = job.recipe.plan, load(path)
    for row, theta, before in zip(found.card["history"][1:], found.history[1:], found.history[:-1], strict=True):
        own = [c for c in job_clients(job, fleet) if c.name not in row["absent"].keys() | row["rejected"].keys()]
        trained = adapt(untrained(job), before, own, job.setting.seed, row["round"], plan.rounds, plan.local)
        fitted = [made.weights.numpy() for made in trained.values()]
        mean = np.average(np.stack(fitted).astype(float), axis=0, weights=[len(client.training) for client in own])
        assert theta.numpy() == pytest.approx(mean, abs=1e-6)
    return found.card


def script(folder, *options):
    """The command line of the example, for three rounds."""
    words = sys.executable, ROOT / "examples" / "flower_deployment.py", "--folder", folder, "--rounds", 3, *options
    return [str(word) for word in words]


def test_the_script_survives_the_death_of_a_node(tmp_path, mark):
    """Four vehicles, TLS, keys, three rounds; the second vehicle is killed in the second."""
    fleet = winding(100, 4.0, 4.0, 4)
    write_table(fleet, tmp_path / "four.parquet")
    done = ran(
        script(tmp_path / "site", "--data", tmp_path / "four.parquet", "--kill", 2, "--change", CHANGE), timeout=600
    )
    assert done.returncode == 0, done.stderr
    card = checked(
        tmp_path / "site" / "fedkalmannet.safetensors", job_of({"recipe": "fedkalmannet", "rounds": 3, **TINY}), fleet
    )
    assert card["clients"] == ["a", "b", "c", "d"]
    assert [("b" in row["absent"]) for row in card["history"][2:]] == [True, True]
    assert "killed node-2" in done.stdout
    assert len(re.findall(r"^ +\d ", done.stdout, flags=re.MULTILINE)) == 4


def test_a_run_that_fails_ends_the_script_with_an_error(tmp_path, mark):
    """Flower has no strategy for the rule: the ServerApp raises, and the exit status is not zero."""
    write_table(winding(100, 4.0, 4.0), tmp_path / "one.parquet")
    command = script(
        tmp_path / "site", "--data", tmp_path / "one.parquet", "--change", f"aggregate=multi_krum {CHANGE}"
    )
    done = ran(command, timeout=600)
    assert done.returncode != 0
    assert "the run failed" in done.stderr
    assert "aggregate = 'multi_krum'" in (tmp_path / "site" / "run.log").read_text()


def test_the_script_stops_everything_on_ctrl_c(tmp_path, mark):
    with subprocess.Popen(script(tmp_path), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        until(lambda: (tmp_path / "node-4.log").exists())
        assert len(alive(mark)) > 5
        process.send_signal(signal.SIGINT)
        assert process.wait(60) != 0


def test_only_registered_keys_over_tls_come_in(tmp_path, mark, example):
    """Two known nodes make the weights of `federate`; those who lack the key, TLS or the right server stay out."""
    fleet = winding(100, 4.0, 4.0, 2)
    with example.deployment(tmp_path) as site:
        example.join(site, each(fleet))
        others = {name: site.folder / name for name in ("stranger", "keyless", "plain", "misled")}
        for home in others.values():
            home.mkdir()
        example.key_pair(others["stranger"])
        example.key_pair(others["misled"])
        example.certificates(others["misled"])
        authority = ["--root-certificates", str(tmp_path / "ca.pem")]
        who = {
            "stranger": example.identity(site, others["stranger"]),
            "keyless": authority,
            "plain": ["--insecure"],
            "misled": [
                "--root-certificates",
                str(others["misled"] / "ca.pem"),
                "--auth-supernode-private-key",
                str(others["misled"] / "key"),
            ],
        }
        refused = {name: example.supernode(site, name, options) for name, options in who.items()}
        out = tmp_path / "fedkalmannet.safetensors"
        example.finished(example.submit(site, [f'change="rounds=2 {CHANGE}"', "nodes=2", f'out="{out}"']), "flwr run")
        for name, process in refused.items():
            assert process.wait(120) != 0, name
            assert "Failed to initialize the connection to the SuperLink" in example.log(site, name)
        assert example.log(site, "superlink").count("Activated node_id") == 2
    card = checked(out, job_of({"recipe": "fedkalmannet", "rounds": 2, **TINY}), fleet)
    assert [row["absent"] | row["rejected"] for row in card["history"]] == [{}, {}, {}]
    assert card["clients"] == ["a", "b"]
