"""A federation over the network: a server and four vehicles, processes of their own, on this machine's loopback.

Makes a certificate authority, a certificate for the server and a key pair for every vehicle; starts a SuperLink with
TLS and node authentication, and for each vehicle a SuperNode that holds the drive of this vehicle only; trains; prints
the rounds; stops all processes, on Ctrl-C and errors too. Exits with 1 if the run fails.

Run:  python examples/flower_deployment.py --rounds 3
      python examples/flower_deployment.py --rounds 3 --kill 2     vehicle 2 is killed in the second round
"""

import ipaddress
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

import tyro
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from make_fleet import write_table

from coopoc import Fleet, load_fleet
from coopoc.learned.checkpoint import read

APP = Path(__file__).parent / "flower"
HOST = "127.0.0.1"
PATIENCE = 300.0
"""Seconds that a process may take to start or to do one thing."""


def main(
    folder: Path = Path("runs/flower"),
    data: str = "town10-clients",
    rounds: int = 3,
    kill: int | None = None,
    change: str = "",
) -> None:
    """Train a federation of all vehicles of a fleet, one process each.

    Args:
        folder: of keys, drives, logs and the checkpoint.
        data: fleet, a name or a path.
        rounds: of the federation.
        kill: this vehicle, counted from 1, in the middle of the second round.
        change: fields of the recipe, its schedule or its net, such as net-in-mult=2.
    """
    fleet, folder = load_fleet(data), folder.resolve()
    out = folder / "fedkalmannet.safetensors"
    words = [f'change="rounds={rounds} {change}"', f"nodes={len(fleet.ids)}", f'out="{out}"']
    with deployment(folder) as site:
        nodes = join(site, {vehicle: fleet.select([vehicle]) for vehicle in fleet.ids})
        run = submit(site, words)
        if kill is not None:
            wait(partial(logged, site, "run", "[ROUND 2/"), run, "round 2")
            time.sleep(1)
            os.killpg(nodes[kill - 1].pid, signal.SIGKILL)
            print(f"killed node-{kill}", flush=True)
        finished(run, "flwr run", 600.0 * (rounds + 2))
        completed(site)
    show(out)


@dataclass(frozen=True)
class Site:
    """A deployment on this machine: its folder, the SuperLink's port, whether it has TLS and node authentication, and
    the processes that were started."""

    folder: Path
    port: int
    tls: bool = True
    started: "list[subprocess.Popen[bytes]]" = field(default_factory=list)

    def start(self, name: str, *command: str) -> "subprocess.Popen[bytes]":
        """A process with the Flower home FOLDER/NAME that writes to FOLDER/NAME.log."""
        home = self.folder / name
        home.mkdir(exist_ok=True)
        with open(self.folder / f"{name}.log", "wb") as log:
            process = subprocess.Popen(
                [str(TOOLS / command[0]), *command[1:]],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                cwd=home,
                env=environment(home),
                start_new_session=True,
            )
        self.started.append(process)
        return process

    def operator(self, name: str, *arguments: str) -> "subprocess.Popen[bytes]":
        """`flwr`, the command of the server's operator."""
        (self.folder / name).mkdir(exist_ok=True)
        safe = f'root-certificates = "{self.folder / "ca.pem"}"' if self.tls else "insecure = true"
        (self.folder / name / "config.toml").write_text(f'[superlink.here]\naddress = "{HOST}:{self.port}"\n{safe}\n')
        return self.start(name, "flwr", *arguments)


TOOLS = Path(sys.executable).parent


def environment(home: Path) -> dict[str, str]:
    """Variables of a Flower process: its own home, no telemetry, one core, quick looks for work."""
    return os.environ | {
        "FLWR_HOME": str(home),
        "FLWR_TELEMETRY_ENABLED": "0",
        "FLWR_DISABLE_UPDATE_CHECK": "1",
        "FLWR_SUPEREXEC_TASK_POLL_INTERVAL": "0.2",
        "OMP_NUM_THREADS": "1",
        "PYTHONUNBUFFERED": "1",
        "PATH": f"{TOOLS}{os.pathsep}{os.environ.get('PATH', '')}",
    }


@contextmanager
def deployment(folder: Path, tls: bool = True) -> Iterator[Site]:
    """A running SuperLink; all processes are stopped in the end, on errors too."""
    folder.mkdir(parents=True, exist_ok=True)
    site, options = Site(folder, free_port(), tls), ["--insecure"]
    if tls:
        certificates(folder)
        options = [
            "--enable-supernode-auth",
            "--ssl-ca-certfile",
            str(folder / "ca.pem"),
            "--ssl-certfile",
            str(folder / "server.pem"),
            "--ssl-keyfile",
            str(folder / "server.key"),
        ]
    try:
        link = site.start(
            "superlink",
            "flower-superlink",
            "--host",
            HOST,
            "--port",
            str(site.port),
            "--disable-runtime-dependency-installation",
            *options,
        )
        wait(lambda: listens(site.port), link, "the SuperLink")
        yield site
    finally:
        stop(site.started)


def join(site: Site, drives: Mapping[str, Fleet], port: int | None = None) -> "list[subprocess.Popen[bytes]]":
    """A SuperNode for each vehicle, with a file of its own drive, and its key registered under its name.

    Args:
        drives: by vehicle, each a fleet of one.
        port: where the nodes find the SuperLink, if not at its own.
    """
    homes = {vehicle: site.folder / f"node-{number}" for number, vehicle in enumerate(drives, 1)}
    for vehicle, home in homes.items():
        home.mkdir(exist_ok=True)
        write_table(drives[vehicle], home / "drive.parquet")
    if site.tls:
        keys = {vehicle: key_pair(home) for vehicle, home in homes.items()}
        asked = [
            site.operator(
                f"register-{homes[vehicle].name}", "supernode", "register", str(key), "here", "--name", vehicle
            )
            for vehicle, key in keys.items()
        ]
        for process in asked:
            finished(process, "flwr supernode register")
    nodes = {home.name: supernode(site, home.name, identity(site, home), port) for home in homes.values()}
    for name, process in nodes.items():
        wait(partial(logged, site, name, "SuperNode ID"), process, name)
    return list(nodes.values())


def identity(site: Site, home: Path) -> list[str]:
    """Options by which a SuperNode knows the server and is known to it."""
    if not site.tls:
        return ["--insecure"]
    return ["--root-certificates", str(site.folder / "ca.pem"), "--auth-supernode-private-key", str(home / "key")]


def supernode(site: Site, name: str, who: Sequence[str], port: int | None = None) -> "subprocess.Popen[bytes]":
    """A SuperNode that reads its drive from FOLDER/NAME/drive.parquet."""
    drive, link = site.folder / name / "drive.parquet", f"{HOST}:{port or site.port}"
    return site.start(
        name,
        "flower-supernode",
        *who,
        "--superlink",
        link,
        "--max-retries",
        "3",
        "--host",
        HOST,
        "--port",
        str(free_port()),
        "--node-config",
        f'data="{drive}"',
    )


def submit(site: Site, words: Sequence[str], app: Path = APP) -> "subprocess.Popen[bytes]":
    """Send the app to the SuperLink and follow its run: the process ends when the run does."""
    return site.operator("run", "run", str(app), "here", "--stream", "--run-config", " ".join(words))


def completed(site: Site) -> None:
    """Raise RuntimeError if the latest run failed: `flwr run` exits with 0 in any case."""
    status = ""
    while "finished:" not in status:
        finished(site.operator("list", "list", "here", "--limit", "1", "--format", "json"), "flwr list")
        status = log(site, "list")
    if "finished:completed" not in status:
        raise RuntimeError(f"the run failed: see {site.folder}/run.log; the last round's checkpoint is at `out`")


def show(out: Path) -> None:
    """Print the rounds of a checkpoint."""
    card = read(out)[1]
    print(f"{out}: {card['engine']}, clients {', '.join(card['clients'])}, best round {card['best']}")
    print(f"{'round':>5}{'validation, m^2':>25}{'sent, bytes':>13}{'received':>10}  rejected or absent")
    for row in card["history"]:
        losses = " ".join(f"{loss:.3f}" for loss in row["validation_loss"])
        why = "; ".join(f"{name}: {reason}" for name, reason in (row["rejected"] | row["absent"]).items())
        print(f"{row['round']:>5}{losses:>25}{row['sent_bytes']:>13}{row['received_bytes']:>10}  {why}")


def certificates(folder: Path) -> None:
    """A certificate authority (ca.pem), and by it a certificate (server.pem) of the server at the loopback address."""
    authority, server = (ec.generate_private_key(ec.SECP384R1()) for _ in range(2))
    issuer = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "coopoc example authority")])
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, HOST)])
    names = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address(HOST)), x509.DNSName("localhost")])
    signs = x509.BasicConstraints(ca=True, path_length=0)
    for name, holder, key, extension in (("ca.pem", issuer, authority, signs), ("server.pem", subject, server, names)):
        now = datetime.now(UTC)
        made = x509.CertificateBuilder().issuer_name(issuer).subject_name(holder).public_key(key.public_key())
        made = made.serial_number(x509.random_serial_number()).add_extension(extension, critical=False)
        made = made.not_valid_before(now - timedelta(minutes=5)).not_valid_after(now + timedelta(days=30))
        (folder / name).write_bytes(made.sign(authority, hashes.SHA384()).public_bytes(serialization.Encoding.PEM))
    secret(folder / "server.key", server, serialization.PrivateFormat.PKCS8)


def key_pair(home: Path) -> Path:
    """A node's key pair, `key` and `key.pub`; returns the public one, which is registered."""
    key = ec.generate_private_key(ec.SECP384R1())
    secret(home / "key", key, serialization.PrivateFormat.OpenSSH)
    public = key.public_key().public_bytes(serialization.Encoding.OpenSSH, serialization.PublicFormat.OpenSSH)
    (home / "key.pub").write_bytes(public)
    return home / "key.pub"


def secret(path: Path, key: ec.EllipticCurvePrivateKey, format: serialization.PrivateFormat) -> None:
    """Write a private key that only its owner can read."""
    path.touch(mode=0o600)
    path.write_bytes(key.private_bytes(serialization.Encoding.PEM, format, serialization.NoEncryption()))


def log(site: Site, name: str) -> str:
    """What a process has written so far."""
    return (site.folder / f"{name}.log").read_text(errors="replace")


def logged(site: Site, name: str, text: str) -> bool:
    """Whether it has written that."""
    return text in log(site, name)


def wait(true: Callable[[], bool], alive: "subprocess.Popen[bytes]", what: str) -> None:
    """Wait until something is true, as long as a process lives that makes it so."""
    until = time.monotonic() + PATIENCE
    while not true():
        if alive.poll() is not None or time.monotonic() > until:
            raise RuntimeError(f"{what} did not come: see the logs")
        time.sleep(0.1)


def finished(process: "subprocess.Popen[bytes]", what: str, patience: float = PATIENCE) -> None:
    """Wait for a process to end well."""
    if process.wait(patience) != 0:
        raise RuntimeError(f"{what} failed: see the logs")


def free_port() -> int:
    """A free port of the loopback, below the range of outgoing connections."""
    while True:
        with suppress(OSError), socket.create_server((HOST, port := random.SystemRandom().randrange(20_000, 32_000))):
            return port


def listens(port: int) -> bool:
    """Whether a process listens on the port."""
    with suppress(OSError), socket.create_connection((HOST, port), timeout=1):
        return True
    return False


def family(processes: "Sequence[subprocess.Popen[bytes]]") -> set[int]:
    """Ids of the processes and of all that they started (where there is /proc)."""
    parents = dict[int, int]()
    for status in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            parents[int(status.parent.name)] = int(status.read_text().rpartition(")")[2].split()[1])
    found = {process.pid for process in processes if process.poll() is None}
    while more := {child for child, parent in parents.items() if parent in found} - found:
        found |= more
    return found


def stop(processes: "Sequence[subprocess.Popen[bytes]]") -> None:
    """End processes and all that they started: politely, nodes before the server, then with force."""
    everyone = family(processes)
    for process in reversed(processes):
        if process.poll() is None:
            process.terminate()
    for process in reversed(processes):
        with suppress(subprocess.TimeoutExpired):
            process.wait(5)
    for pid in everyone:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    for process in processes:
        process.wait()
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)  # what it had started, if it was dead before


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    tyro.cli(main)
