"""Files of graphs and trajectories: PyFG, g2o, JRL, TUM, KITTI, as read and write pairs that name what is wrong."""

from __future__ import annotations

from pathlib import Path

from ..arrays import instance
from ..errors import InputError
from ..file_names import given_path
from ..plugins import suggestion
from .g2o import read_g2o, write_g2o
from .graph import Graph
from .jrl import read_jrl
from .jrl_write import write_jrl
from .pyfg import read_pyfg, write_pyfg

GRAPHS = {".pyfg": (read_pyfg, write_pyfg), ".g2o": (read_g2o, write_g2o), ".jrl": (read_jrl, write_jrl)}


def load_graph(path: str | Path) -> Graph:
    """Graph of a file, .pyfg, .g2o or .jrl.

    Raises:
        InputError: another suffix, or what `read_pyfg`, `read_g2o` and `read_jrl` raise.

    >>> load_graph("ring.json")
    Traceback (most recent call last):
    coopoc.errors.InputError: path = ring.json: must end in .pyfg or .g2o or .jrl. Rename or convert the file.
    """
    return GRAPHS[_suffix(path)][0](path)


def write_graph(graph: Graph, path: str | Path) -> None:
    """Write a graph, .pyfg, .g2o or .jrl.

    Raises:
        InputError: another suffix, or what `write_pyfg`, `write_g2o` and `write_jrl` raise.
    """
    GRAPHS[_suffix(path)][1](instance("graph", graph, Graph), path)


def _suffix(path: str | Path) -> str:
    suffix = given_path(path).suffix
    if suffix not in GRAPHS:
        hint = suggestion(suffix, GRAPHS, "Rename or convert the file.")
        raise InputError("path", Path(path).name, f"must end in {' or '.join(GRAPHS)}", hint)
    return suffix
