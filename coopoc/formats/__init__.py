"""Files of graphs and trajectories: PyFG, g2o, TUM, KITTI, as read and write pairs that name every wrong line."""

from __future__ import annotations

from pathlib import Path

from ..errors import InputError
from ..plugins import suggestion
from .g2o import read_g2o, write_g2o
from .graph import Graph
from .pyfg import read_pyfg, write_pyfg

GRAPHS = {".pyfg": (read_pyfg, write_pyfg), ".g2o": (read_g2o, write_g2o)}


def load_graph(path: str | Path) -> Graph:
    """Graph of a file, .pyfg or .g2o.

    Raises:
        InputError: another suffix, or what `read_pyfg` and `read_g2o` raise.

    >>> load_graph("ring.json")
    Traceback (most recent call last):
    coopoc.errors.InputError: path = ring.json: must end in .pyfg or .g2o. Rename or convert the file.
    """
    return GRAPHS[_suffix(path)][0](path)


def write_graph(graph: Graph, path: str | Path) -> None:
    """Write a graph, .pyfg or .g2o.

    Raises:
        InputError: another suffix, or what `write_pyfg` and `write_g2o` raise.
    """
    GRAPHS[_suffix(path)][1](graph, path)


def _suffix(path: str | Path) -> str:
    suffix = Path(path).suffix
    if suffix not in GRAPHS:
        hint = suggestion(suffix, GRAPHS, "Rename or convert the file.")
        raise InputError("path", Path(path).name, f"must end in {' or '.join(GRAPHS)}", hint)
    return suffix
