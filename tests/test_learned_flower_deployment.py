"""Deployments on loopback: SuperLink, SuperNodes, TLS and keys; a node that dies; what the wire and the server hold.

The wire, the server's memory and its files are searched for a drive that is distinct from everything else. An app that
gives this drive away shows that the search would find it.
"""

from __future__ import annotations

import importlib.util
import os
import re
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from coopoc import V2X, Fleet, observe
from coopoc.data.fleet_files import write_table
from coopoc.learned import federate, load
from coopoc.learned.federation.history import Federation
from coopoc.learned.federation.local import local_fit
from coopoc.learned.flower.job import job_of, local
from coopoc.learned.recipes import Job, job_clients, sensors, untrained

ROOT = Path(__file__).resolve().parents[1]
TINY = {"local-epochs": 1, "piece": 10, "net-in-mult": 2, "net-out-mult": 1}
CHANGE = " ".join(f"{key}={value}" for key, value in TINY.items())
LEAK = """
from flwr.app import ArrayRecord, ConfigRecord
from flwr.clientapp import ClientApp

from coopoc import load_fleet
from coopoc.learned.flower import client_app, server_app
from coopoc.learned.flower.client import configured

honest = client_app()
client = ClientApp()
server = server_app()


@client.evaluate()
def evaluate(message, context):
    return honest(message, context)


@client.train()
def train(message, context):
    reply = honest(message, context)
    own, _ = configured(context)
    there = load_fleet(context.node_config["data"]).position[:, 0]
    reply.content["drive"] = ArrayRecord([there, there.astype("f4"), own.training.gnss.numpy()])
    reply.content["words"] = ConfigRecord({"drive": str(there.round(3).tolist())})
    return reply
"""
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("flwr") is None, reason="flwr is not installed: coopoc[flower]"),
    pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="no /proc: processes cannot be counted or searched"),
    pytest.mark.filterwarnings("ignore:'click.utils:DeprecationWarning"),
]


def drives(vehicles: int, steps: int = 100) -> Fleet:
    """Vehicles that drive circles of their own at 4 m/s."""
    t = np.arange(steps) / 10
    wave = t[:, None] / 4 + np.arange(vehicles)
    velocity = np.stack([4 * np.cos(wave), 4 * np.sin(wave), 0.1 + 0 * wave], axis=-1)
    return Fleet(tuple(f"c{i}" for i in range(vehicles)), t, np.cumsum(0.1 * velocity, axis=0), velocity)


def each(fleet: Fleet) -> dict[str, Fleet]:
    return {vehicle: fleet.select([vehicle]) for vehicle in fleet.ids}


@pytest.fixture(scope="module", autouse=True)
def _compiled() -> None:
    """The engine, before four processes compile it side by side."""
    whole(job_of({"recipe": "fedkalmannet", "rounds": 1, **TINY}), drives(1))


@pytest.fixture(scope="module")
def example() -> ModuleType:
    """examples/flower_deployment.py as a module."""
    return imported("flower_deployment")


@pytest.fixture(scope="module")
def audit(example: ModuleType) -> ModuleType:
    """examples/flower_audit.py as a module, which imports the other."""
    return imported("flower_audit")


def imported(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules[name])
    return sys.modules[name]


@pytest.fixture
def mark(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A word in the environment of all processes that the test starts; in the end none of them is alive."""
    word = f"FLOWER_TEST={uuid.uuid4().hex}"
    monkeypatch.setenv(*word.split("="))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    yield word
    until(lambda: alive(word) == [], 20)


def alive(word: str) -> list[str]:
    """Command lines of the processes, but this one, with this word in their environment."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if word.encode() in (folder / "environ").read_bytes() and folder.name != str(os.getpid()):
                found.append((folder / "cmdline").read_bytes().replace(b"\0", b" ").decode())
    return found


def until(true: Callable[[], bool], seconds: float = 300, alive: subprocess.Popen[bytes] | None = None) -> None:
    """Wait for something that a process, if one is named, must live to do."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        assert alive is None or alive.poll() is None
        time.sleep(0.1)


def whole(job: Job, fleet: Fleet) -> Federation:
    """The federation in this process."""
    recipe, seed, own = job.recipe, job.setting.seed, job_clients(job, fleet)
    return federate(untrained(job), own, recipe.rounds, recipe.aggregate, recipe.local_epochs, seed, recipe.schedule)


def checked(path: Path, job: Job, fleet: Fleet) -> Mapping[str, Any]:
    """The card of a checkpoint whose weights are, round by round, NumPy's average of what those who counted made, and
    those of `federate`, bit by bit, as long as no client is missing."""
    recipe, seed, expected, found = job.recipe, job.setting.seed, whole(job, fleet), load(path)
    own = job_clients(job, fleet)
    assert found.history is not None
    missing = False
    for row, theta, before in zip(found.card["history"][1:], found.history[1:], found.history[:-1], strict=True):
        gone = row["absent"].keys() | row["rejected"].keys()
        made = [
            local_fit(untrained(job), before, client, seed, row["round"], recipe.rounds, local(job))[0].numpy()
            for client in own
            if client.name not in gone
        ]
        sizes = [len(client.training) for client in own if client.name not in gone]
        assert theta.numpy() == pytest.approx(np.average(np.stack(made).astype(float), axis=0, weights=sizes), abs=1e-6)
        missing |= bool(gone)
        assert missing or torch.equal(theta, expected.history[row["round"]].weights)
    return found.card


def script(folder: Path, *options: object) -> list[str]:
    """The command line of the example, for three rounds."""
    words = sys.executable, ROOT / "examples" / "flower_deployment.py", "--folder", folder, "--rounds", 3, *options
    return [str(word) for word in words]


def test_the_script_survives_the_death_of_a_node(tmp_path: Path, mark: str) -> None:
    """Four vehicles, TLS, keys, three rounds; the second vehicle is killed in the second."""
    fleet = drives(4)
    write_table(fleet, tmp_path / "four.parquet")
    command = script(tmp_path / "site", "--data", tmp_path / "four.parquet", "--kill", 2, "--change", CHANGE)
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    job = job_of({"recipe": "fedkalmannet", "rounds": 3, **TINY})
    card = checked(tmp_path / "site" / "fedkalmannet.safetensors", job, fleet)
    assert card["clients"] == ["c0", "c1", "c2", "c3"]
    assert [("c1" in row["absent"]) for row in card["history"][2:]] == [True, True]
    assert "killed node-2" in done.stdout
    assert len(re.findall(r"^ +\d ", done.stdout, flags=re.MULTILINE)) == 4


def test_a_run_that_fails_ends_the_script_with_an_error(tmp_path: Path, mark: str) -> None:
    """Krum needs five clients: the ServerApp raises, and the exit status is not zero."""
    write_table(drives(1), tmp_path / "one.parquet")
    command = script(tmp_path / "site", "--data", tmp_path / "one.parquet", "--change", f"aggregate=krum {CHANGE}")
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode != 0
    assert "the run failed" in done.stderr
    assert "must be >= 5 for Krum" in (tmp_path / "site" / "run.log").read_text()


def test_a_killed_superlink_continues_after_its_last_round(tmp_path: Path, mark: str, example: Any) -> None:
    """SIGKILL of the SuperLink and all that it started, after round 1; new ones end at the weights of `federate`."""
    fleet, out = drives(2), tmp_path / "fedkalmannet.safetensors"
    words = [f'change="rounds=3 {CHANGE}"', "nodes=2", f'out="{out}"']
    with example.deployment(tmp_path / "first", tls=False) as site:
        example.join(site, each(fleet))
        run = example.submit(site, words)
        until(lambda: "round 1:" in example.log(site, "run"), alive=run)
        for pid in example.family(site.started[:1]):
            os.kill(pid, signal.SIGKILL)
    done = len(load(out).card["history"])
    assert 2 <= done <= 4
    assert out.with_name(f"{out.name}.progress").exists()
    with example.deployment(tmp_path / "second", tls=False) as site:
        example.join(site, each(fleet))
        example.finished(example.submit(site, words), "flwr run")
        example.completed(site)
    card = checked(out, job_of({"recipe": "fedkalmannet", "rounds": 3, **TINY}), fleet)
    assert [row["round"] for row in card["history"]] == [0, 1, 2, 3]


def test_the_script_stops_everything_on_ctrl_c(tmp_path: Path, mark: str) -> None:
    with subprocess.Popen(script(tmp_path), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        until(lambda: (tmp_path / "node-4.log").exists())
        assert len(alive(mark)) > 5
        process.send_signal(signal.SIGINT)
        assert process.wait(60) != 0


def test_only_registered_keys_over_tls_come_in(tmp_path: Path, mark: str, example: Any) -> None:
    """Two known nodes make the weights of `federate`; those who lack the key, TLS or the right server stay out."""
    fleet = drives(2)
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
        run = example.submit(site, [f'change="rounds=2 {CHANGE}"', "nodes=2", f'out="{out}"'])
        example.finished(run, "flwr run")
        for name, process in refused.items():
            assert process.wait(120) != 0, name
            assert "Failed to initialize the connection to the SuperLink" in example.log(site, name)
        assert example.log(site, "superlink").count("Activated node_id") == 2
    card = checked(out, job_of({"recipe": "fedkalmannet", "rounds": 2, **TINY}), fleet)
    assert [row["absent"] | row["rejected"] for row in card["history"]] == [{}, {}, {}]
    assert card["clients"] == ["c0", "c1"]


@pytest.mark.parametrize("kind", ["<f8", ">f8", "<f4", ">f4"])
def test_the_search_finds_a_drive_in_any_form(kind: str, audit: Any) -> None:
    job, noise = job_of({"recipe": "fedkalmannet", **TINY}), np.random.default_rng(0).bytes(10_001)
    drive = audit.moved(drives(1))
    (own,) = job_clients(job, drive)
    secret, there = audit.Secret.of(own), drive.position[40:43, 0]
    assert secret.found(noise) == set()
    assert secret.found(noise + there.astype(kind).tobytes() + noise) == {kind}
    assert secret.found(noise + there.T.astype(kind).tobytes() + noise) == {kind}
    assert f"gnss 0 {kind}" in secret.found(noise + own.training.gnss.numpy().astype(kind).tobytes())
    assert secret.found(noise + str(there.round(2).tolist()).encode()) == {"text"}
    fixes = observe(drive, sensors(job.setting), V2X(max_neighbours=0)).gnss[0]
    assert kind in secret.found(noise + fixes.astype(kind).tobytes())


def test_no_drive_leaves_its_client(tmp_path: Path, mark: str, example: Any, audit: Any) -> None:
    """Without TLS, so that the wire can be read: an honest run, then one that gives the drive away."""
    with subprocess.Popen(["sleep", "60"]) as child:
        readable = any(audit.memory(child.pid))
        child.kill()
    if not readable:
        pytest.skip("the memory of other processes cannot be read here: kernel.yama.ptrace_scope")
    strange, plain = audit.moved(drives(1)), drives(2).select(["c1"])
    both = Fleet(
        ("c0", "c1"),
        plain.t,
        np.concatenate([strange.position, plain.position], 1),
        np.concatenate([strange.velocity, plain.velocity], 1),
    )
    job = job_of({"recipe": "fedkalmannet", "rounds": 1, **TINY})
    secret, leaky = audit.Secret.of(job_clients(job, strange)[0]), tmp_path / "leaky"
    leaky.mkdir()
    (leaky / "pyproject.toml").write_text((example.APP / "pyproject.toml").read_text())
    (leaky / "apps.py").write_text(LEAK)
    out = tmp_path / "fedkalmannet.safetensors"
    words = [f'change="rounds=1 {CHANGE}"', "nodes=2", "patience=100.0", f'out="{out}"']
    with example.deployment(tmp_path / "site", tls=False) as site, audit.Wiretap(site.port) as tap:
        nodes = example.join(site, each(both), tap.port)

        run, held = first_answer(example, audit, site, nodes, words, example.APP)
        example.finished(run, "flwr run")
        assert set().union(*map(secret.found, held.values())) == set()
        assert b"/v1/fleet/push-messages" in b"".join(tap.records)
        assert set().union(*(secret.found(bytes(record)) for record in tap.records)) == set()
        kept = [path for path in site.folder.rglob("*") if path.is_file() and "node-" not in str(path)]
        assert {path.name for path in kept} >= {"superlink.log", "run.log", "apps.py"}
        for path in [*kept, out]:
            assert secret.found(path.read_bytes()) == set(), path
        checked(out, job, both)

        _, held = first_answer(example, audit, site, nodes, words, leaky)
        wire = set().union(*(secret.found(bytes(record)) for record in tap.records))
        assert wire >= {"<f8", "<f4", "text", "gnss 0 <f4"}
        assert set().union(*map(secret.found, held.values())) >= {"<f8", "<f4", "gnss 0 <f4"}


def first_answer(
    example: Any, audit: Any, site: Any, nodes: Sequence[subprocess.Popen[bytes]], words: Sequence[str], app: Path
) -> tuple[subprocess.Popen[bytes], dict[str, bytes]]:
    """A run, and the servers' memory at the moment when the first node has answered and the second has not."""
    said = example.log(site, "node-1").count("Sent successfully")
    asked = example.log(site, "node-2").count("Receiving")
    run = example.submit(site, words, app)
    until(lambda: example.log(site, "node-2").count("Receiving") > asked, alive=run)
    os.killpg(nodes[1].pid, signal.SIGSTOP)
    try:
        until(lambda: example.log(site, "node-1").count("Sent successfully") > said, alive=run)
        time.sleep(1)
        held = audit.server_memory(site, run)
    finally:
        os.killpg(nodes[1].pid, signal.SIGCONT)
    assert held.keys() == set(audit.SERVERS)
    return run, held
