"""Tables and files that people take into their own notebook: `to_frame`, `write_tum`."""

import numpy as np
from conftest import refused
from numpy import zeros
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

import coopoc as co

rng = np.random.default_rng(5)
IDS = ("red", "green", "blue")


def track():
    shape = 2, 4, 2
    root = rng.normal(size=(*shape, 3, 3))
    heading = rng.uniform(-3, 3, shape)
    none = zeros((2, 2))
    return co.Track(
        t=np.arange(4) * 0.1,
        egos=(2, 0),
        x=rng.normal(size=(*shape, 3)),
        covariance=root @ root.mT,
        received_bytes=none,
        sent_bytes=none,
        seconds=0.0,
        heading=heading,
        heading_covariance=np.full((*shape, 4), 0.04),
        extras={"bias": rng.normal(size=shape)},
        ids=IDS,
    )


def test_a_track_as_a_table():
    made = track()
    frame = made.to_frame()
    wanted = "run step t ego x y z std_x std_y std_z heading std_heading bias"
    assert frame.columns.tolist() == wanted.split()
    assert len(frame) == 2 * 4 * 2
    for row in frame.itertuples():
        at = row.run, row.step, ["blue", "red"].index(row.ego)
        assert row.t == made.t[row.step]
        assert_array_equal([row.x, row.y, row.z], made.x[at])
        assert_allclose([row.std_x, row.std_y, row.std_z], np.sqrt(np.diag(made.covariance[at])))
        assert (row.heading, row.std_heading, row.bias) == (made.heading[at], 0.2, made.extras["bias"][at])


def test_a_table_gives_the_score():
    """Independent check: RT-LE by pandas alone, from the tables of a track and of its fleet."""
    fleet = co.load_fleet("town10").between(0, 60)
    made = co.Kalman()(co.observe(fleet, co.Sensors.paper_scenario2(), co.V2X(), runs=3), egos=[24, 7])
    both = made.to_frame().merge(fleet.to_frame(), left_on=["step", "ego"], right_on=["step", "vehicle"])
    gap = sum((both[f"{axis}_x"] - both[f"{axis}_y"]) ** 2 for axis in "xyz")
    score = np.sqrt(gap.groupby([both["run"], both["ego"]]).mean()).unstack()[[fleet.ids[24], fleet.ids[7]]]
    assert_allclose(score, co.rt_le(made, fleet))


def test_a_track_without_ids_names_columns_and_leaves_out_what_it_has_not():
    bare = co.Track([0.0], (3,), np.ones((1, 1, 1, 3)), None, [[0]], [[0]], 0.0).to_frame()
    assert bare.to_dict("records") == [{"run": 0, "step": 0, "t": 0.0, "ego": 3, "x": 1.0, "y": 1.0, "z": 1.0}]


def test_the_table_of_a_fleet_is_read_again_without_the_absent(tmp_path):
    position, velocity = rng.normal(size=(2, 5, 3, 3))
    position[:2, 1] = velocity[:2, 1] = np.nan
    frame = co.Fleet(IDS, np.arange(5) * 0.1, position, velocity, heading=rng.uniform(-3, 3, (5, 3))).to_frame()
    assert frame.columns.tolist() == ["step", "t", "vehicle", "x", "y", "z", "vx", "vy", "vz", "heading"]
    assert len(frame) == 13
    assert not frame.isna().any(axis=None)
    assert frame[frame.vehicle == "green"].step.tolist() == [2, 3, 4]
    frame.to_csv(tmp_path / "drive.csv")
    again = co.load_fleet(tmp_path / "drive.csv", format="table", columns={"id": "vehicle"})
    columns = [again.ids.index(name) for name in IDS]
    assert_allclose(again.position[:, columns], position)
    assert_allclose(again.velocity[:, columns], velocity)


def test_paths_as_other_programs_read_them(tmp_path):
    """Independent check: columns by NumPy, and angles of SciPy's rotations; evo's own reader where it is installed."""
    t, position, heading = 1.6e9 + np.arange(7) * 0.1, rng.normal(0, 1e4, (7, 3)), rng.uniform(-3, 3, 7)
    co.write_tum(tmp_path / "a.tum", t, position, heading)
    tum = np.loadtxt(tmp_path / "a.tum")
    assert_allclose(tum[:, :4], np.c_[t, position], rtol=0, atol=1e-6)
    assert_allclose(Rotation.from_quat(tum[:, 4:]).as_euler("zyx")[:, 0], heading, atol=1e-8)


def test_a_path_that_no_program_could_read_is_refused(tmp_path):
    gap = [[0.0, 0, 0], [np.nan, 0, 0]]
    for write, named in (
        (lambda: co.write_tum(tmp_path / "a", [0.0, 0.1], gap), r"position\[1"),
        (lambda: co.write_tum(tmp_path / "a", [0.1, 0.1], zeros((2, 3))), r"t\[1\] = 0.1"),
        (lambda: co.write_tum(tmp_path / "a", [0.0], zeros((2, 3))), "t = shape"),
        (lambda: co.write_tum(tmp_path / "a", [0.0, 0.1], zeros((2, 2))), "position"),
        (lambda: co.write_tum(tmp_path / "a", [0.0, 0.1], zeros((2, 3)), [0.0]), "heading"),
        (lambda: co.write_tum("", [0.0, 0.1], zeros((2, 3))), "path"),
        (lambda: co.write_tum(tmp_path, [0.0, 0.1], zeros((2, 3))), "must be a file, and is a folder"),
    ):
        with refused(named):
            write()
    assert not list(tmp_path.iterdir())
