"""Measurements: one formula for NumPy, torch and CasADi; the tapes' derivatives against torch's."""

import numpy as np
import pytest
import torch
from conftest import DIMENSIONS, refused
from numpy.random import default_rng
from scipy.linalg import logm
from scipy.spatial.transform import Rotation

from coopoc.optimize import MEASUREMENTS, Problem, measurement
from coopoc.optimize.model.space import Space, exp, pose

VECTORS = default_rng(0).normal(size=(50, 3)) * [20, 20, 5]


ROTATIONS = Rotation.random(50, random_state=1).as_matrix()
COUNT = 12


@DIMENSIONS
@pytest.mark.parametrize("kind", sorted(MEASUREMENTS))
def test_derivatives_equal_torchs(kind, dimension):
    """By the steps (dp, w) of the nodes, R Exp(w), far from the measured values, near them and at them."""
    known, space, d = MEASUREMENTS[kind], Space(dimension, has_rotation=True), dimension
    if d == 2 and known.plane is None:
        pytest.skip(f"{kind} does not exist in the plane")
    rng = default_rng(3)
    x = pose(rng.normal(size=(3, COUNT, d)) * 15.0, rng.normal(size=(3, COUNT) if d == 2 else (3, COUNT, 3)))
    if kind.startswith("relative_pose"):
        near = space.rotation(x[0, 4:]) @ exp(
            np.full((COUNT - 4, space.angles), 1e-3) * (np.arange(4, COUNT) < 8)[:, None]
        )
        x[1, 4:] = space.join(x[1, 4:, :d], near)
    z = np.ones((COUNT, known.size(d)))
    if known.compares_poses:
        z = pose(np.ones((COUNT, d)), np.zeros((COUNT,) if d == 2 else (COUNT, 3)))
        z[:4] = x[1, 4:8]
    nodes = np.arange(3 * COUNT).reshape(3, COUNT).T[:, : known.arity]
    constants = np.full((COUNT, known.constants), 0.1)
    problem = Problem(tuple(map(str, range(3 * COUNT))), dimension=d, poses=tuple(range(3 * COUNT)))
    problem = problem.add(kind, nodes, z, std=1.0, constants=constants if known.constants else None)
    linear = problem.linearise(x := x.reshape(3 * COUNT, -1))
    (ours,) = linear.jacobian
    for k in range(COUNT):
        given = [torch.tensor(a) for a in (x[nodes[k]], z[k], constants[k])]
        steps = torch.zeros((known.arity, space.dof), dtype=torch.float64)
        theirs = torch.autograd.functional.jacobian(lambda s, own=given: by_torch(known, d, *own, s), steps)
        assert ours[k] == pytest.approx(theirs.numpy().reshape(ours[k].shape), abs=1e-9)
        gap = by_torch(known, d, *given, steps).numpy()
        assert np.exp(1j * linear.residual[0][k]) == pytest.approx(np.exp(1j * gap), abs=1e-12)  # angles wrap


def by_torch(known, d, x, z, constants, steps):
    """h - z after the steps (arity, dof) of nodes x (arity, ambient)."""
    at, w = x[:, :d] + steps[:, :d], steps[:, d:]
    zero = torch.zeros_like(w[:, 0])
    rows = [[zero, -w[:, 0]], [w[:, 0], zero]]
    if d == 3:
        rows = [[zero, -w[:, 2], w[:, 1]], [w[:, 2], zero, -w[:, 0]], [-w[:, 1], w[:, 0], zero]]
    turned = x[:, d:].reshape(-1, d, d) @ torch.linalg.matrix_exp(
        torch.stack([torch.stack(row, -1) for row in rows], -2)
    )
    vector, rotation = at[-1] - at[0] if known.arity == 2 else at[0], turned[0]
    if known.frame == "nodes":
        return torch.stack(known.residual(torch.cat([at, turned.flatten(1)], 1).flatten(), z, constants, torch))
    if known.arity == 2 and known.frame != "world":
        vector, rotation = turned[0].T @ vector, turned[0].T @ turned[1]
    return torch.stack(
        known.residual([*vector, *rotation.flatten()] if known.frame == "relative" else [*vector], z, constants, torch)
    )


def errors(known, rotations, z):
    return np.column_stack(known.residual([*VECTORS.T, *rotations.reshape(-1, 9).T], [*z.T], (), np))


def test_a_relative_pose_is_scipys_logarithm():
    known, space = MEASUREMENTS["relative_pose"], Space(3, has_rotation=True)
    found = errors(known, ROTATIONS, space.join(VECTORS[::-1], ROTATIONS[::-1]))
    back = Rotation.from_matrix(ROTATIONS[::-1]).inv()
    assert found[:, :3] == pytest.approx(back.apply(VECTORS - VECTORS[::-1]), abs=1e-12)
    assert found[:, 3:] == pytest.approx((back * Rotation.from_matrix(ROTATIONS)).as_rotvec(), abs=1e-9)


@pytest.mark.parametrize("far", [1.0, 1e-2, 1e-6])
def test_the_logarithm_of_a_relative_pose_is_scipys(far):
    """scipy.linalg.logm of the homogeneous matrix Tz^-1 T, near the measured pose and far from it."""
    known, space = MEASUREMENTS["relative_pose_log"], Space(3, has_rotation=True)
    near = ROTATIONS @ exp(far * VECTORS / np.linalg.norm(VECTORS, axis=1, keepdims=True))
    found = errors(known, near, space.join(VECTORS[::-1], ROTATIONS))
    for k in range(50):
        pair = np.tile(np.eye(4), (2, 1, 1))
        pair[0, :3, :3], pair[0, :3, 3] = ROTATIONS[k], VECTORS[::-1][k]
        pair[1, :3, :3], pair[1, :3, 3] = near[k], VECTORS[k]
        twist = logm(np.linalg.inv(pair[0]) @ pair[1]).real
        assert found[k, :3] == pytest.approx(twist[:3, 3], abs=1e-7)
        assert found[k, 3:] == pytest.approx([twist[2, 1], twist[0, 2], twist[1, 0]], abs=1e-7)


def test_angles_wrap():
    """A bearing measured just beyond -x from a point just before it is a small residual, whatever the turn."""
    problem = Problem([*"ab"]).add("azimuth", ("a", "b"), np.pi - 0.01, std=1.0)
    x = np.array([[0, 0, 0], [-10.0, -0.1, 0]])
    residual, _ = problem.whiten(x)
    assert residual[0] == pytest.approx(0.02, abs=1e-4)
    assert Problem([*"ab"]).add("azimuth", ("a", "b"), -np.pi - 0.01, std=1.0).whiten(x)[0] == pytest.approx(residual)


def test_a_wrong_frame_and_a_name_that_is_taken_are_named():
    with refused(r"frame = 'bodi': .* Did you mean body\?"):
        measurement("squared range", arity=2, components=("coordinate",), frame="bodi")  # type: ignore[arg-type]
    with refused("registered already"):
        measurement("range", arity=2, components=("distance",))(lambda dx, dy, dz, m: (dx,))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"arity": 3}, "arity = 3"),
        ({"components": ("length",)}, "'coordinate', 'distance', 'angle'"),
        ({"components": ()}, "one per number"),
        ({"linear": True}, "the vector itself"),
    ],
)
def test_a_measurement_that_cannot_be(options, words):
    with refused(words):
        measurement("odd", **{"arity": 2, "components": ("distance",), **options})
    assert "odd" not in MEASUREMENTS
