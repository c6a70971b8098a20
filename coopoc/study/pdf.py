"""pdf: a page of HTML as a PDF, printed by Chromium, which draws it as a reader's browser does."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

from tqdm import tqdm

from ..errors import InputError, MissingLibraryError

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
"""Names of the program in Linux distributions, in the order in which they are tried."""
FLAGS = (
    "--headless",
    "--disable-gpu",
    "--no-pdf-header-footer",
    "--no-first-run",
    "--disable-extensions",
    "--no-sandbox",  # without it Chromium refuses to start as root, as in a container; the page is our own
)
_SECONDS = 180


def browser() -> str:
    """Path of Chromium; MissingLibraryError if there is none."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        raise MissingLibraryError("chromium", "a PDF of the report", "chromium", "apt-get install")
    return found


def printed(page: str) -> bytes:
    """The page as a PDF.

    Raises:
        MissingLibraryError: no Chromium. InputError: it could not print the page, with its last words.
    """
    program = browser()
    with (
        tempfile.TemporaryDirectory(prefix="coopoc-", ignore_cleanup_errors=True) as name,
        tqdm(total=1, desc="PDF", unit="page", leave=False),
    ):
        folder = Path(name)
        (folder / "page.html").write_text(page)
        out = folder / "page.pdf"
        # a profile of its own: a browser that is already open would take the page and print nothing
        command = [
            program,
            *FLAGS,
            f"--user-data-dir={folder / 'profile'}",
            f"--print-to-pdf={out}",
            (folder / "page.html").as_uri(),
        ]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_SECONDS)
            ended = done.stderr.strip().splitlines()[-1:] or [f"exit status {done.returncode}"]
        except subprocess.TimeoutExpired:
            ended = [f"not done after {_SECONDS} s"]
        if not out.is_file():
            raise InputError("PDF", program, f"could not print the page: {ended[0]}", "Write report.html and print it.")
        return out.read_bytes()
