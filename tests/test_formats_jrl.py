"""JRL files: one written from the format's documentation, GTSAM as referee of its covariances, errors."""

import json
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from conftest import refused

from coopoc.formats import load_graph
from coopoc.formats.jrl import read_jrl
from coopoc.optimize.graph_problems import from_graph

A, B, MARK = 97 << 56, 98 << 56, (97 << 56) + 1_000_000_000
UNIT2, UNIT6 = np.eye(3).ravel().tolist(), np.eye(6).ravel().tolist()


def documented() -> dict[str, Any]:
    """Two robots in the plane, as DATASET_FORMAT.md, MEASUREMENT_FORMAT.md and VALUE_FORMAT.md describe them."""
    pose = {"type": "Pose2", "x": 1.0, "y": 0.5, "theta": 0.25}
    return {
        "name": "documented",
        "robots": ["a", "b"],
        "measurements": {
            "a": [
                {
                    "stamp": 0,
                    "measurements": [{"type": "PriorFactorPose2", "key": A, "prior": pose, "covariance": UNIT2}],
                },
                {
                    "stamp": 10,
                    "measurements": [
                        {
                            "type": "BetweenFactorPose2",
                            "key1": A,
                            "key2": A + 1,
                            "measurement": pose,
                            "covariance": [4.0, 1.0, 0.0, 1.0, 9.0, 0.0, 0.0, 0.0, 0.25],
                        },
                        {"type": "RangeFactor2D", "key1": A + 1, "key2": MARK, "measurement": 3, "covariance": [0.5]},
                    ],
                },
            ],
            "b": [
                {
                    "stamp": 7,
                    "measurements": [
                        {
                            "type": "RangeFactorPose2",
                            "key1": B,
                            "key2": A + 1,
                            "measurement": {"type": "Scalar", "value": 2.5},
                            "covariance": [0.01],
                        }
                    ],
                }
            ],
        },
        "groundtruth": {"a": {str(A): pose, str(MARK): {"type": "Point2", "x": 3.0, "y": 4.0}}, "b": {}},
        "initialization": {"a": [{**pose, "x": 9.0, "key": A}, {**pose, "x": 8.0, "key": A + 1}], "b": None},
        "potential_outlier_factors": [[1, 1]],
    }


def written(folder: Path, log: Any) -> Path:
    path = folder / "log.jrl"
    path.write_text(json.dumps(log))
    return path


def test_a_file_after_the_documentation(tmp_path: Path) -> None:
    graph = load_graph(written(tmp_path, documented()))
    assert graph.names == ("a0", "a1", "a1000000000", "b0")
    assert graph.is_pose.tolist() == [True, True, False, True]
    assert graph.stamps.tolist()[:2] == [0.0, 10.0]
    assert (graph.stamps[3], np.isnan(graph.stamps[2])) == (7.0, True)
    assert graph.position[:3].tolist() == [[1.0, 0.5], [8.0, 0.5], [3.0, 4.0]]  # the truth first, then the guess
    assert np.isnan(graph.position[3]).all()
    assert graph.relative_pose.covariance[0].tolist() == [[4, 1, 0], [1, 9, 0], [0, 0, 0.25]]
    assert graph.ranges.distance.tolist() == [3.0, 2.5]
    assert graph.ranges.nodes.tolist() == [[1, 2], [3, 1]]
    assert read_jrl(written(tmp_path, documented()), unit=1e-9).ranges.stamps == pytest.approx([1e-8, 7e-9])


def test_covariances_and_quaternions_are_gtsams(tmp_path: Path) -> None:
    """The cost of a graph in space, read from GTSAM's numbers, against that of GTSAM's own factors; to first order,
    since GTSAM's logarithm of a pose bends its position, too."""
    rng = np.random.default_rng(0)
    between = gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), rng.normal(size=3))
    at = [between.retract(1e-5 * rng.normal(size=6)), between.compose(between).retract(1e-5 * rng.normal(size=6))]
    root = rng.normal(size=(6, 6))
    covariance = root @ root.T + np.eye(6)
    model = gtsam.noiseModel.Gaussian.Covariance(covariance)
    values = gtsam.Values()
    for k, pose in enumerate(at):
        values.insert(A + k, pose)

    def value(pose: gtsam.Pose3) -> dict[str, Any]:
        q = pose.rotation().toQuaternion()
        return {
            "type": "Pose3",
            "translation": pose.translation().tolist(),
            "rotation": [q.w(), q.x(), q.y(), q.z()],
        }

    measured = [
        {"type": "PriorFactorPose3", "key": A, "prior": value(between), "covariance": covariance.ravel().tolist()},
        {
            "type": "BetweenFactorPose3",
            "key1": A,
            "key2": A + 1,
            "measurement": value(between),
            "covariance": covariance.ravel().tolist(),
        },
    ]
    guess = [{**value(pose), "key": A + k} for k, pose in enumerate(at)]
    log = {"measurements": {"a": [{"stamp": 1, "measurements": measured}]}, "initialization": {"a": guess}}
    problem = from_graph(read_jrl(written(tmp_path, log)), "geodesic", "file")
    expected = gtsam.BetweenFactorPose3(A, A + 1, between, model).error(values)
    expected += gtsam.PriorFactorPose3(A, between, model).error(values)
    assert problem.cost(problem.x0) == pytest.approx(expected, rel=1e-4)


def broken(*way: Any, value: Any = None) -> dict[str, Any]:
    """The documented log with another value at the end of a way, or none there."""
    log = documented()
    item: Any = log
    for step in way[:-1]:
        item = item[step]
    if value is None:
        del item[way[-1]]
    else:
        item[way[-1]] = value
    return log


ODOMETRY = ("measurements", "a", 1, "measurements", 0)
CASES = {
    "no measurements": (broken("measurements"), "must have 'measurements'"),
    "measurements as a list": (broken("measurements", value=[1]), "must be lists by robot"),
    "no stamp": (broken("measurements", "b", 0, "stamp"), "robot b, entry 0.*must have 'stamp'"),
    "a stamp in seconds": (broken("measurements", "b", 0, "stamp", value=0.5), "stamp 0.5: must be a whole number"),
    "an unknown type": (broken(*ODOMETRY, "type", value="BetweenFactorPose5"), "Did you mean BetweenFactorPose"),
    "bearings": (broken(*ODOMETRY, "type", value="BearingRangeFactor2D"), "entry 1, measurement 0.*must be one of"),
    "another dimension": (broken(*ODOMETRY[:4], 1, "type", value="RangeFactor3D"), "2-D at .* and 3-D at"),
    "no key": (broken(*ODOMETRY, "key2"), "must have 'key2'"),
    "a key without a letter": (broken(*ODOMETRY, "key2", value=7), "key 7: must be letter"),
    "a key that is text": (broken(*ODOMETRY, "key2", value="a1"), "key 'a1': must be letter"),
    "a short covariance": (broken(*ODOMETRY, "covariance", value=[1.0] * 6), "must be 9 finite numbers"),
    "an indefinite covariance": (broken(*ODOMETRY, "covariance", value=[-1.0, *UNIT2[1:]]), "measurement 0.*semi-def"),
    "a number that is not finite": (broken(*ODOMETRY, "measurement", "x", value=float("nan")), "must be 3 finite"),
    "a text for a number": (broken(*ODOMETRY, "measurement", "x", value="1"), "must be 3 finite numbers"),
    "an edge to itself": (broken(*ODOMETRY, "key2", value=A), "measurement 0 = a0 twice"),
    "no measurement": ({"measurements": {"a": []}}, "0 measurements: must be measurements of one dimension"),
    "a list": ([1], "must have 'measurements'"),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_is_named(tmp_path: Path, case: str) -> None:
    log, message = CASES[case]
    with refused(message):
        read_jrl(written(tmp_path, log))


def test_what_is_no_json_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.jrl").write_text("VERTEX_SE2 0 0 0 0")
    with refused("must be JSON"):
        read_jrl(tmp_path / "a.jrl")
    with refused("must be a file"):
        read_jrl(tmp_path / "b.jrl")


def test_a_value_of_another_kind_than_its_vertex_is_named(tmp_path: Path) -> None:
    given = documented()
    given["initialization"] = {"a": [{"type": "Point2", "key": A, "x": 1.0, "y": 2.0}]}
    given.pop("groundtruth", None)
    (tmp_path / "a.jrl").write_text(json.dumps(given))
    with refused(r"initialization of a, value 0 = type Point2: must be a pose"):
        read_jrl(tmp_path / "a.jrl")
