"""Scores of foreign trajectories: evo's figures, its association, SciPy's align_vectors, and laws."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import measured, refused
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from coopoc.data.score_files import read_paths, score
from coopoc.evaluate.trajectory_scores import Path as Track
from coopoc.evaluate.trajectory_scores import (
    absolute_error,
    align,
    associated,
    relative_error,
    remarks,
    rms,
    rms_interval,
    scores,
)
from coopoc.formats.trajectories import read_kitti
from coopoc.formats.values import to_rotation

EVO = {(1, "steps"): (0.028120377, 4540), (10, "steps"): (0.194007758, 454), (100, "m"): (1.193975925, 36)}
"""evo 1.38.1, `metrics.RPE`, translation part, of KITTI 00 and ORB-SLAM: rmse m, and number of pairs."""


def test_aligned_error_is_evos() -> None:
    """evo's published APE of KITTI 00 and ORB-SLAM, translation part, SE(3) Umeyama alignment (data/README)."""
    folder = measured("KITTI_00_gt.txt").parent
    truth = read_kitti(folder / "KITTI_00_gt.txt", folder / "KITTI_00_gt_times.txt")
    estimate = read_kitti(folder / "KITTI_00_ORB.txt")
    found = absolute_error(estimate.position, truth.position)
    assert_allclose([rms(found), found.mean(), found.max()], [1.303450, 1.156997, 3.587949], atol=5e-7)


@pytest.mark.parametrize("d", [2, 3])
def test_alignment_is_scipys_and_undoes_a_known_motion(d: int) -> None:
    """Rotation.align_vectors solves the same problem for centred vectors; a known motion is found again."""
    rng = np.random.default_rng(d)
    truth = np.cumsum(rng.normal(size=(4, 30, d)), axis=1)
    estimate = truth + rng.normal(size=truth.shape)
    found = align(estimate, truth)
    for run in range(4):
        x, y = (np.pad(v[run] - v[run].mean(axis=0), ((0, 0), (0, 3 - d))) for v in (estimate, truth))
        wanted = Rotation.align_vectors(y, x)[0].as_matrix()[:d, :d]
        assert_allclose(found.rotation[run], wanted, atol=1e-12)
    turn = to_rotation(np.array([2.0]) if d == 2 else np.array([0.5, -0.1, 0.7, 0.5]))
    moved = 3.0 * truth @ turn.T + np.arange(d)
    back = align(truth, moved, scale=True)
    assert_allclose(back.rotation, np.broadcast_to(turn, (4, d, d)), atol=1e-12)
    assert_allclose(back.scale, 3.0)
    assert_allclose(back.apply(truth), moved, atol=1e-11)
    before = rms(absolute_error(estimate, truth))
    assert_allclose(rms(absolute_error(estimate @ turn.T - 7, truth)), before, rtol=1e-12)
    assert (before < rms(np.linalg.norm(estimate - truth, axis=-1))).all()
    assert (rms(absolute_error(estimate, truth, scale=True)) <= before).all()


def test_a_mirrored_path_is_not_answered_by_a_reflection() -> None:
    x = np.random.default_rng(0).normal(size=(20, 3))
    found = align(x, x * [1, 1, -1])
    assert_allclose(np.linalg.det(found.rotation), 1)


def test_alignment_that_is_open_or_ill_formed_is_refused() -> None:
    line = np.outer(np.arange(9.0), [1, 2, 3])
    with refused(r"singular values.*straight drive"):
        align(line, line)
    assert absolute_error(line[:, :2] @ [[0, 1], [-1, 0]], line[:, :2]).max() < 1e-12
    with refused(r"singular values.*at least 1"):
        align(line[:, :2] * 0, line[:, :2])
    with refused(r"shapes \(9, 3\) and \(8, 3\)"):
        align(line, line[:-1])
    with refused(r"estimate\[0, 0\] = not finite"):
        align(line * np.nan, line)


@pytest.mark.parametrize(("delta", "unit"), EVO)
def test_relative_errors_are_evos(delta: float, unit: str) -> None:
    """Independent check: evo's rmse and pairs, measured with evo 1.38.1."""
    truth, estimate = (read_kitti(measured(f"KITTI_00_{name}.txt")) for name in ("gt", "ORB"))
    paths = (Track(np.arange(len(of)), of.position, of.rotation) for of in (estimate, truth))
    error = relative_error(*paths, delta, unit)[0]  # type: ignore[arg-type]
    rmse, pairs = EVO[delta, unit]
    assert len(error) == pairs
    assert rms(error) == pytest.approx(rmse, rel=1e-6)


def test_stamps_are_paired_as_evo_pairs_them() -> None:
    """Independent check: indices of evo 1.38.1, `sync.associate_trajectories` with max_diff 0.05 s."""
    rng = np.random.default_rng(0)
    a, b = np.sort(rng.uniform(0, 10, 50)), np.sort(rng.uniform(0, 10, 80))
    i = [1, 2, 4, 6, 9, 10, 11, 14, 19, 21, 22, 23, 27, 28, 32, 35, 36, 37, 42, 43, 44, 46, 47, 48, 49]
    j = [1, 2, 3, 11, 16, 22, 24, 25, 30, 40, 41, 41, 44, 45, 47, 49, 50, 50, 61, 64, 64, 70, 70, 78, 79]
    assert [found.tolist() for found in associated(a, b, 0.05)] == [i, j]
    assert [found.tolist() for found in associated(b, a, 0.05)] == [j, i]
    assert [found.tolist() for found in associated(a - 3.0, b, 0.05, offset=3.0)] == [i, j]
    with refused(r"must agree within 0\.01 s somewhere"):
        associated(a, b + 100.0)
    with refused("no stamps"):
        associated(a, np.zeros(0))


def team(seed: int = 0, std: float = 0.3) -> tuple[dict[str, Track], dict[str, Track]]:
    """Two vehicles, estimated in a frame that is turned and moved, with the covariance that acts there."""
    rng, t = np.random.default_rng(seed), np.arange(400) / 10
    turn = Rotation.from_euler("z", 0.7).as_matrix()
    cov = np.diag([std, 2 * std, std]) ** 2
    truths, estimates = {}, {}
    for k, name in enumerate(("red", "blue")):
        at = np.column_stack([10 * t, 5 * np.sin(t / 5) + 8 * k, 0.1 * np.cos(t)])
        error = rng.multivariate_normal(np.zeros(3), cov, len(t))
        truths[name] = Track(t, at)
        estimates[name] = Track(
            t, (at + error) @ turn.T + [5, -3, 1], None, np.tile(turn @ cov @ turn.T, (len(t), 1, 1))
        )
    return estimates, truths


def test_a_team_is_moved_as_one_and_its_covariances_with_it() -> None:
    estimates, truths = team()
    for row in scores(estimates, truths, aligned="team"):
        assert row.ape_m.mean == pytest.approx(0.3 * np.sqrt(6), rel=0.05)
        assert row.ape_m.low < 0.3 * np.sqrt(6) < row.ape_m.high
        assert row.nees == pytest.approx(3.0, rel=0.1)
        assert row.rt_le_m.mean > 100
    swapped = {"red": estimates["blue"], "blue": estimates["red"]}
    apart, together = (scores(swapped, truths, aligned=how) for how in ("each", "team"))  # type: ignore[arg-type]
    assert max(row.ape_m.mean for row in apart) < 1.0 < 6.0 < min(row.ape_m.mean for row in together)


def test_intervals_over_blocks_hold_the_rms_of_correlated_errors() -> None:
    """Errors with a correlation time of a second in a drive of 200 s: 95 % intervals hold in most of 100 drives."""
    rng, held = np.random.default_rng(1), 0
    for _ in range(100):
        error, white = np.zeros(2000), rng.normal(size=2000)
        for k in range(1, 2000):
            error[k] = 0.9 * error[k - 1] + np.sqrt(1 - 0.81) * white[k]
        interval = rms_interval(error)
        held += interval.low <= 1.0 <= interval.high
    assert held >= 85


def test_the_command_gives_evos_figures_from_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """evo's published APE of KITTI 00, aligned, read from KITTI files and from the same poses as TUM and as CSV."""
    folder = measured("KITTI_00_gt.txt").parent
    times = folder / "KITTI_00_gt_times.txt"
    truth = (f"{folder / 'KITTI_00_gt.txt'}?times={times}",)
    poses = read_kitti(folder / "KITTI_00_ORB.txt", times)
    table = np.column_stack([poses.stamps, poses.position, Rotation.from_matrix(poses.rotation).as_quat()])
    np.savetxt(tmp_path / "orb.tum", table, fmt="%.17g")
    frame = pd.DataFrame(poses.position, columns=["x", "y", "z"]).assign(zeit=poses.stamps)
    frame.to_csv(tmp_path / "orb.csv", index=False)
    names = (
        f"{folder / 'KITTI_00_ORB.txt'}?times={times}",
        tmp_path / "orb.tum",
        f"{tmp_path / 'orb.csv'}?columns=t:zeit",
    )
    for name in names:
        assert score((str(name),), truth, "each", output=tmp_path / "scores.json") == 0
        (row,) = json.loads((tmp_path / "scores.json").read_text())
        assert row["ape_m"]["mean"] == pytest.approx(1.303450, abs=5e-6)
        assert row["ape_max_m"] == pytest.approx(3.587949, abs=5e-6)
        assert (row["rpe_m"] is None) == (str(name).endswith("zeit"))
    assert "APE [m]" in capsys.readouterr().out


def test_estimates_share_a_truth_and_rotations_are_scored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """SciPy's angles; a monocular estimate of half the size is the whole one under sim3."""
    folder = measured("KITTI_00_gt.txt").parent
    times = folder / "KITTI_00_gt_times.txt"
    truth, poses = (read_kitti(folder / f"KITTI_00_{name}.txt", times) for name in ("gt", "ORB"))
    for name, factor in (("whole", 1.0), ("half", 0.5)):
        assert poses.stamps is not None
        table = [poses.stamps, factor * poses.position, Rotation.from_matrix(poses.rotation).as_quat()]
        np.savetxt(tmp_path / f"{name}.txt", np.column_stack(table), fmt="%.17g")
    named = [str(tmp_path / f"{name}.txt") for name in ("whole", "half")]
    path, out = tmp_path / "a.png", tmp_path / "s.json"
    assert score(tuple(named), (f"{folder / 'KITTI_00_gt.txt'}?times={times}",), "sim3", plot=path, output=out) == 0
    rows = json.loads(out.read_text())
    assert [row["vehicle"] for row in rows] == ["whole", "half"]
    assert rows[0]["ape_m"] == pytest.approx(rows[1]["ape_m"], rel=1e-6)
    assert path.stat().st_size > 10_000
    at, turn = align(poses.position, truth.position).rotation, Rotation.from_matrix
    gaps = (turn(at @ poses.rotation).inv() * turn(truth.rotation)).magnitude()
    assert rows[0]["ape_deg"] == pytest.approx(np.degrees(np.sqrt(np.mean(gaps**2))), rel=1e-6)
    steps = [turn(path.rotation[:-1]).inv() * turn(path.rotation[1:]) for path in (poses, truth)]
    gaps = (steps[0].inv() * steps[1]).magnitude()
    assert rows[0]["rpe_deg"] == pytest.approx(np.degrees(np.sqrt(np.mean(gaps**2))), rel=1e-6)
    two, one = team()[0], {"red": team()[1]["red"]}
    with refused("'blue': has no truth among red"):
        scores(two, one)


def test_tables_hold_vehicles_and_covariances(tmp_path: Path) -> None:
    estimates, truths = team()
    parts = []
    for name, track in estimates.items():
        assert track.covariance is not None
        frame = pd.DataFrame(track.position, columns=["x", "y", "z"]).assign(id=name, t=track.t)
        for k, column in enumerate(("cxx", "cxy", "cxz", "cyy", "cyz", "czz")):
            i, j = np.triu_indices(3)
            frame[column] = track.covariance[:, i[k], j[k]]
        parts.append(frame)
    pd.concat(parts).sample(frac=1, random_state=0).to_parquet(tmp_path / "team.parquet")
    read = read_paths(str(tmp_path / "team.parquet"))
    assert set(read) == {"red", "blue"}
    wanted, found = (scores(each, truths, aligned="team") for each in (estimates, read))
    assert {row.vehicle: row.nees for row in found} == pytest.approx({row.vehicle: row.nees for row in wanted})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,x\n0,1\n", r"a\.csv: column y = missing: columns t, x, y are needed; the file has t, x"),
        ("t,x,y\n0,1,2\n0,3,4\n", r"a\.csv: row 2 = 0.0 s: is there twice for a"),
        ("t,x,y\n0,1,two\n", r"row 1, column y"),
    ],
)
def test_a_bad_table_is_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with refused(message):
        read_paths(str(tmp_path / "a.csv"))


def test_what_cannot_be_scored_is_named(tmp_path: Path) -> None:
    estimates, truths = team()
    with refused(r"vehicle = 'green': has no truth among red, blue"):
        scores({"green": estimates["red"]}, truths)
    with refused("must be at least one"):
        scores({}, truths)
    with refused("must be a file"):
        read_paths(str(tmp_path / "nowhere.tum"))
    with refused("must name a file"):
        score(("a.tum",))
    for delta in (0.5, 1.5, float("nan")):
        with refused("delta"):
            scores(estimates, truths, delta=delta)
    with refused("rotation = None"):
        relative_error(wandering(), Track(wandering().t, wandering().position))


def wandering(count: int = 200) -> Track:
    t = np.arange(count) / 10
    return Track(t, np.column_stack([3 * t, 5 * np.sin(t / 3), np.cos(t)]), np.tile(np.eye(3), (count, 1, 1)))


def test_signs_of_another_unit_or_clock_are_said() -> None:
    """Stamps in ms, stamps 3 ms apart at 10 Hz, centimetres, feet, a monocular scale; and nothing where all is well."""
    truth, one = wandering(), wandering(1)
    noise = np.random.default_rng(3).normal(0, 0.1, (200, 3))
    good = Track(truth.t, truth.position + noise, truth.rotation)
    (row,) = scores({"a": good}, {"a": truth})
    assert row.remarks == ()
    (row,) = scores({"a": Track(truth.t * 1000, good.position, good.rotation)}, {"a": truth})
    assert row.poses == 1
    assert row.rpe_m is None
    assert "1 of 200 stamps meet" in row.remarks[0]
    assert row.remarks[0].endswith("the estimate looks like ms.")
    assert remarks(truth.t, Track(1000 * truth.t, truth.position), (one,) * 3, 0.01)[0].endswith(
        "the truth looks like ms."
    )
    assert row.remarks[1] == "no relative error: the drive is shorter than 1 steps."
    dense = Track(np.arange(0, 20, 0.001), np.repeat(truth.position, 100, axis=0))
    (row,) = scores({"a": dense}, {"a": truth})
    assert row.missed == 19800
    assert row.remarks == ()


def test_what_explains_an_error_far_better_is_said() -> None:
    """A clock, leap seconds, quaternions of w first, axes mirrored or swapped, which an alignment hides where all is
    flat, another frame; nothing where errors are what they are."""
    made, turn = wandering(600), Rotation.from_euler("z", np.arange(600)[:, None] / 50)
    first = Rotation.from_quat(np.roll(turn.as_quat(), 1, axis=1)).as_matrix()
    truth, x, flat = Track(made.t, made.position, turn.as_matrix()), made.position, made.position * [1, 1, 0]
    axes = "with an axis mirrored, or two swapped, its aligned"
    for text, late, position, rotation, aligned in (
        (None, 0.0, x + np.sin(x), turn.as_matrix(), "none"),
        ("with -0.402 s on its stamps (offset), its", 0.4, x, None, "none"),
        ("with +18 s on its stamps (offset), its", -18.0, x, None, "none"),
        ("read with w first, its rotation", 0.0, x, first, "each"),
        (axes, 0.0, flat * [1, -1, 1], None, "each"),
        (axes, 0.0, x[:, [1, 0, 2]], None, "none"),
        ("times 0.01, its aligned", 0.0, 100 * x, None, "each"),
        ("aligned by itself (align), its", 0.0, x @ turn[60].as_matrix(), None, "none"),
    ):
        (row,) = scores({"a": Track(truth.t + late, position, rotation)}, {"a": truth}, aligned=aligned)  # type: ignore[arg-type]
        assert [remark.partition(" error falls")[0] for remark in row.remarks] == [text] * (text is not None), text


def test_a_clock_of_its_own_is_mended_by_an_offset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = wandering()
    late = Track(truth.t + 1000.5, truth.position + np.array([0.3, 0.4, 0.0]))
    with refused(r"0\.0\.\.19\.9 s.*offset"):
        scores({"a": late}, {"a": truth})
    (row,) = scores({"a": late}, {"a": truth}, offset=-1000.5)
    assert row.poses == 200
    assert row.rt_le_m.mean == pytest.approx(0.5)
    for name, path in (("late", late), ("truth", truth)):
        pd.DataFrame(path.position, columns=["x", "y", "z"]).assign(t=path.t).to_csv(tmp_path / f"{name}.csv")
    files = (str(tmp_path / "late.csv"),), (str(tmp_path / "truth.csv"),)
    assert score(*files, max_diff=0.04, offset=-1020.4, output=tmp_path / "one.json") == 0
    shown = capsys.readouterr()
    assert "1 of 200 stamps meet" in shown.err
    assert "nan" not in shown.out
    (kept,) = json.loads((tmp_path / "one.json").read_text(), parse_constant=pytest.fail)
    assert kept["ape_m"]["low"] is None
