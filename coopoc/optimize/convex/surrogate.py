"""surrogate: a problem that has a QCQP, in place of one that has none, and what was replaced in it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...arrays import Floats
from ...errors import InputError
from ..model.factor import Factor
from ..model.problem import Problem
from ..starts.initial import converted
from .quadratic import TERMS, one_weight


@dataclass(frozen=True, eq=False)
class Surrogate:
    """The problem to relax, and a line per kind that was replaced: this problem is certified, not the first."""

    problem: Problem
    replaced: tuple[str, ...]


def surrogate(problem: Problem, isotropic: bool = False) -> Surrogate:
    """The nearest problem that `quadratic` takes; kinds that are quadratic stay as they are.

    spherical: the vector d u, with the rotated covariance (`converted`). body_spherical: relative_position of the same
    vector. relative_pose, pose: their chordal kinds. Where poses turn, weights that differ between axes become one,
    std^2 = trace(cov) / d, and a rotation's std^2 = var (2-D) or 2 trace(cov) / 3 (3-D), as PyFG and SE-Sync have it.

    Args:
        problem: a single one.
        isotropic: one weight per measurement even among points, which needs d times fewer rows.

    Raises:
        InputError: a kind that has no surrogate: an angle without a distance, a speed; no finite variance to average.

    >>> fixes = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [4, 0, 0]], std=1.0)
    >>> surrogate(fixes.add("spherical", ("a", "b"), [5, 0, 1.5], std=[1, 0.1, 0.1])).replaced
    ('spherical -> displacement by its vector d u, covariance rotated',)
    """
    factors, lines = [], []
    for factor in problem.factors:
        new, notes = _quadratic(problem, factor)
        sides = 2 if new.kind.endswith("chordal") else 1
        if (problem.poses or isotropic) and new.kind != "range" and not _scalar(new, sides):
            new, notes = _isotropic(new), [*notes, "one weight for all axes"]
        factors.append(new)
        if notes:
            lines.append(f"{factor.kind} -> {new.kind} by {', '.join(notes)}")
    return Surrogate(replace(problem, factors=tuple(factors)), tuple(dict.fromkeys(lines)))


def _quadratic(problem: Problem, factor: Factor) -> tuple[Factor, list[str]]:
    """A factor of a quadratic kind and what was done for it."""
    if factor.kind in TERMS:
        return factor, []
    if factor.kind in ("spherical", "body_spherical"):
        seen = Factor("spherical", factor.nodes, factor.z, sqrt_information=factor.root)
        (vector,) = converted(Problem(problem.names, (seen,), dimension=problem.dimension)).factors
        if factor.kind == "spherical":
            return vector, ["its vector d u", "covariance rotated"]
        return replace(vector, kind="relative_position"), ["its vector d u"]
    if factor.kind in ("pose", "relative_pose", "relative_pose_log"):
        return _chordal(factor, problem.dimension), ["chords in place of angles"]
    hint = "Measure angles together with a distance, as spherical or body_spherical."
    raise InputError("kind", repr(factor.kind), "has no quadratic surrogate", hint)


def _chordal(factor: Factor, d: int) -> Factor:
    cov = _covariance(factor)
    turn = np.einsum("mii->m", cov[:, d:, d:]) * (1.0 if d == 2 else 2.0 / 3.0)
    std = np.sqrt(np.column_stack([_mean(cov[:, :d, :d])[:, None].repeat(d, 1), turn[:, None].repeat(d * d, 1)]))
    return Factor(f"{factor.kind.removesuffix('_log')}_chordal", factor.nodes, factor.z, std=std)


def _isotropic(factor: Factor) -> Factor:
    cov = _covariance(factor)
    d = cov.shape[1] if cov.shape[1] < 4 else 2 if cov.shape[1] == 6 else 3
    variance = [_mean(part)[:, None].repeat(part.shape[1], 1) for part in (cov[:, :d, :d], cov[:, d:, d:]) if part.size]
    return Factor(factor.kind, factor.nodes, factor.z, std=np.sqrt(np.concatenate(variance, axis=1)))


def _covariance(factor: Factor) -> Floats:
    """(M, size, size); InputError where there is none."""
    information = np.swapaxes(factor.root, 1, 2) @ factor.root
    if np.linalg.matrix_rank(information).min(initial=information.shape[1]) < information.shape[1]:
        hint = "Give every component a finite standard deviation."
        raise InputError(f"std of {factor.kind}", "infinite in some direction", "must have an average", hint)
    return np.linalg.inv(information)


def _mean(cov: Floats) -> Floats:
    """(M,) mean variance of (M, k, k)."""
    return np.asarray(np.einsum("mii->m", cov) / cov.shape[1])


def _scalar(factor: Factor, sides: int) -> bool:
    d = factor.z.shape[1] if sides == 1 else 2 if factor.z.shape[1] == 6 else 3
    parts = [factor.root[:, :d, :d], factor.root[:, d:, d:]][:sides]
    return all(one_weight(part) is not None for part in parts)
