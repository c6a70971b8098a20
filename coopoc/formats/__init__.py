"""Files of graphs and trajectories: graphs in PyFG, g2o and JRL, trajectories in TUM and KITTI."""

from __future__ import annotations

from pathlib import Path

from ..errors import InputError, suggestion
from ..file_names import given_path
from ..plugins import find
from .g2o import read_g2o
from .graph import Graph
from .jrl import read_jrl
from .pyfg import read_pyfg

GRAPHS = {".pyfg": read_pyfg, ".g2o": read_g2o, ".jrl": read_jrl}


def load_graph(path: str | Path, repair: bool = False) -> Graph:
    """Graph of a file, .pyfg, .g2o or .jrl.

    Args:
        path: of the file, or the name of a public graph that has been fetched.
        repair: see `read_g2o`, whose matrices are information.

    Raises:
        InputError: another suffix, or what `read_pyfg`, `read_g2o` and `read_jrl` raise.

    >>> load_graph("ring.json")
    Traceback (most recent call last):
    coopoc.errors.InputError: path = ring.json: must end in .pyfg or .g2o or .jrl. Rename or convert the file.
    """
    suffix = given_path(path).suffix
    if suffix not in GRAPHS and (fetched := find("coopoc.readers", "fetched")(str(path))):
        return load_graph(fetched, repair)
    if suffix not in GRAPHS:
        hint = suggestion(suffix, GRAPHS, "Rename or convert the file.")
        raise InputError("path", Path(path).name, f"must end in {' or '.join(GRAPHS)}", hint)
    return read_g2o(path, repair) if suffix == ".g2o" else GRAPHS[suffix](path)
