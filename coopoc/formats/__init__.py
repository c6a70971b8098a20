"""Files of graphs and trajectories: graphs in PyFG and g2o, trajectories in TUM."""

from pathlib import Path

from ..errors import InputError, suggestion
from ..paths import given_path
from ..plugins import find
from .g2o import read_g2o
from .graph import Graph
from .pyfg import read_pyfg

GRAPHS = (".pyfg", ".g2o")


def load_graph(path: str | Path, repair: bool = False) -> Graph:
    """Graph of a file, .pyfg or .g2o.

    Args:
        path: of the file, or the name of a public graph that has been fetched.
        repair: see `read_g2o`, whose matrices are information.

    Raises:
        InputError: another suffix, or what `read_pyfg` and `read_g2o` raise.

    >>> load_graph("ring.json")
    Traceback (most recent call last):
    coopoc.errors.InputError: path = ring.json: must end in .pyfg or .g2o. Rename or convert the file.
    """
    suffix = given_path(path).suffix.lower()
    if suffix == ".pyfg":
        return read_pyfg(path)
    if suffix == ".g2o":
        return read_g2o(path, repair)
    if fetched := find("coopoc.readers", "fetched")(str(path)):
        return load_graph(fetched, repair)
    hint = suggestion(suffix, GRAPHS, "Rename or convert the file.")
    raise InputError("path", str(path), f"must end in {' or '.join(GRAPHS)}", hint)
