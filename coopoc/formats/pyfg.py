"""PyFG text files: range-aided factor graphs with ground truth, stamps and covariances (PyFactorGraph, CORA)."""

from pathlib import Path

from ..paths import given_path
from .graph import ENDS, NAME, Graph
from .records import Grammar, by_tag
from .values import read_words

TAGS = {
    2: "VERTEX_SE2 VERTEX_XY VERTEX_SE2:PRIOR VERTEX_XY:PRIOR EDGE_SE2 EDGE_SE2_XY",
    3: "VERTEX_SE3:QUAT VERTEX_XYZ VERTEX_SE3:QUAT:PRIOR VERTEX_XYZ:PRIOR EDGE_SE3:QUAT EDGE_SE3_XYZ",
}
GRAMMAR = Grammar(
    "PyFG",
    by_tag(TAGS, stamped=("pose", *ENDS)),
    noise="covariance",
    name=lambda word, kind: word if NAME.fullmatch(word) else "",
)


def read_pyfg(path: str | Path) -> Graph:
    """Graph of a PyFG file: letters are robots (L by custom landmarks), vertex lines hold the ground truth.

    Args:
        path: lines `VERTEX_SE2 stamp A0 x y theta`, `VERTEX_XY L0 x y`, `EDGE_SE2 stamp A0 A1 x y theta cov`,
            `EDGE_SE2_XY stamp A0 L0 x y cov`, `EDGE_RANGE stamp A0 L0 r variance`,
            `VERTEX_SE2:PRIOR stamp A0 x y theta cov`, `VERTEX_XY:PRIOR stamp L0 x y cov`; in 3-D VERTEX_SE3:QUAT,
            VERTEX_XYZ, EDGE_SE3:QUAT, EDGE_SE3_XYZ and their priors; s, m, rad; cov is the upper triangle by rows.

    Raises:
        InputError: with the line, a record that is none of these, words that are missing or no finite numbers, an
            unknown or repeated vertex, 2-D beside 3-D, or what `Graph` refuses.

    Source: the files and the reader and writer of PyFactorGraph (MarineRoboticsGroup).

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "two.pyfg"
    >>> _ = file.write_text("VERTEX_XY L0 11 19\\nVERTEX_XY L1 11 21\\nEDGE_RANGE 0 L0 L1 2 1\\n")
    >>> read_pyfg(file).ranges.distance
    array([2.])
    """
    path = given_path(path)
    return GRAMMAR.read(path.name, read_words(path))
