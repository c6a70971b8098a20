"""Every wrong line of a PyFG, g2o or TUM file is named with its place and a hint."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import refused

from coopoc import load_fleet
from coopoc.errors import InputError
from coopoc.formats import load_graph
from coopoc.formats.graph import Graph, PointEdges, RangeEdges

PYFG = """VERTEX_SE2 0 A0 0 0 0
VERTEX_SE2 1 A1 1 0 0.5
VERTEX_XY L0 3 4
EDGE_SE2 1 A0 A1 1 0 0.5 1 0 0 1 0 1
EDGE_SE2_XY 1 A1 L0 2 4 1 0 1
EDGE_RANGE 1 A0 L0 5 0.1
VERTEX_SE2:PRIOR 0 A0 0 0 0 1 0 0 1 0 1
"""
BAD_PYFG = {
    "unknown record": ("EDGE_RANGE", "EDGE_RNG", "line 6 = EDGE_RNG", "VERTEX_SE2, VERTEX_XY, VERTEX_SE2:PRIOR"),
    "missing word": ("L0 5 0.1", "L0 5", "line 6 = EDGE_RANGE 1 A0 L0 5 (5 words)", "EDGE_RANGE stamp i j r variance"),
    "no number": ("5 0.1", "five 0.1", "line 6", "all finite numbers"),
    "stamp": ("VERTEX_SE2 1 A1", "VERTEX_SE2 one A1", "line 2", "stamp"),
    "negative variance": ("5 0.1", "5 -0.1", "line 6 = variance -0.1", ">= 0"),
    "variance without an inverse": ("5 0.1", "5 4e-322", "line 6 = variance", "its inverse overflows"),
    "negative range": ("5 0.1", "-5 0.1", "line 6 = distance -5", ">= 0"),
    "indefinite": ("0.5 1 0 0 1 0 1", "0.5 1 2 0 1 0 1", "line 4 = covariance", "positive semi-definite"),
    "indefinite point": ("4 1 0 1", "4 1 0 -1", "line 5 = covariance", "positive semi-definite"),
    "indefinite prior": ("0 0 0 1 0 0 1 0 1", "0 0 0 1 0 0 -1 0 1", "line 7 = covariance", "positive semi-definite"),
    "repeated": ("VERTEX_SE2 1 A1", "VERTEX_SE2 1 A0", "line 2 = vertex A0", "is at a.pyfg: line 1"),
    "repeated point": ("VERTEX_XY L0 3 4\n", "VERTEX_XY L0 3 4\nVERTEX_XY A1 3 4\n", "line 4 = vertex A1", "line 2"),
    "unknown vertex": ("A0 L0 5", "A0 L9 5", "line 6 = vertex L9", "Add its VERTEX line"),
    "wrong kind": ("1 A1 L0 2", "1 A1 A0 2", "line 5 = vertex A0", "must be a point"),
    "itself": ("A0 L0 5", "A0 A0 5", "line 6 = A0 twice", "two vertices"),
    "name": ("VERTEX_XY L0", "VERTEX_XY beacon", "line 3 = vertex beacon", "a letter and a number"),
    "mixed": ("VERTEX_XY L0 3 4", "VERTEX_XYZ L0 3 4 5", "line 3 = VERTEX_XYZ", "must be 2-D as line 1, VERTEX_SE2"),
    "empty": (PYFG, "# nothing\n", "a.pyfg = 0 vertices", "complete"),
    "binary": ("EDGE_RANGE", "\udcff", "a.pyfg", "text in UTF-8"),
}


@pytest.mark.parametrize("case", BAD_PYFG)
def test_a_bad_pyfg_line_is_named(tmp_path, case):
    old, new, thing, hint = BAD_PYFG[case]
    assert len(load_graph(_file(tmp_path / "good.pyfg", PYFG)).ranges) == 1
    assert old in PYFG
    _assert_refused(lambda: load_graph(_file(tmp_path / "a.pyfg", PYFG.replace(old, new, 1))), thing, hint)


G2O = """VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 1 1 0 0 0 0 0 1
VERTEX_TRACKXYZ 2 3 4 5
PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1
EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 4 0 0 0 0 0 4 0 0 0 0 4 0 0 0 9 0 0 9 0 9
EDGE_SE3_TRACKXYZ 0 2 0 3 4 5 1 0 0 1 0 1
EDGE_RANGE 0 2 7 4
FIX 0 1
"""
BAD_G2O = {
    "singular": ("3 4 5 1 0 0 1 0 1", "3 4 5 1 1 0 1 0 1", "line 6 = information", "singular"),
    "indefinite": ("3 4 5 1 0 0 1 0 1", "3 4 5 1 2 0 1 0 1", "line 6 = information", "positive definite"),
    "no information": ("2 7 4", "2 7 0", "line 7 = information [0.0]", "positive definite"),
    "quaternion": ("1 1 0 0 0 0 0 1\nVERTEX_T", "1 1 0 0 1 0 0 1\nVERTEX_T", "line 2 = quaternion", "length 1"),
    "measured quaternion": ("0 1 1 0 0 0 0 0 1 4", "0 1 1 0 0 0 0 0 2 4", "line 5 = quaternion", "length 1"),
    "offset not given": ("EDGE_SE3_TRACKXYZ 0 2 0", "EDGE_SE3_TRACKXYZ 0 2 3", "line 6 = offset 3", "PARAMS_SE3OFFSET"),
    "offset": ("OFFSET 0 0 0", "OFFSET 0 0 1", "line 6 = offset 0", "identity"),
    "offset's words": ("OFFSET 0 0 0", "OFFSET 0 0", "line 4", "PARAMS_SE3OFFSET id x y z"),
    "fixed vertex": ("FIX 0 1", "FIX 0 9", "line 8 = vertex 9", "one of the vertices"),
    "ambiguous": ("TRACKXYZ 2 3", "TRACKXYZ 0 3", "line 6 = vertex 2", "one of the vertices"),
    "both": ("FIX", "VERTEX_TRACKXYZ 1 0 0 0\nEDGE_RANGE 0 1 2 4\nFIX", "line 9 = vertex 1", "both a pose and a point"),
    "id": ("VERTEX_TRACKXYZ 2", "VERTEX_TRACKXYZ -2", "line 3 = vertex -2", "g2o: a number"),
    "wrong kind": ("EDGE_SE3:QUAT 0 1", "EDGE_SE3:QUAT 0 2", "line 5 = vertex 2", "must be a pose"),
    "unknown record": ("FIX", "EDGE_2", "line 8 = EDGE_2", "PARAMS_SE3OFFSET, FIX"),
    "mixed": ("VERTEX_TRACKXYZ 2 3 4 5", "VERTEX_XY 2 3 4", "line 3 = VERTEX_XY", "3-D as line 1"),
    "edges alone": (G2O[: G2O.index("PARAMS")], "", "g2o = 0 vertices", "a line for every vertex"),
}


@pytest.mark.parametrize("case", BAD_G2O)
def test_a_bad_g2o_line_is_named(tmp_path, case):
    old, new, thing, hint = BAD_G2O[case]
    assert load_graph(_file(tmp_path / "good.g2o", G2O)).fixed.tolist() == [0, 1]
    assert old in G2O
    _assert_refused(lambda: load_graph(_file(tmp_path / "a.g2o", G2O.replace(old, new, 1))), thing, hint)


GRAPH = Graph(
    2,
    ("A0", "L5", "A1", "B0", "L7", "B1"),
    [True, False, True, True, False, True],
    np.arange(12.0).reshape(6, 2),
    np.zeros((6, 1)),
    ranges=RangeEdges([[0, 2], [0, 1], [1, 4]], [1, 2, 3], [1, 1, 1]),
    fixed=[1, 0],
)


def test_a_file_of_another_format_is_refused(tmp_path):
    _assert_refused(lambda: load_graph(tmp_path / "a"), "/a: must end in .pyfg or .g2o")
    _assert_refused(lambda: load_graph(tmp_path / "a.pfg"), "/a.pfg: must", "Did you mean .pyfg?")
    _assert_refused(lambda: load_graph(tmp_path / "none.g2o"), "none.g2o", "must be a file")
    assert not list(tmp_path.iterdir())


GRAPH_RULES: dict[str, tuple[dict[str, Any], str]] = {
    "dimension": ({"dimension": 4}, "dimension = 4"),
    "shape": ({"position": np.zeros((6, 3))}, "position = shape (6, 3)"),
    "infinite": ({"position": np.full((6, 2), np.inf)}, "names[0] = vertex A0"),
    "stamp of a point": ({"stamps": np.arange(6.0)}, "names[1] = stamp 1.0 of L5"),
    "names": ({"names": ("A0", "L5", "A1", "B0", "L7", "A0")}, "names[5] = vertex A0"),
    "covariance's shape": ({"point_prior": PointEdges([[1]], [[0, 0]], [np.eye(3)])}, "point_prior.covariance"),
    "asymmetric": ({"point_prior": PointEdges([[1]], [[0, 0]], [[[1, 0.5], [0, 1]]])}, "point_prior[0]"),
    "prior of a pose": ({"point_prior": PointEdges([[0]], [[0, 0]], [np.eye(2)])}, "must be a point"),
    "node": ({"ranges": RangeEdges([[0, 6]], [1.0], [1.0])}, "ranges[0] = vertices [0, 6]"),
    "fixed": ({"fixed": [6]}, "fixed[0] = 6"),
}


@pytest.mark.parametrize("case", GRAPH_RULES)
def test_a_bad_graph_is_named_by_its_row(case):
    change, thing = GRAPH_RULES[case]
    _assert_refused(lambda: replace(GRAPH, **change), thing)


TUM = "# t x y z qx qy qz qw\n0.0 0 0 0 0 0 0 1\n0.1 1 0 0 0 0 0 0.999\n"


@pytest.mark.parametrize(
    ("text", "thing", "hint"),
    [
        (TUM + "0.2 1 2\n", "a.tum: line 4 = 0.2 1 2 (3 words)", "t x y z qx qy qz qw"),
        (TUM + "0.2 x 0 0 0 0 0 1\n", "a.tum: line 4", "finite"),
        (TUM + "0.2 nan 0 0 0 0 0 1\n", "a.tum: line 4", "finite"),
        (TUM + "0.1 0 0 0 0 0 0 1\n", "a.tum: row 3, column t = 0.1 s after 0.1 s", "increase"),
        ("# t x y z\n", "a.tum = 0 lines", "complete"),
    ],
)
def test_a_bad_line_of_a_trajectory_is_named(tmp_path, text, thing, hint):
    assert len(load_fleet(_file(tmp_path / "a.tum", TUM)).t) == 2
    _assert_refused(lambda: load_fleet(_file(tmp_path / "a.tum", text)), thing, hint)


def _file(path, text):
    path.write_text(text, errors="surrogateescape")
    return path


def _assert_refused(call, *parts):
    with pytest.raises(InputError) as error:
        call()
    for part in parts:
        assert part in str(error.value)


@pytest.mark.parametrize("word", ["1_0", "١", "１", "1e308", "nan"])
def test_a_number_is_one_as_c_writes_it(tmp_path, word):
    """Python's float takes underscores and the digits of any script; no other program does."""
    for name, text in (
        ("a.tum", f"0 {word} 0 0 0 0 0 1\n"),
        ("a.g2o", f"VERTEX_SE2 0 {word} 0 0\n"),
        ("a.pyfg", f"VERTEX_SE2 0.0 A0 {word} 0 0\n"),
    ):
        (tmp_path / name).write_text(text)
        with refused(rf"{name}: line 1 = .*all finite numbers"):
            (load_fleet if name == "a.tum" else load_graph)(tmp_path / name)
    (tmp_path / "a.g2o").write_text("VERTEX_SE2 ١ 0 0 0\n")
    with refused(r"a\.g2o: line 1"):
        load_graph(tmp_path / "a.g2o")


@pytest.mark.parametrize("share", [-1e-3, -1e-6, 1e-3])
def test_a_covariance_with_a_small_negative_eigenvalue_is_refused(tmp_path, share):
    """Rounding is 1e-9 of the largest eigenvalue; what is a thousand times more was written so."""
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    covariance = turn @ np.diag([1.0, 0.5, share]) @ turn.T
    upper = " ".join(map(repr, covariance[np.triu_indices(3)].tolist()))
    (tmp_path / "a.pyfg").write_text(
        f"VERTEX_SE2 0.0 A0 0 0 0\nVERTEX_SE2 1.0 A1 1 0 0\nEDGE_SE2 1.0 A0 A1 1 0 0 {upper}\n"
    )
    if share > 0:
        np.testing.assert_allclose(load_graph(tmp_path / "a.pyfg").relative_pose.covariance[0], covariance, atol=1e-15)
    else:
        with refused(r"a\.pyfg: line 3"):
            load_graph(tmp_path / "a.pyfg")
