"""Public measurements by name: download, verify by SHA-256, and keep in the user's cache."""

import hashlib
import io
import os
import tomllib
import urllib.request
import zipfile
from collections.abc import Mapping
from functools import cache
from http.client import HTTPException
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote, urljoin

from coopoc.errors import InputError, said, suggestion, unknown
from coopoc.workers import progress_bar

TIMEOUT = 20.0
"""s without a byte, after which a server is given up."""
ARCHIVE = "archive.zip"
"""Name under which an archive is shown while it is fetched."""


class Entry(NamedTuple):
    """A public data set.

    Attributes:
        name: by which it is fetched.
        what: it holds, in a few words.
        licence: as its authors state it.
        citation: of its paper or page.
        page: of the project, for whom has to fetch it by hand.
        tried: what is known of the addresses.
        files: path below the folder of the name -> (address, bytes, SHA-256).
        archive: address of a ZIP archive with all files, "" if each has its own.
        opens: what `fetch` returns, below the folder of the name.
    """

    name: str
    what: str
    licence: str
    citation: str
    page: str
    tried: str
    files: Mapping[str, tuple[str, int, str]]
    archive: str = ""
    opens: str = ""

    @property
    def folder(self) -> Path:
        """Of its files."""
        return cache_folder() / self.name

    @property
    def path(self) -> Path:
        """Of the file or folder that readers take."""
        return self.folder / self.opens

    @property
    def bytes(self) -> int:
        """Of all files."""
        return sum(size for _, size, _ in self.files.values())

    @property
    def fetched(self) -> bool:
        """Whether every file is there with its bytes."""
        return not self.absent()

    def absent(self) -> list[str]:
        """Files that are not there, or with other bytes."""
        return [file for file, (_, _, digest) in self.files.items() if _digest(self.folder / file) != digest]

    def address(self, file: str) -> str:
        """Where a file is served; below a mirror as it lies in the folder of all data."""
        mirror = os.environ.get("COOPOC_MIRROR")
        return f"{mirror.rstrip('/')}/{quote(f'{self.name}/{file}')}" if mirror else self.archive or self.files[file][0]


@cache
def public() -> Mapping[str, Entry]:
    """The public data sets by name.

    >>> public()["plaza1"].bytes
    2349302
    """
    written = tomllib.loads(Path(__file__).with_name("public.toml").read_text("utf-8"))
    return {name: _entry(name, **fields) for name, fields in written.items()}


def _entry(name: str, files: Mapping[str, Mapping[str, Any]], base: str = "", **fields: str) -> Entry:
    rows = {file: (urljoin(base, row.get("from", "")), row["bytes"], row["sha256"]) for file, row in files.items()}
    return Entry(name, files=rows, **fields)


def cache_folder() -> Path:
    """Folder of all fetched data: COOPOC_DATA, else the user's cache."""
    if chosen := os.environ.get("COOPOC_DATA"):
        return Path(chosen).expanduser().absolute()
    import pooch

    return Path(pooch.os_cache("coopoc"))


def holder(file: str) -> str:
    """The data set that brings a file or folder of that name, "" if none does.

    >>> holder("tiers.pyfg"), holder("MRCLAM_Dataset7"), holder("mine.csv")
    ('tiers', 'mrclam-set7', '')
    """
    for name, entry in public().items():
        if file == name or any(file in Path(part).parts for part in entry.files):
            return name
    return ""


def bring(path: str | Path, otherwise: str) -> str:
    """The hint for a file or folder that is missing: the command that brings it, else another hint.

    >>> bring("data/plaza1.pyfg", "Check the path.")
    'Run coopoc data get plaza1.'
    """
    name = holder(Path(path).name)
    return f"Run coopoc data get {name}." if name else suggestion(str(path), public(), otherwise)


def local(name: str) -> Path | None:
    """Path of a data set that has been fetched, None for what is no name of one.

    Raises:
        InputError: it has not been fetched.
    """
    entry = public().get(name)
    if entry is None:
        return None
    if not entry.fetched:
        raise InputError("data", repr(name), f"is not in {cache_folder()} yet", f"Run coopoc data get {name}.")
    return entry.path


def fetch(name: str) -> Path:
    """Local path of a public data set, downloaded once and verified by SHA-256.

    COOPOC_DATA names the folder of all data, else it is the user's cache. COOPOC_MIRROR is a base address at which a
    copy of that folder is served; it is asked instead of the projects' servers.

    Args:
        name: a name that `coopoc data list` shows.

    Returns:
        The file or folder that `load_fleet`, `read_log` and `read_graph` take.

    Raises:
        InputError: an unknown name; no network, a server that does not answer, or bytes of another hash: with the
            address to fetch by hand and the folder where to put it.
    """
    entry = public().get(name) if isinstance(name, str) else None
    if entry is None:
        raise unknown("data", name, public())
    from filelock import FileLock

    if not entry.fetched:
        try:
            entry.folder.mkdir(parents=True, exist_ok=True)
            with FileLock(entry.folder / ".lock"):
                _bring(entry)
        except OSError as error:
            raise InputError(
                "COOPOC_DATA",
                str(entry.folder),
                f"must be a folder that can be written: {said(error)}",
                "Set COOPOC_DATA to one.",
            ) from None
    return entry.path


def _bring(entry: Entry) -> None:
    """Download what is absent: each file from its address or the mirror's, else the archive of all; and keep what has
    the right bytes."""
    absent, unpacked = entry.absent(), {}  # another process may have brought it meanwhile
    if absent and entry.address(absent[0]) == entry.archive:
        data = _downloaded(entry, entry.archive, entry.folder / ARCHIVE, entry.bytes)
        unpacked = _unpacked(entry, absent, data)
    for file in absent:
        address, (_, size, digest), path = entry.address(file), entry.files[file], entry.folder / file
        data = unpacked[file] if unpacked else _downloaded(entry, address, path, size)
        if (actual := hashlib.sha256(data).hexdigest()) != digest:
            raise _by_hand(entry, address, path, f"SHA-256 {actual} must have SHA-256 {digest}; it was removed")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def _downloaded(entry: Entry, address: str, to: Path, size: int) -> bytes:
    """What an address serves, in memory: the largest data set has tens of megabytes.

    Args:
        entry: that it belongs to.
        address: asked for.
        to: its place, for the progress bar and for whom has to fetch it by hand.
        size: bytes of the file; of an archive the most that it may have. One byte more shows another file.

    Raises:
        InputError: what went wrong, and how to fetch it by hand.
    """
    data = bytearray()
    try:
        bar = progress_bar(desc=to.name, total=size, unit="B", unit_scale=True, delay=2.0)
        with urllib.request.urlopen(address, timeout=TIMEOUT) as answer, bar:
            while len(data) <= size and (chunk := answer.read(65536)):
                data += chunk
                bar.update(len(chunk))
            rest = getattr(answer, "length", 0) or 0
        if len(data) <= size and rest:
            raise ConnectionError(f"closed the connection after {len(data)} of {len(data) + rest} bytes")
    except (OSError, HTTPException, ValueError) as error:
        late = isinstance(getattr(error, "reason", error), TimeoutError)
        raise _by_hand(entry, address, to, f"sent nothing for {TIMEOUT:g} s" if late else said(error)) from None
    return bytes(data)


def _unpacked(entry: Entry, files: list[str], data: bytes) -> dict[str, bytes]:
    """Bytes of files in an archive, whichever folder they are in there."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {(Path(one.filename).name, one.file_size): one for one in archive.infolist()}
            wanted = {file: members.get((Path(file).name, entry.files[file][1])) for file in files}
            if not (missing := [file for file, member in wanted.items() if member is None]):
                return {file: archive.read(member) for file, member in wanted.items() if member}
        reason = f"{Path(missing[0]).name} is not in it with its {entry.files[missing[0]][1]} bytes"
    except (zipfile.BadZipFile, OSError) as error:
        reason = said(error)
    raise _by_hand(entry, entry.archive, entry.folder / ARCHIVE, reason)


def _by_hand(entry: Entry, address: str, to: Path, reason: str) -> InputError:
    """The error of a download, with the address and the place of the file."""
    if there := _digest(to):
        reason += f"; what is there has SHA-256 {there}"
    if address == entry.archive:
        advice = f"unpack it in {entry.folder}, so that {next(iter(entry.files))} is below"
    else:
        advice = f"save it as {to}"
    return InputError(
        f"{entry.name}: address",
        address,
        f"was not fetched: {reason}",
        f"Fetch it by hand (the project: {entry.page}), {advice}, and run coopoc data get {entry.name} again.",
    )


def _digest(path: Path) -> str:
    """SHA-256 of a file in hex digits, "" without one."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
