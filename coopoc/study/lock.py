"""Locks on the folder of a study: one run, or shards of one manifest at the same time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from ..errors import InputError
from .manifest import Manifest, different, read


@contextmanager
def locked(folder: Path, mine: Manifest, shard: str = "") -> Iterator[None]:
    """Make the folder, write its manifest, and lock both for this process, or for shards of the same manifest.

    A second run would replace the manifest under the first one. The operating system releases the locks when the
    process ends, however it ends.

    Args:
        folder: of the study.
        mine: manifest to write.
        shard: "i/n", or nothing for a run of all cells.

    Raises:
        InputError: another run or the same shard holds the folder, shards with another manifest do, or the folder
            cannot be written.
    """
    with ExitStack() as stack:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with FileLock(folder / ".enter"):  # for milliseconds: one process at a time looks at the other locks
                _enter(folder, mine, shard, stack)
        except OSError as error:
            allowed = f"cannot be written ({error.strerror or error})"
            raise InputError("out", str(folder), allowed, "Choose another --out.") from None
        yield


@contextmanager
def one_at_a_time(folder: Path, waits: Callable[[], object]) -> Iterator[None]:
    """Lock for the preparation that shards share: the first makes it, the others call `waits` and find it done."""
    lock = FileLock(folder / ".prepare")
    if not _taken(lock):
        waits()
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def _enter(folder: Path, mine: Manifest, shard: str, stack: ExitStack) -> None:
    own = f".shard-{shard.replace('/', '-of-')}" if shard else ".lock"
    if not _taken(lock := FileLock(folder / own)):
        raise _in_use(folder, f"another process with shard {shard}" if shard else "another run")
    stack.callback(lock.release)
    others = [path for path in (folder / ".lock", *folder.glob(".shard-*")) if path.name != own and _busy(path)]
    if others and (not shard or others[0].name == ".lock"):
        raise _in_use(folder, "another run")
    if others and (fields := different(mine, read(folder))):
        raise _in_use(folder, f"shards that differ in {', '.join(fields)}")
    for left in () if others else (*folder.glob(".*.part"), *folder.glob("*/.*.part")):  # of processes that were killed
        left.unlink()
    mine.save(folder)


def _taken(lock: FileLock) -> bool:
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return False
    return True


def _busy(path: Path) -> bool:
    lock = FileLock(path)
    if free := _taken(lock):
        lock.release()
    return not free


def _in_use(folder: Path, by: str) -> InputError:
    return InputError("out", str(folder), f"is in use by {by}", "Wait until it ends, or choose another --out.")
