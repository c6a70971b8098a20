"""Runs of the small study: its command, the numbers of its results, and what stands in its folder."""

import os
import subprocess
import sys
from pathlib import Path

DISTRIBUTION = Path(__file__).parent / "distribution"
ENV = {**os.environ, "PYTHONPATH": str(DISTRIBUTION), "COLUMNS": "100"}
COMMAND = [sys.executable, "-m", "coopoc.cli", "run", "small"]


def numbers(frame):
    """All columns but times and the names of cells, which hold every setting."""
    return frame[[c for c in frame if c != "cell" and not c.endswith("seconds")]]


def files(folder, kind="cells"):
    """Time of writing and content of every finished cell, or of what else has a folder there."""
    return {path.name: (path.stat().st_mtime_ns, path.read_bytes()) for path in (folder / kind).glob("[!.]*")}


def shown(folder):
    """Every table and figure, byte for byte."""
    return {path.name: path.read_bytes() for kind in ("tables", "figures") for path in (folder / kind).iterdir()}


def start(out, *words):
    """The command in a process of its own."""
    command = [*COMMAND, "--out", str(out), *words]
    return subprocess.Popen(command, env=ENV, cwd=out, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
