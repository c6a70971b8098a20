"""PyFG and g2o files: what comes back, and what CORA's matrices, GTSAM and SciPy say of it."""

import time
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from conftest import DIMENSIONS, measured
from graph_files import write_graph
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scipy.io import mmread
from scipy.spatial.transform import Rotation

from coopoc.formats import load_graph
from coopoc.formats.graph import ENDS, Graph, PointEdges, PoseEdges, RangeEdges
from coopoc.formats.values import to_orientation, to_rotation


def assert_same(a, b, rtol=0):
    """Every field of two graphs is equal, NaN to NaN; covariances to rtol."""
    for field in fields(a):
        one, two = getattr(a, field.name), getattr(b, field.name)
        if is_dataclass(one):
            assert_same(one, two, rtol)
        elif not isinstance(one, np.ndarray):
            assert one == two, field.name
        elif rtol and field.name in ("covariance", "variance"):
            scale = abs(one).max(axis=tuple(range(1, one.ndim)), keepdims=True) if one.size else 0
            assert (abs(one - two) <= rtol * scale).all(), field.name
        else:
            assert_array_equal(one, two, err_msg=field.name)


def random_graph(dimension, seed):
    """All kinds of edges with full covariances, axes in m and rad scaled apart."""
    names = ("A0", "L5", "A1", "B0", "L7", "B1")
    rng = default_rng(seed)
    size, turn = (3, 1) if dimension == 2 else (6, 4)
    is_pose = np.array([name[0] != "L" for name in names])
    poses, points = np.flatnonzero(is_pose), np.flatnonzero(~is_pose)

    def turns(count):
        if dimension == 2:
            return rng.uniform(-7, 7, (count, 1))
        q = rng.normal(size=(count, 4))
        return q / norm(q, axis=1, keepdims=True)

    def cov(count, rows):
        root = rng.normal(size=(count, rows, 2 * rows)) * np.logspace(0, -2, rows)[:, None]
        return root @ root.mT

    orientation = turns(len(names))
    orientation[points] = np.eye(turn)[-1] if dimension == 3 else 0
    pairs = np.array([[poses[0], poses[1]], [poses[2], poses[3]], [poses[1], poses[3]]])
    seen = np.array([[poses[0], points[0]], [poses[2], points[1]]])
    ranges = np.array([[poses[0], poses[2]], [poses[1], points[0]], [points[0], points[1]]])
    return Graph(
        dimension,
        names,
        is_pose,
        rng.normal(size=(len(names), dimension)) * 100,
        orientation,
        relative_pose=PoseEdges(pairs, rng.normal(size=(3, dimension)), turns(3), cov(3, size)),
        relative_point=PointEdges(seen, rng.normal(size=(2, dimension)), cov(2, dimension)),
        ranges=RangeEdges(ranges, rng.uniform(0, 9, 3), rng.uniform(0.01, 1, 3)),
        pose_prior=PoseEdges(poses[:2, None], rng.normal(size=(2, dimension)), turns(2), cov(2, size)),
        point_prior=PointEdges(points[:1, None], rng.normal(size=(1, dimension)), cov(1, dimension)),
        fixed=[points[0], poses[0]],
    )


def written(graph, path):
    write_graph(graph, path)
    return load_graph(path)


COUNTS = {  # poses, points, relative poses, relative points, ranges, robots: by awk from the files
    "factor_graph_small": (6, 1, 5, 0, 5, "A"),
    "mrclam5a": (1080, 15, 1075, 1127, 316, "ABCDE"),
    "mrclam6": (11274, 15, 11269, 13121, 3537, "ABCDE"),
    "plaza1": (9658, 4, 9657, 0, 3326, "A"),
    "tiers": (9768, 1, 9764, 0, 7789, "ABCD"),
    "cora_unit/single_range/factor_graph": (0, 2, 0, 0, 1, ""),
    "cora_unit/single_rpm/factor_graph": (2, 0, 1, 0, 0, "A"),
    "cora_unit/small_ra_slam_problem/factor_graph": (6, 1, 5, 0, 5, "A"),
}


@pytest.mark.parametrize("name", COUNTS)
def test_real_pyfg_files_read_whole_and_come_back_bit_by_bit(tmp_path, name):
    start = time.process_time()
    graph = load_graph(measured(f"{name}.pyfg"))
    assert time.process_time() - start < 2
    edges = (len(graph.relative_pose), len(graph.relative_point), len(graph.ranges))
    assert (graph.is_pose.sum(), (~graph.is_pose).sum(), *edges, "".join(graph.robots)) == COUNTS[name]
    assert_same(written(graph, tmp_path / "again.pyfg"), graph)


def test_pyfg_numbers_are_what_cora_made_of_them():
    """CORA's expected matrices: rows of X_gt are R_i^T, then bearings of ranges, then positions."""
    folder = measured("cora_unit/small_ra_slam_problem")
    graph = load_graph(folder / "factor_graph.pyfg")
    x = mmread(folder / "X_gt.mm").toarray()
    assert_allclose(graph.rotation[:6].mT.reshape(12, 2), x[:12], atol=1e-15)
    assert_array_equal(graph.position, x[17:])
    assert_array_equal(graph.ranges.distance, mmread(folder / "RangeDistances.mm").diagonal())
    assert_array_equal(1 / graph.ranges.variance, mmread(folder / "OmegaRange.mm").diagonal())
    tau = 2 / np.trace(graph.relative_pose.covariance[:, :2, :2], axis1=1, axis2=2)
    assert_array_equal(tau, mmread(folder / "OmegaPose.mm").diagonal())


def test_relative_poses_and_points_are_in_the_frame_of_the_first():
    """MR.CLAM against its own Vicon truth: R_i^T (p_j - p_i) is what was measured, to the noise that it claims."""
    graph = load_graph(measured("mrclam6.pyfg"))
    for edges, bound in ((graph.relative_pose, 0.02), (graph.relative_point, 0.2)):
        i, j = edges.nodes.T
        seen = np.einsum("mji,mj->mi", graph.rotation[i], graph.position[j] - graph.position[i])
        assert np.median(norm(seen - edges.position, axis=1)) < bound
    i, j = graph.relative_pose.nodes.T
    turned = graph.rotation[i].mT @ graph.rotation[j]
    assert np.median(norm(turned - graph.relative_pose.rotation, axis=(1, 2))) < 0.02
    i, j = graph.ranges.nodes.T
    assert np.median(abs(norm(graph.position[i] - graph.position[j], axis=1) - graph.ranges.distance)) < 0.15


@DIMENSIONS
@pytest.mark.parametrize("seed", range(5))
def test_every_pyfg_record_comes_back_bit_by_bit(tmp_path, dimension, seed):
    graph, rng = replace(random_graph(dimension, seed), fixed=()), default_rng(seed)
    timed = {kind: replace(e := getattr(graph, kind), stamps=rng.uniform(0, 2e9, len(e))) for kind in ENDS}
    graph = replace(graph, stamps=np.where(graph.is_pose, rng.uniform(0, 2e9, 6), np.nan), **timed)
    assert_same(written(graph, tmp_path / "a.pyfg"), graph)


@DIMENSIONS
@pytest.mark.parametrize("names", ["A0 L5 A1 B0 L7 B1", "A0 L0 A1 A2 L1 A4", "x0 L5 x1 x2 m7 L6"])
def test_every_g2o_record_comes_back_to_rounding(tmp_path, dimension, names):
    graph = replace(random_graph(dimension, seed=1), names=tuple(names.split()), guess=True)
    assert_same(written(graph, tmp_path / "a.g2o"), graph, rtol=1e-12)


def _matrices(position, rotation):
    out = np.tile(np.eye(position.shape[1] + 1), (len(position), 1, 1))
    out[:, :-1, :-1], out[:, :-1, -1] = rotation, position
    return out


def _assert_gtsam_agrees(graph, factors, values, keys, atol=1e-12):
    """Poses, measured poses and covariances; GTSAM orders 3-D covariances rotation first."""
    order = [0, 1, 2] if graph.dimension == 2 else [3, 4, 5, 0, 1, 2]
    at = values.atPose2 if graph.dimension == 2 else values.atPose3
    poses = [at(keys[name]).matrix() for name in np.array(graph.names)[graph.is_pose]]
    assert_allclose(poses, _matrices(graph.position, graph.rotation)[graph.is_pose], atol=atol)
    edges = graph.relative_pose
    found = [factors.at(k) for k in range(factors.size()) if "Between" in type(factors.at(k)).__name__]
    assert [f.keys() for f in found] == [[keys[graph.names[n]] for n in nodes] for nodes in edges.nodes]
    assert_allclose(
        np.array([f.measured().matrix() for f in found]), _matrices(edges.position, edges.rotation), atol=atol
    )
    cov = np.array([f.noiseModel().covariance() for f in found])
    scale = abs(edges.covariance).max(axis=(1, 2), keepdims=True)
    assert_allclose(cov / scale, edges.covariance[:, order][:, :, order] / scale, atol=max(atol, 1e-10))


@DIMENSIONS
def test_we_read_what_gtsam_writes(tmp_path, dimension):
    gtsam = pytest.importorskip("gtsam")
    rng = default_rng(dimension)
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    pose, between, size = (
        (gtsam.Pose2, gtsam.BetweenFactorPose2, 3) if dimension == 2 else (gtsam.Pose3, gtsam.BetweenFactorPose3, 6)
    )
    for key in range(4):
        values.insert(key, pose.Expmap(rng.normal(size=size)))
    for i, j in ((0, 1), (1, 2), (2, 3), (3, 1)):
        root = rng.normal(size=(size, 2 * size))
        factors.add(
            between(i, j, pose.Expmap(rng.normal(size=size)), gtsam.noiseModel.Gaussian.Covariance(root @ root.T))
        )
    gtsam.writeG2o(factors, values, str(tmp_path / "a.g2o"))
    graph = load_graph(tmp_path / "a.g2o")
    assert graph.names == ("A0", "A1", "A2", "A3")
    _assert_gtsam_agrees(graph, factors, values, {f"A{k}": k for k in range(4)}, atol=2e-5)  # it writes 6 to 12 digits


def test_gtsams_own_landmark_graph_reads_as_gtsam_reads_it():
    """Poses and points share ids there, and offsets are given."""
    gtsam = pytest.importorskip("gtsam")
    path = Path(gtsam.__file__).parent / "Data/known_landmark_localization_20.g2o"
    if not path.is_file():
        pytest.skip("this GTSAM does not ship the file")
    graph = load_graph(path)
    factors, values = gtsam.readG2o(str(path), True)
    _assert_gtsam_agrees(graph, factors, values, {f"A{k}": k for k in range(20)}, atol=1e-5)  # six-digit quaternions
    seen = [factors.at(k) for k in range(factors.size()) if "BearingRange" in type(factors.at(k)).__name__]
    assert len(seen) == len(graph.relative_point) == 80
    assert_allclose(norm(graph.relative_point.position, axis=1), [f.measured().range() for f in seen], atol=1e-12)


def test_a_graph_cannot_be_changed_and_lists_its_robots():
    graph = random_graph(2, seed=0)
    assert {robot: own.tolist() for robot, own in graph.robots.items()} == {"A": [0, 2], "B": [3, 5]}
    for array in (graph.position, graph.ranges.distance, graph.relative_pose.covariance):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_rotations_are_scipys():
    q = default_rng(0).normal(size=(500, 4))
    q[:8] = [*np.eye(4), [0, 0, 0, -1], [1, 1, 0, 0], [0, 1, 1, 0], [1, 0, 0, 1e-9]]
    turned = Rotation.from_quat(q)
    assert_allclose(to_rotation(q), turned.as_matrix(), atol=1e-14)
    assert_allclose(Rotation.from_quat(to_orientation(turned.as_matrix())).as_matrix(), turned.as_matrix(), atol=1e-14)
    assert (to_orientation(turned.as_matrix())[:, 3] >= 0).all()
    theta = np.linspace(-3.1, 3.1, 50)[:, None]
    assert_allclose(to_orientation(to_rotation(theta)), theta, atol=1e-15)
