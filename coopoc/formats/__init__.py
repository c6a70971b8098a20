"""Files of graphs and trajectories: PyFG and g2o read and written, JRL read, TUM and KITTI trajectories."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ..arrays import instance
from ..errors import InputError, suggestion
from ..file_names import given_path
from .g2o import read_g2o, write_g2o
from .graph import Graph
from .jrl import read_jrl
from .pyfg import read_pyfg, write_pyfg

GRAPHS = {".pyfg": read_pyfg, ".g2o": read_g2o, ".jrl": read_jrl}
WRITERS = {".pyfg": write_pyfg, ".g2o": write_g2o}


def load_graph(path: str | Path) -> Graph:
    """Graph of a file, .pyfg, .g2o or .jrl.

    Raises:
        InputError: another suffix, or what `read_pyfg`, `read_g2o` and `read_jrl` raise.

    >>> load_graph("ring.json")
    Traceback (most recent call last):
    coopoc.errors.InputError: path = ring.json: must end in .pyfg or .g2o or .jrl. Rename or convert the file.
    """
    return GRAPHS[_suffix(path, GRAPHS)](path)


def write_graph(graph: Graph, path: str | Path) -> None:
    """Write a graph, .pyfg or .g2o.

    Raises:
        InputError: another suffix, or what `write_pyfg` and `write_g2o` raise.
    """
    WRITERS[_suffix(path, WRITERS)](instance("graph", graph, Graph), path)


def _suffix(path: str | Path, known: Iterable[str]) -> str:
    suffix, known = given_path(path).suffix, list(known)
    if suffix not in known:
        hint = suggestion(suffix, known, "Rename or convert the file.")
        raise InputError("path", Path(path).name, f"must end in {' or '.join(known)}", hint)
    return suffix
