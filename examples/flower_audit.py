"""What leaves the vehicles: a federation without TLS whose wire, server memory and files are searched for a drive.

The first vehicle's drive is moved away from all other numbers. Everything between nodes and SuperLink passes a port
that keeps a copy. Prints the bytes, and in which forms the drive was found: none.

Run:  python examples/flower_audit.py --rounds 2
"""

from __future__ import annotations

import itertools
import re
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import tyro
from flower_deployment import Site, deployment, family, finished, join, submit

from coopoc import Fleet, load_fleet
from coopoc.learned.flower.job import job_of
from coopoc.learned.recipes import job_clients
from coopoc.learned.training.clients import Client

HOME = (8361947.123, -4720583.456, 913.77)
"""Offset of the drive, m: far from all other numbers."""
REACH = 300.0
"""How far from there it and its noisy fixes are at most, m."""
KINDS = ("<f8", ">f8", "<f4", ">f4")
SERVERS = ("flower-superlink", "flwr-serverapp")
"""The programs that get to see what clients send."""


def main(folder: Path = Path("runs/flower_audit"), data: str = "town10-clients", rounds: int = 2) -> None:
    """Train a federation and search it.

    Args:
        folder: of drives, logs and the checkpoint.
        data: fleet, a name or a path. The first vehicle must stay within 300 m of its start.
        rounds: of the federation.
    """
    fleet, folder = load_fleet(data), folder.resolve()
    drives = {vehicle: fleet.select([vehicle]) for vehicle in fleet.ids}
    first = fleet.ids[0]
    drives[first] = moved(drives[first])
    job = job_of({"recipe": "fedkalmannet", "rounds": rounds, "local-epochs": 1})
    secret = Secret.of(job_clients(job, drives[first])[0])
    words = [f'change="rounds={rounds} local-epochs=1"', f"nodes={len(drives)}", f'out="{folder / "net.safetensors"}"']
    with deployment(folder, tls=False) as site, Wiretap(site.port) as tap:
        join(site, drives, tap.port)
        run, held, looked = submit(site, words), set[str](), set[str]()
        while run.poll() is None:
            time.sleep(2)
            blobs = server_memory(site, run)
            looked |= blobs.keys()
            held |= {form for blob in blobs.values() for form in secret.found(blob)}
        finished(run, "flwr run")
        up, down = tap.moved()
        print(f"bytes per vehicle: {up / len(drives):.0f} from it, {down / len(drives):.0f} to it, {rounds} rounds")
        wire = {form for record in tap.records for form in secret.found(bytes(record))}
        files = [path for path in folder.rglob("*") if path.is_file() and "node-" not in str(path)]
        kept = {form for path in files for form in secret.found(path.read_bytes())}
    of = " and ".join(sorted(looked)) or "none: it cannot be read here"
    for place, forms in (("on the wire", wire), (f"in the memory of {of}", held), ("in the server's files", kept)):
        print(f"the drive {place}: {', '.join(sorted(forms)) or 'not found'}")


def moved(drive: Fleet) -> Fleet:
    """The same drive from `HOME` on."""
    return replace(drive, position=drive.position - drive.position[0] + np.array(HOME))


@dataclass(frozen=True)
class Secret:
    """A drive around `HOME`, and bytes of its pieces as they are trained on, relative to their starts."""

    rows: Mapping[str, bytes]

    @classmethod
    def of(cls, client: Client) -> Secret:
        """The first rows of the client's noisy and true pieces, as numbers of every kind."""
        rows = dict[str, bytes]()
        for name in ("gnss", "truth"):
            for number, piece in enumerate(getattr(client.training, name).numpy()[:2]):
                rows |= {f"{name} {number} {kind}": piece[1:3].astype(kind).tobytes() for kind in KINDS}
        return cls(rows)

    def found(self, blob: bytes) -> set[str]:
        """The forms in which the drive is in these bytes, at any place."""
        hits = {name for name, rows in self.rows.items() if rows in blob}
        hits |= {"text"} if re.search(rb"836[12]\d\d\d\.\d", blob) else set()
        return hits | {kind for kind in KINDS if near(blob, kind)}


def near(blob: bytes, kind: str) -> bool:
    """Whether an x of the drive is anywhere in these bytes, beside another x or its y."""
    bounds = [np.array(HOME[0] + side, f">{kind[1:]}").tobytes() for side in (-REACH, REACH)]
    same = itertools.takewhile(lambda pair: pair[0] == pair[1], zip(*bounds, strict=True))
    start = bytes(byte for byte, _ in same)  # with which every x begins
    size, lead = len(bounds[0]), 0 if kind[0] == ">" else len(bounds[0]) - len(start)
    for match in re.finditer(re.escape(start if kind[0] == ">" else start[::-1]), blob):
        at = match.start() - lead
        if 0 <= at <= len(blob) - 2 * size:
            first, second = np.frombuffer(blob, kind, 2, at).tolist()
            if abs(first - HOME[0]) < REACH and min(abs(second - axis) for axis in HOME[:2]) < REACH:
                return True
    return False


def server_memory(site: Site, run: subprocess.Popen[bytes]) -> dict[str, bytes]:
    """What SuperLink and ServerApp hold in memory, by program, while they run."""
    found = dict[str, bytes]()
    for pid in family([site.started[0], run]):
        with suppress(OSError):
            line = Path(f"/proc/{pid}/cmdline").read_text()
            found |= {name: b"".join(memory(pid)) for name in SERVERS if name in line}
    return {name: blob for name, blob in found.items() if blob}


def memory(pid: int) -> Iterator[bytes]:
    """What a process holds in memory that it can write to and that is no file's."""
    with suppress(OSError), open(f"/proc/{pid}/mem", "rb", buffering=0) as held:
        for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
            span, access, _, _, inode, *_ = line.split()
            if access == "rw-p" and inode == "0":
                start, stop = (int(end, 16) for end in span.split("-"))
                with suppress(OSError):
                    held.seek(start)
                    yield held.read(stop - start)


@dataclass
class Wiretap:
    """A port that passes everything on to another and keeps a copy, connection by connection and way by way."""

    target: int
    server: socket.socket = field(default_factory=lambda: socket.create_server(("127.0.0.1", 0)))
    ends: list[socket.socket] = field(default_factory=list)
    threads: list[threading.Thread] = field(default_factory=list)
    records: list[bytearray] = field(default_factory=list)

    @property
    def port(self) -> int:
        """Where to connect."""
        return int(self.server.getsockname()[1])

    def moved(self) -> tuple[int, int]:
        """Bytes from the clients and to them."""
        return sum(map(len, self.records[0::2])), sum(map(len, self.records[1::2]))

    def __enter__(self) -> Wiretap:
        self._run(self._accept)
        return self

    def __exit__(self, *_: object) -> None:
        self.server.shutdown(socket.SHUT_RDWR)
        self.threads[0].join()
        for end in self.ends:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        for thread in self.threads:
            thread.join()
        for end in (self.server, *self.ends):
            end.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near_end, _ = self.server.accept()
                self.ends += [near_end, socket.create_connection(("127.0.0.1", self.target))]
                self.records += [bytearray(), bytearray()]
                self._run(self._pump, *self.ends[-2:], self.records[-2])
                self._run(self._pump, *self.ends[:-3:-1], self.records[-1])

    def _pump(self, source: socket.socket, sink: socket.socket, record: bytearray) -> None:
        with suppress(OSError):
            while data := source.recv(1 << 16):
                record.extend(data)
                sink.sendall(data)
            sink.shutdown(socket.SHUT_WR)

    def _run(self, work: Callable[..., None], *arguments: object) -> None:
        self.threads.append(threading.Thread(target=work, args=arguments))
        self.threads[-1].start()


if __name__ == "__main__":
    tyro.cli(main)
