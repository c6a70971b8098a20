"""Which factors GTSAM has with exactly our objective, by kind.

The error e of a GTSAM class below gives our whitened residual, or one of the same length, as S e; S goes into its noise
model and the loss into a robust one. What is not here GTSAM weighs in another way: its bearing in space lives in the
tangent plane of a direction, and range, azimuth and inclination in the world frame it does not have.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ...arrays import Floats, frozen
from ..model.factor import Factor
from ..model.problem import Problem
from ..model.space import Space, log

POINT, POSE = False, True
SAME = 1e-12
"""Share by which two weights may differ and count as equal."""
Names: TypeAlias = Mapping[tuple[bool, ...], str]
"""GTSAM's class by which of the nodes are poses."""
Given: TypeAlias = Callable[[Any], list[tuple[Any, ...]]]
"""gtsam -> by row what its class takes between keys and noise model."""


class Part(NamedTuple):
    """A GTSAM class that states a factor, or those of its residuals that `root` keeps.

    Attributes:
        root: (M or 1, k, k) S, square root of the information of its k errors.
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
    kinds, form = [(False,) * factor.nodes.shape[1]], FORMS[factor.kind]
    if problem.poses:
        posed = np.zeros(len(problem.names), dtype=bool)
        posed[list(problem.poses)] = True
        kinds = sorted(set(map(tuple, posed[factor.nodes].tolist())))
        form = OF_POSES.get(factor.kind, form) if all(map(all, kinds)) else form
    parts = form(factor, _root(factor), problem.dimension)
    if isinstance(parts, str):
        return parts
    if len(parts) > 1 and factor.loss is not None:
        return "it takes two factors in GTSAM, which no robust loss can join"
    lacking = [row for row in kinds for part in parts if row not in part.names and row[::-1] not in part.names]
    if lacking:
        return f"GTSAM has none from {' to '.join('a pose' if turns else 'a point' for turns in lacking[0])}"
    return parts


def _root(factor: Factor) -> Floats:
    """W (M, size, size), or (1, size, size) where all measurements share it."""
    return _inverse(factor.std.tobytes()) if factor.std is not None and len(factor.std) == 1 else factor.root


@lru_cache(maxsize=256)
def _inverse(raw: bytes) -> Floats:
    """(1, size, size) of one measurement's std."""
    return frozen(np.diag(1.0 / np.frombuffer(raw))[None])


def pose_of(gtsam: Any, d: int, x: Floats) -> Any:
    """gtsam.Pose2 or Pose3 of a pose (ambient,)."""
    if d == 2:
        return gtsam.Pose2(x[0], x[1], np.arctan2(x[4], x[2]))
    return gtsam.Pose3(gtsam.Rot3(x[3:].reshape(3, 3)), x[:3])


def _position(factor: Factor, W: Floats, d: int) -> Form:
    names: Names = {(POINT,): f"PriorFactorPoint{d}", (POSE,): f"PoseTranslationPrior{d}D"}
    return [Part(names, lambda gtsam: list(zip(factor.z, strict=True)), W)]


def _displacement(factor: Factor, W: Floats, d: int) -> Form:
    return [Part({(POINT, POINT): f"BetweenFactorPoint{d}"}, lambda gtsam: list(zip(factor.z, strict=True)), W)]


def _displacement_of_poses(factor: Factor, W: Floats, d: int) -> Form:
    """GTSAM's chord T_i - Z T_j with Z = (-z, I), whose translation is minus our residual."""
    z = Space(d, has_rotation=True).join(-factor.z)
    root = np.zeros((len(W), (d + 1) ** 2, (d + 1) ** 2))
    root[:, -d - 1 : -1, -d - 1 : -1] = W
    names: Names = {(POSE, POSE): f"FrobeniusLeftBetweenFactorPose{d}"}
    return [Part(names, lambda gtsam: [(pose_of(gtsam, d, each),) for each in z], root)]


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
    return [Part(names, lambda gtsam: list(zip(far[:, 0], strict=True)), W / dt[:, :, None])]


def _bearing(factor: Factor, W: Floats, d: int) -> Form:
    if d == 3:
        return "GTSAM's bearing in space has no forward axis"
    names: Names = {(POSE, POINT): "BearingFactor2D", (POSE, POSE): "BearingFactorPose2"}
    return [Part(names, lambda gtsam: [(gtsam.Rot2(angle),) for angle in factor.z[:, 0]], W)]


def _body_spherical(factor: Factor, W: Floats, d: int) -> Form:
    """GTSAM's errors are bearing and range, ours range and bearing; in its order a diagonal W stays one."""
    if d == 3:
        return "GTSAM weighs a bearing in space by its tangent plane, not by azimuth and inclination"
    names: Names = {(POSE, POINT): "BearingRangeFactor2D", (POSE, POSE): "BearingRangeFactorPose2"}
    return [Part(names, lambda gtsam: [(gtsam.Rot2(angle), far) for far, angle in factor.z], W[:, ::-1, ::-1])]


def _relative_position(factor: Factor, W: Floats, d: int) -> Form:
    z = Space(d, has_rotation=True).join(factor.z)
    return _turned(W, {0: np.arange(d)}, lambda gtsam: [(pose_of(gtsam, d, each),) for each in z], d)


def _relative_pose(factor: Factor, W: Floats, d: int) -> Form:
    """GTSAM's chord T_j - T_i Z for the translation, its geodesic for the rotation alone."""
    if not _apart(W, d):
        return "its std must not couple position and rotation"

    def given(gtsam: Any) -> list[tuple[Any, ...]]:
        return [(pose_of(gtsam, d, z),) for z in factor.z]

    chord = _turned(W[:, :d, :d], {0: np.arange(d)}, given, d)
    if isinstance(chord, str):
        return chord
    size, first = (3, 2) if d == 2 else (6, 0)
    root = np.zeros((len(W), size, size))
    root[:, first : first + size - d, first : first + size - d] = W[:, d:, d:]
    return [*chord, Part({(POSE, POSE): f"BetweenFactorPose{d}"}, given, root)]


def relative_log(factor: Factor, W: Floats, d: int) -> Form:
    """GTSAM's errors in space are those of the rotation first."""
    root = W if d == 2 else np.roll(W, -d, axis=2)
    return [Part({(POSE, POSE): f"BetweenFactorPose{d}"}, lambda g: [(pose_of(g, d, z),) for z in factor.z], root)]


def _relative_chordal(factor: Factor, W: Floats, d: int) -> Form:
    columns = {0: np.arange(d), **{1 + k: d + k + d * np.arange(d) for k in range(d)}}
    return _turned(W, columns, lambda gtsam: [(pose_of(gtsam, d, z),) for z in factor.z], d)


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
    turned = Space(d, has_rotation=True).rotation(factor.z)
    back = np.swapaxes(turned, -1, -2)

    def rotation(gtsam: Any) -> list[tuple[Any, ...]]:
        return [(gtsam.Rot2(float(log(turn)[0])) if d == 2 else gtsam.Rot3(turn),) for turn in turned]

    def position(gtsam: Any) -> list[tuple[Any, ...]]:
        return list(zip(factor.z[:, :d], strict=True))

    return [
        Part({(POSE,): f"PoseTranslationPrior{d}D"}, position, W[:, :d, :d] @ back),
        Part({(POSE,): f"PoseRotationPrior{d}D"}, rotation, W[:, d:, d:]),
    ]


def _chordal_prior(factor: Factor, W: Floats, d: int) -> Form:
    """GTSAM's errors are the columns of T - Z, ours its translation and then the rows of its rotation."""
    side = d + 1
    rows, cols = np.divmod(np.arange(d * d), d)
    theirs = np.concatenate([side * d + np.arange(d), side * cols + rows])
    root = np.zeros((len(W), side**2, side**2))
    root[:, : W.shape[1], theirs] = W

    def matrix(gtsam: Any) -> list[tuple[Any, ...]]:
        return [(pose_of(gtsam, d, z).matrix(),) for z in factor.z]

    return [Part({(POSE,): f"FrobeniusPriorPose{d}"}, matrix, root)]


def _apart(W: Floats, d: int) -> bool:
    """Whether position and rotation are independent."""
    coupled = max(np.abs(W[:, :d, d:]).max(), np.abs(W[:, d:, :d]).max())
    return bool(coupled <= SAME * np.abs(W).max())


FORMS: dict[str, Callable[[Factor, Floats, int], Form]] = {
    "position": _position,
    "displacement": _displacement,
    "range": _range,
    "speed": _range,
    "bearing": _bearing,
    "body_spherical": _body_spherical,
    "relative_position": _relative_position,
    "relative_pose": _relative_pose,
    "relative_pose_log": relative_log,
    "relative_pose_chordal": _relative_chordal,
    "pose": _pose_prior,
    "pose_chordal": _chordal_prior,
}
"""(factor, W (M or 1, size, size), dimension) -> parts, by kind."""
OF_POSES = {"displacement": _displacement_of_poses}
"""The same where all nodes are poses and points would need another class."""
