"""What a reader owes to any file: our exceptions alone, no warning, little time and memory, nothing done elsewhere."""

import resource
import shutil
import sys
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from coopoc import InputError

from .readers import Reader, unpacked

SECONDS, MEMORY = 2.0, 20
"""s per started MB of the files, bytes per byte of them."""
FREE = 96 * 2**20
"""bytes that any file may take: tables of the libraries, which grow while they warm up."""
FORBIDDEN = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "socket.connect", "pickle.find_class")


class _Guard:
    """Notes what is written outside of a folder or run, while it is on; an audit hook cannot be removed."""

    def __init__(self) -> None:
        self.folder, self.events = "", list[str]()
        sys.addaudithook(self.notice)

    def notice(self, event: str, given: tuple[Any, ...]) -> None:
        if not self.folder:
            return
        if event in FORBIDDEN:
            self.events.append(event)
        elif event in ("open", "os.remove", "os.rename", "os.mkdir"):
            reads = event == "open" and not (isinstance(given[1], str) and set(given[1]) & set("wxa+"))
            if not (reads or isinstance(given[0], int) or str(given[0]).startswith(self.folder)):
                self.events.append(f"{event} {given[0]!r}")

    @contextmanager
    def on(self, folder: Path) -> Iterator[list[str]]:
        self.folder, self.events = str(folder), []
        try:
            yield self.events
        finally:
            self.folder = ""


@cache
def _guard() -> _Guard:
    return _Guard()


def verdict(reader: Reader, text: bytes, folder: Path) -> str:
    """Nothing, or how the reader broke its contract on a packed text.

    Args:
        reader: of the text.
        text: as `readers.packed` makes one.
        folder: empty, or with the files of another call, which are removed.
    """
    fault = _tried(reader, text, folder)
    return fault and _tried(reader, text, folder)  # a fault shows twice; a first call may compile and load kernels


def _tried(reader: Reader, text: bytes, folder: Path) -> str:
    files = unpacked(text, reader.files)
    for other in folder.iterdir():
        if other.is_dir():
            shutil.rmtree(other)
        elif other.name not in files:
            other.unlink()
    for name, content in files.items():
        (folder / name).write_bytes(content)
    before, began = _peak(), time.process_time()
    with warnings.catch_warnings(), _guard().on(folder) as events:
        warnings.simplefilter("error")
        try:
            reader.read(folder)
        except InputError as error:
            if len(str(error)) > 5000:
                return "a message without end"
        except Exception as error:
            return f"{type(error).__name__} at {_place(error)}: {error}"[:300]
    took = time.process_time() - began
    if took > SECONDS * (1 + len(text) // 2**20):
        return f"slow: {took:.1f} s"
    if (more := _peak() - before) > FREE + MEMORY * len(text):
        return f"memory: {more >> 20} MB"
    return f"not allowed: {events[0]}" if events else ""


def _peak() -> int:
    """bytes, most memory that the process ever held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _place(error: BaseException) -> str:
    """Our innermost line."""
    frames = traceback.extract_tb(error.__traceback__)
    last = ([f for f in frames if "/site-packages/" not in f.filename and "/fuzz/" not in f.filename] or frames)[-1]
    return f"{Path(last.filename).name}:{last.lineno}"
