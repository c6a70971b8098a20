"""Alignment of trajectories: evo's published figures, SciPy's align_vectors, and what has no single answer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopoc.errors import InputError
from coopoc.evaluate.alignment import absolute_error, align
from coopoc.formats.trajectories import read_kitti
from coopoc.formats.values import to_rotation


def test_aligned_error_is_evos(shared: Path) -> None:
    """evo's published APE of KITTI 00 and ORB-SLAM, translation part, SE(3) Umeyama alignment (data/README)."""
    folder = shared / "evo_oracle"
    truth = read_kitti(folder / "KITTI_00_gt.txt", folder / "KITTI_00_gt_times.txt")
    estimate = read_kitti(folder / "KITTI_00_ORB.txt")
    found = absolute_error(estimate.position, truth.position)
    np.testing.assert_allclose([found.rmse, found.mean, found.max], [1.303450, 1.156997, 3.587949], atol=5e-7)


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
        np.testing.assert_allclose(found.rotation[run], wanted, atol=1e-12)
    turn = to_rotation(np.array([2.0]) if d == 2 else np.array([0.5, -0.1, 0.7, 0.5]))
    moved = 3.0 * truth @ turn.T + np.arange(d)
    back = align(truth, moved, scale=True)
    np.testing.assert_allclose(back.rotation, np.broadcast_to(turn, (4, d, d)), atol=1e-12)
    np.testing.assert_allclose(back.scale, 3.0)
    np.testing.assert_allclose(back.apply(truth), moved, atol=1e-11)
    before = absolute_error(estimate, truth).rmse
    np.testing.assert_allclose(absolute_error(estimate @ turn.T - 7, truth).rmse, before, rtol=1e-12)
    assert (before < absolute_error(estimate, truth, aligned=False).rmse).all()
    assert (absolute_error(estimate, truth, scale=True).rmse <= before).all()


def test_a_mirrored_path_is_not_answered_by_a_reflection() -> None:
    x = np.random.default_rng(0).normal(size=(20, 3))
    found = align(x, x * [1, 1, -1])
    np.testing.assert_allclose(np.linalg.det(found.rotation), 1)


def test_alignment_that_is_open_or_ill_formed_is_refused() -> None:
    line = np.outer(np.arange(9.0), [1, 2, 3])
    with pytest.raises(InputError, match=r"singular values.*straight drive"):
        align(line, line)
    assert absolute_error(line[:, :2] @ [[0, 1], [-1, 0]], line[:, :2]).max < 1e-12
    with pytest.raises(InputError, match=r"singular values.*at least 1"):
        align(line[:, :2] * 0, line[:, :2])
    with pytest.raises(InputError, match=r"shapes \(9, 3\) and \(8, 3\)"):
        align(line, line[:-1])
    with pytest.raises(InputError, match=r"estimate\[0, 0\] = not finite"):
        align(line * np.nan, line)
    with pytest.raises(InputError, match=r"scale = True.*aligned=True"):
        absolute_error(line, line, aligned=False, scale=True)
