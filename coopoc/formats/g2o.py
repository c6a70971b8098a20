"""g2o text files: pose graphs with landmarks, an initial guess and information matrices; no stamps."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..paths import given_path
from .graph import NAME, Graph
from .records import Grammar, by_tag
from .values import read_words, to_numbers

OFFSET = "PARAMS_SE3OFFSET id x y z qx qy qz qw"


def _name(word: str, kind: str) -> str:
    """17 is the pose A17 or the point L17; a GTSAM symbol key carries its own letter."""
    letter, number = divmod(int(word) if word.isascii() and word.isdecimal() and len(word) < 20 else -1, 1 << 56)
    name = f"{chr(letter) if letter > 0 else 'A' if kind == 'pose' else 'L'}{number}"
    return name if letter >= 0 and NAME.fullmatch(name) else ""


TAGS = {
    2: "VERTEX_SE2 VERTEX_XY EDGE_PRIOR_SE2 EDGE_PRIOR_XY EDGE_SE2 EDGE_SE2_XY",
    3: "VERTEX_SE3:QUAT VERTEX_TRACKXYZ EDGE_SE3_PRIOR EDGE_POINTXYZ_PRIOR EDGE_SE3:QUAT EDGE_SE3_TRACKXYZ",
}
GRAMMAR = Grammar(
    "g2o",
    by_tag(TAGS, offset=("EDGE_SE3_PRIOR", "EDGE_SE3_TRACKXYZ")),
    noise="information",
    name=_name,
    others=("PARAMS_SE3OFFSET", "FIX"),
)


def read_g2o(path: str | Path, repair: bool = False) -> Graph:
    """Graph of a g2o file: the vertex with id 17 is called A17 if it is a pose and L17 if it is a point.

    Ids of 2^56 and more are GTSAM's symbol keys, which multi-robot files use: letter * 2^56 + number. A pose and a
    point may share an id, as GTSAM writes them. Covariances are the inverses of the file's information matrices as they
    stand: rotations are rotation vectors, as GTSAM takes them, where g2o's own solver means qx, qy, qz, half of that.

    Args:
        path: lines `VERTEX_SE2 id x y theta`, `VERTEX_XY id x y`, `EDGE_SE2 i j x y theta info`,
            `EDGE_SE2_XY i j x y info`, `EDGE_PRIOR_SE2 i x y theta info`, `EDGE_PRIOR_XY i x y info`;
            `VERTEX_SE3:QUAT id x y z qx qy qz qw`, `VERTEX_TRACKXYZ id x y z`,
            `EDGE_SE3:QUAT i j x y z qx qy qz qw info`, `EDGE_SE3_TRACKXYZ i j offset x y z info`,
            `EDGE_SE3_PRIOR i offset x y z qx qy qz qw info`, `EDGE_POINTXYZ_PRIOR i x y z info`,
            `PARAMS_SE3OFFSET id x y z qx qy qz qw` (the identity, where an edge uses it); `FIX id ...`; and
            `EDGE_RANGE i j r information`, which g2o lacks and its users add under this name.
            m and rad; info is the upper triangle by rows.
        repair: take the nearest positive definite matrix for an information that is none, and say so in Graph.notes.

    Raises:
        InputError: with the line, a record that is none of these, words that are missing or no finite numbers, an
            unknown, repeated or ambiguous vertex, 2-D beside 3-D, a singular information, or what `Graph` refuses.

    Source: the g2o wiki (File Format), and the types that g2o registers in slam2d and slam3d.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "two.g2o"
    >>> _ = file.write_text("VERTEX_SE2 0 0 0 0\\nVERTEX_SE2 1 1 0 0\\nEDGE_SE2 0 1 1 0 0 4 0 0 4 0 100\\nFIX 0\\n")
    >>> read_g2o(file).relative_pose.covariance[0].diagonal()
    array([0.25, 0.25, 0.01])
    """
    path = given_path(path)
    lines = list(read_words(path))
    records = [line for line in lines if line[1][0] not in GRAMMAR.others]
    offsets = [line for line in lines if line[1][0] == "PARAMS_SE3OFFSET"]
    poses = to_numbers(path.name, [number for number, _ in offsets], [words[2:] for _, words in offsets], OFFSET, 7)
    identity = {words[1]: bool((pose == np.eye(7)[6]).all()) for (_, words), pose in zip(offsets, poses, strict=True)}
    for number, words in records:
        record = GRAMMAR.records.get(words[0])
        if record and record.offset and len(words) == record.width:
            word = words[1 + len(record.ends)]
            if not identity.get(word, False):
                allowed = "must be the identity" if word in identity else "must be given by a line PARAMS_SE3OFFSET"
                where = f"{path.name}: line {number}"
                raise InputError(where, f"offset {word}", allowed, "Measure from the pose itself.")
    fixed = [(number, word) for number, words in lines if words[0] == "FIX" for word in words[1:]]
    return replace(GRAMMAR.read(path.name, records, fixed, repair), guess=True)
