"""Which factors GTSAM has with exactly our objective, by kind.

The error e of a GTSAM class below gives our whitened residual, or one of the same length, as S e; S goes into its noise
model and the loss into a robust one. What is not here GTSAM weighs in another way: its BetweenFactorPose2/3 takes the
logarithm of the whole pose where ours is (Rz^T (t - tz), Log(Rz^T R)), its bearing in space lives in the tangent plane
of a direction, and range, azimuth and inclination in the world frame it does not have.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from ...arrays import Floats
from ..factor import Factor
from ..problem import Problem
from ..space import Space, log

POINT, POSE = False, True
SAME = 1e-12
"""Share by which two weights may differ and count as equal."""
Names: TypeAlias = Mapping[tuple[bool, ...], str]
"""GTSAM's class by which of the nodes are poses."""
Given: TypeAlias = Callable[[Any, int], tuple[Any, ...]]
"""(gtsam, row) -> what its class takes between keys and noise model."""


@dataclass(frozen=True, eq=False)
class Part:
    """A GTSAM class that says a factor, or those of its residuals that `root` keeps.

    Args:
        root: (M, k, k) S, square root of the information of its k errors.
    """

    names: Names
    given: Given
    root: Floats


Form: TypeAlias = list[Part] | str
"""The parts of a factor, or why it has none."""


def forms(problem: Problem) -> list[Form]:
    """Of each factor of a single problem its parts in GTSAM, or why it has none."""
    return [form_of(problem, factor) for factor in problem.factors]


def form_of(problem: Problem, factor: Factor) -> Form:
    """Its parts in GTSAM, or why it has none."""
    if factor.kind not in FORMS:
        return "GTSAM has no such factor"
    kinds = [[False] * factor.nodes.shape[1]]
    if problem.poses:
        kinds = np.unique(np.isin(factor.nodes, problem.poses), axis=0).tolist()
    form = OF_POSES.get(factor.kind, FORMS[factor.kind]) if all(map(all, kinds)) else FORMS[factor.kind]
    parts = form(factor, factor.root, problem.dimension)
    if isinstance(parts, str):
        return parts
    if len(parts) > 1 and factor.loss is not None:
        return "it takes two factors in GTSAM, which no robust loss can join"
    for row in kinds:
        if not all(tuple(row) in part.names or tuple(row[::-1]) in part.names for part in parts):
            return f"GTSAM has none from {' to '.join('a pose' if turns else 'a point' for turns in row)}"
    return parts


def pose_of(gtsam: Any, d: int, x: Floats) -> Any:
    """gtsam.Pose2 or Pose3 of a pose (width,)."""
    if d == 2:
        return gtsam.Pose2(x[0], x[1], np.arctan2(x[4], x[2]))
    return gtsam.Pose3(gtsam.Rot3(x[3:].reshape(3, 3)), x[:3])


def _position(factor: Factor, W: Floats, d: int) -> Form:
    names: Names = {(POINT,): f"PriorFactorPoint{d}", (POSE,): f"PoseTranslationPrior{d}D"}
    return [Part(names, lambda gtsam, k: (factor.z[k],), W)]


def _displacement(factor: Factor, W: Floats, d: int) -> Form:
    return [Part({(POINT, POINT): f"BetweenFactorPoint{d}"}, lambda gtsam, k: (factor.z[k],), W)]


def _displacement_of_poses(factor: Factor, W: Floats, d: int) -> Form:
    """GTSAM's chord T_i - Z T_j with Z = (-z, I), whose translation is minus our residual."""
    z = Space(d, turning=True).join(-factor.z)
    root = np.zeros((len(W), (d + 1) ** 2, (d + 1) ** 2))
    root[:, -d - 1 : -1, -d - 1 : -1] = W
    names: Names = {(POSE, POSE): f"FrobeniusLeftBetweenFactorPose{d}"}
    return [Part(names, lambda gtsam, k: (pose_of(gtsam, d, z[k]),), root)]


def _range(factor: Factor, W: Floats, d: int) -> Form:
    """A speed is a range over dt."""
    dt = factor.constants if factor.kind == "speed" else np.ones((len(W), 1))
    assert dt is not None
    far = factor.z * dt
    names: Names = {
        (POINT, POINT): f"RangeFactor{d}",
        (POSE, POINT): f"RangeFactor{d}D",
        (POSE, POSE): f"RangeFactorPose{d}",
    }
    return [Part(names, lambda gtsam, k: (far[k, 0],), W / dt[:, :, None])]


def _bearing(factor: Factor, W: Floats, d: int) -> Form:
    if d == 3:
        return "GTSAM's bearing in space has no forward axis"
    names: Names = {(POSE, POINT): "BearingFactor2D", (POSE, POSE): "BearingFactorPose2"}
    return [Part(names, lambda gtsam, k: (gtsam.Rot2(factor.z[k, 0]),), W)]


def _body_spherical(factor: Factor, W: Floats, d: int) -> Form:
    """GTSAM's errors are bearing and range, ours range and bearing."""
    if d == 3:
        return "GTSAM weighs a bearing in space by its tangent plane, not by azimuth and inclination"
    names: Names = {(POSE, POINT): "BearingRangeFactor2D", (POSE, POSE): "BearingRangeFactorPose2"}
    return [Part(names, lambda gtsam, k: (gtsam.Rot2(factor.z[k, 1]), factor.z[k, 0]), W[:, :, ::-1])]


def _relative_position(factor: Factor, W: Floats, d: int) -> Form:
    z = Space(d, turning=True).join(factor.z)
    return _turned(W, {0: np.arange(d)}, lambda gtsam, k: (pose_of(gtsam, d, z[k]),), d)


def _relative_pose(factor: Factor, W: Floats, d: int) -> Form:
    """GTSAM's chord T_j - T_i Z for the translation, its geodesic for the rotation alone."""
    if not _apart(W, d):
        return "its std must not couple position and rotation"

    def given(gtsam: Any, k: int) -> tuple[Any, ...]:
        return (pose_of(gtsam, d, factor.z[k]),)

    chord = _turned(W[:, :d, :d], {0: np.arange(d)}, given, d)
    if isinstance(chord, str):
        return chord
    size, first = (3, 2) if d == 2 else (6, 0)
    root = np.zeros((len(W), size, size))
    root[:, first : first + size - d, first : first + size - d] = W[:, d:, d:]
    return [*chord, Part({(POSE, POSE): f"BetweenFactorPose{d}"}, given, root)]


def _relative_chordal(factor: Factor, W: Floats, d: int) -> Form:
    columns = {0: np.arange(d), **{1 + k: d + k + d * np.arange(d) for k in range(d)}}
    return _turned(W, columns, lambda gtsam, k: (pose_of(gtsam, d, factor.z[k]),), d)


def _turned(W: Floats, columns: dict[int, Any], given: Given, d: int) -> Form:
    """GTSAM's T_j - T_i Z is R_i times our residual, column by column: each must have one std and no correlation.

    Args:
        columns: our residuals of the translation (0) and of each column of the rotation (1 + k).
    """
    information = np.swapaxes(W, -1, -2) @ W
    weight = np.zeros((len(W), (d + 1) ** 2))
    expected = np.zeros_like(information)
    for column, rows in columns.items():
        own = information[:, rows[0], rows[0]]
        weight[:, (d + 1) * ((column - 1) % (d + 1)) + np.arange(d)] = own[:, None]
        expected[:, rows, rows] = own[:, None]
    scale = np.sqrt(np.einsum("mii->mi", information))
    if (np.abs(information - expected) > SAME * scale[:, :, None] * scale[:, None, :]).any():
        return "it needs one std in all directions of the body" + (" and of each axis" if len(columns) > 1 else "")
    root = np.zeros((len(W), weight.shape[1], weight.shape[1]))
    root[:, np.arange(weight.shape[1]), np.arange(weight.shape[1])] = np.sqrt(weight)
    return [Part({(POSE, POSE): f"FrobeniusBetweenFactorPose{d}"}, given, root)]


def _pose_prior(factor: Factor, W: Floats, d: int) -> Form:
    if not _apart(W, d):
        return "its std must not couple position and rotation"
    turned = Space(d, turning=True).rotation(factor.z)
    back = np.swapaxes(turned, -1, -2)

    def rotation(gtsam: Any, k: int) -> tuple[Any, ...]:
        return (gtsam.Rot2(float(log(turned[k])[0])) if d == 2 else gtsam.Rot3(turned[k]),)

    return [Part({(POSE,): f"PoseTranslationPrior{d}D"}, lambda gtsam, k: (factor.z[k, :d],), W[:, :d, :d] @ back),
            Part({(POSE,): f"PoseRotationPrior{d}D"}, rotation, W[:, d:, d:])]  # fmt: skip


def _chordal_prior(factor: Factor, W: Floats, d: int) -> Form:
    """GTSAM's errors are the columns of T - Z, ours its translation and then the rows of its rotation."""
    side = d + 1
    rows, cols = np.divmod(np.arange(d * d), d)
    theirs = np.concatenate([side * d + np.arange(d), side * cols + rows])
    root = np.zeros((len(W), side**2, side**2))
    root[:, : W.shape[1], theirs] = W

    def matrix(gtsam: Any, k: int) -> tuple[Any, ...]:
        return (pose_of(gtsam, d, factor.z[k]).matrix(),)

    return [Part({(POSE,): f"FrobeniusPriorPose{d}"}, matrix, root)]


def _apart(W: Floats, d: int) -> bool:
    """Whether position and rotation are independent."""
    coupled = max(np.abs(W[:, :d, d:]).max(initial=0.0), np.abs(W[:, d:, :d]).max(initial=0.0))
    return bool(coupled <= SAME * np.abs(W).max(initial=0.0))


FORMS: dict[str, Callable[[Factor, Floats, int], Form]] = {
    "position": _position, "displacement": _displacement, "range": _range, "speed": _range, "bearing": _bearing,
    "body_spherical": _body_spherical, "relative_position": _relative_position, "relative_pose": _relative_pose,
    "relative_pose_chordal": _relative_chordal, "pose": _pose_prior, "pose_chordal": _chordal_prior,
}  # fmt: skip
"""(factor, W (M, size, size), dimension) -> parts, by kind."""
OF_POSES = {"displacement": _displacement_of_poses}
"""The same where all nodes are poses and points would need another class."""
