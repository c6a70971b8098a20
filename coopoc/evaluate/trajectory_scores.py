"""Scores of trajectories that anyone estimated: Umeyama alignment, APE, RPE, RT-LE, NEES, intervals, remarks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from ..arrays import Floats, Ints, check_arrays, checked, instance, named, number, one_of
from ..errors import InputError, suggestion
from ..short_repr import short_repr
from .statistics import Interval, mean_interval

Unit = Literal["steps", "m"]
Aligned = Literal["none", "each", "sim3", "team"]
UNITS = {1e3: "ms", 1e6: "us", 1e9: "ns"}
LEAST = 1e-3
"""m or degrees of an error that are worth a remark."""
LAGS, ENOUGH = (0.3, 0.006), 20
"""s, steps of a search for a lag, a hundred of them on either side; poses that show what explains an error."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """x -> scale R x + t.

    Args:
        rotation: (..., d, d).
        translation: (..., d) m.
        scale: (...,), 1 where it was not estimated.
    """

    rotation: Floats
    translation: Floats
    scale: Floats

    __repr__ = short_repr

    def apply(self, position: Floats) -> Floats:
        """(..., T, d) positions in the other frame, m."""
        turned = np.einsum("...ij,...tj->...ti", self.rotation, position)
        return np.asarray(self.scale[..., None, None] * turned + self.translation[..., None, :])


def align(estimate: Floats, truth: Floats, *, scale: bool = False) -> Alignment:
    """The motion of SE(2) or SE(3), with scale of Sim(d), that brings an estimate nearest to the truth.

    min over R, t, s of sum_k |y_k - (s R x_k + t)|^2, closed form by the singular values of the covariance of y and x
    (Umeyama, IEEE PAMI 13(4), 1991, equations 39 to 43).

    Args:
        estimate: (..., T, d) m, d = 2 or 3; leading axes, such as runs, are aligned one by one.
        truth: as `estimate`.
        scale: estimate s as well, for a monocular estimate; else s = 1.

    Raises:
        InputError: other shapes, numbers that are not finite, or positions that leave the rotation open: all in one
            place, or in 3-D all on one line.

    >>> x = np.array([[0.0, 0], [1, 0], [2, 1]])
    >>> align(x, x + 5.0).translation
    array([5., 5.])
    """
    x, y = _pair(estimate, truth)
    mean_x, mean_y = x.mean(axis=-2, keepdims=True), y.mean(axis=-2, keepdims=True)
    cov = np.einsum("...ti,...tj->...ij", y - mean_y, x - mean_x) / x.shape[-2]
    u, size, vt = np.linalg.svd(cov)
    _determined(size)
    proper = np.ones_like(size)
    proper[..., -1] = np.where(np.linalg.det(u) * np.linalg.det(vt) < 0, -1, 1)
    rotation = (u * proper[..., None, :]) @ vt
    grown = np.ones(size.shape[:-1])
    if scale:
        grown = np.asarray((size * proper).sum(axis=-1) / ((x - mean_x) ** 2).sum(axis=-1).mean(axis=-1))
    turned = np.einsum("...ij,...tj->...ti", rotation, mean_x)
    return Alignment(rotation, (mean_y - grown[..., None, None] * turned)[..., 0, :], grown)


def absolute_error(estimate: Floats, truth: Floats, *, scale: bool = False) -> Floats:
    """Absolute position error (APE, also ATE) after the best alignment, e_t = |truth_t - (s R x_t + t)|, (..., T) m.

    Args:
        estimate: (..., T, d) m at the same instants, d = 2 or 3.
        truth: (..., T, d) m at the same instants, d = 2 or 3.
        scale: estimate the scale as well.

    Raises:
        InputError: what `align` raises.

    Source: Sturm et al., IROS 2012 (absolute trajectory error); evo's "APE, translation part" is the same number.

    >>> x = np.array([[0.0, 0], [1, 0], [2, 1]])
    >>> rms(absolute_error(x, x + [3.0, 4])).round(9)
    np.float64(0.0)
    """
    return np.asarray(np.linalg.norm(truth - align(estimate, truth, scale=scale).apply(estimate), axis=-1))


def rms(error: Floats) -> Floats:
    """sqrt(mean_t e_t^2) of errors (..., T).

    >>> rms(np.array([3.0, 4.0, 0.0, 0.0]))
    np.float64(2.5)
    """
    return np.sqrt(np.square(error).mean(axis=-1))  # type: ignore[no-any-return]


def relative_error(estimate: Path, truth: Path, delta: float = 1.0, unit: Unit = "steps") -> tuple[Floats, Floats]:
    """(n,) m and (n,) deg, translation and rotation of E_k = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j) over pairs i, j that are
    `delta` apart.

    Args:
        estimate: T poses P, with their rotations.
        truth: T poses Q at the same instants.
        delta: from i to j, and from there to the next; a whole number of steps.
        unit: "steps", or "m" along the estimated path.

    Returns:
        No error for a drive shorter than `delta`.

    Raises:
        InputError: a path without rotations, and what `ends` raises.

    Source: Sturm et al., IROS 2012, equation 2; evo's "RPE" of both parts is the same number.

    >>> still = Path(np.arange(3.0), np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1)))
    >>> relative_error(Path(still.t, np.arange(3.0)[:, None] * [1, 0, 0], still.rotation), still)[0]
    array([1., 1.])
    """
    i, j = (at := ends(estimate.position, delta, unit))[:-1], at[1:]
    moves, turns = [], []
    for path in (estimate, truth):
        if path.rotation is None:
            raise InputError("rotation", None, "must be that of each pose", "Compare positions with absolute_error.")
        back = path.rotation[i].swapaxes(-1, -2)
        moves.append(np.einsum("kab,kb->ka", back, path.position[j] - path.position[i]))
        turns.append(back @ path.rotation[j])
    return np.linalg.norm(moves[0] - moves[1], axis=1), angles(*turns)


def ends(x: Floats, delta: float, unit: Unit) -> Ints:
    """(n + 1,) steps between which the motions of a path x (T, 3) are compared.

    Raises:
        InputError: `delta` is not positive, or a part of a step.

    >>> ends(np.zeros((7, 3)), 3, "steps")
    array([0, 3, 6])
    """
    one_of("unit", unit, Unit)
    delta, steps = number("delta", delta, 1e-12, allowed="> 0"), unit == "steps"
    if steps and delta % 1:
        raise InputError("delta", delta, "must be a whole number of steps", 'For a length, set unit to "m".')
    found, gone = [0], 0.0
    for k, step in enumerate([1.0] * (len(x) - 1) if steps else np.linalg.norm(np.diff(x, axis=0), axis=1), 1):
        gone += step
        if gone >= delta:
            found.append(k)
            gone = 0.0
    return np.array(found, dtype=np.int64)


def _pair(estimate: Floats, truth: Floats) -> tuple[Floats, Floats]:
    x, y = checked("estimate", estimate), checked("truth", truth)
    if x.shape != y.shape or x.ndim < 2 or x.shape[-1] not in (2, 3) or not x.shape[-2]:
        raise InputError(
            "estimate, truth",
            f"shapes {x.shape} and {y.shape}",
            "must be equal, (..., T, 2) or (..., T, 3)",
            "Take both at the same instants.",
        )
    for name, values in (("estimate", x), ("truth", y)):
        if not np.isfinite(values).all():
            where = np.argwhere(~np.isfinite(values))[0].tolist()
            raise InputError(
                f"{name}{where}", "not finite", "must be finite", "Leave out the instants without a position."
            )
    return x, y


def _determined(size: Floats) -> None:
    """InputError if fewer than d - 1 singular values differ from zero: Umeyama's condition for a single optimum."""
    open_ = size[..., -2] <= 1e-14 * np.maximum(size[..., 0], np.finfo(float).tiny)
    if open_.any():
        raise InputError(
            "estimate, truth",
            f"singular values {size[open_][0].tolist()} m^2",
            f"at least {size.shape[-1] - 1} must differ from zero, or the rotation is open",
            "A straight drive has no frame of its own: compare it in the frame given, or align x and y alone.",
        )


@dataclass(frozen=True, eq=False)
class Path:
    """Where one vehicle was, or was thought to be.

    Args:
        t: (T,) s, increasing.
        position: (T, 3) m.
        rotation: (T, 3, 3), body to frame, or None.
        covariance: (T, 3, 3) m^2, of an estimate, or None.
    """

    t: Floats
    position: Floats
    rotation: Floats | None = None
    covariance: Floats | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        count = len(checked("t", self.t, "(T,)", (-1,)))
        matrices = "(T, 3, 3)", (count, 3, 3)
        shapes = {"t": ("(T,)", (count,)), "position": ("(T, 3)", (count, 3))}
        check_arrays(self, {**shapes, "rotation": matrices, "covariance": matrices})


@dataclass(frozen=True)
class Score:
    """How well one vehicle was estimated.

    Args:
        vehicle: its name.
        poses: that were compared.
        missed: poses of the estimate without a truth in time.
        rt_le_m: root of the mean squared error as it stands, with its interval over blocks of time.
        ape_m: the same after the alignment.
        ape_max_m: largest error after the alignment.
        rpe_m: root of the mean squared relative error, None without rotations or in a drive shorter than its delta.
        ape_deg: as `ape_m`, of the angles by which rotations differ, None without.
        rpe_deg: as `rpe_m`, of rotations.
        nees: mean of e^T P^-1 e, 3 if consistent (2 where heights claim no variance), None without covariances.
        remarks: signs of another unit, clock or scale, a sentence each.
    """

    vehicle: str
    poses: int
    missed: int
    rt_le_m: Interval
    ape_m: Interval
    ape_max_m: float
    rpe_m: float | None
    ape_deg: float | None
    rpe_deg: float | None
    nees: float | None
    remarks: tuple[str, ...] = ()


def scores(
    estimates: Mapping[str, Path],
    truths: Mapping[str, Path],
    *,
    aligned: Aligned = "none",
    max_diff: float = 0.01,
    offset: float = 0.0,
    delta: float = 1.0,
    unit: Unit = "steps",
) -> list[Score]:
    """One row for each vehicle of the estimates.

    Args:
        estimates: by vehicle.
        truths: by vehicle; one truth that has no estimate's name is that of all.
        aligned: "none" compares in the frame given; "each" aligns every vehicle by itself (evo's `-a`), "sim3" with its
            scale (`-as`); "team" moves all by one motion, which keeps where they are to each other.
        max_diff: s, how far stamps that belong together may be apart.
        offset: s, added to the estimates' stamps.
        delta: of the relative error.
        unit: of `delta`.

    Raises:
        InputError: a vehicle without a truth, stamps that do not meet, positions that leave the alignment open.

    Source: APE and RPE after Sturm et al., IROS 2012; NEES after Bar-Shalom et al. 2001, section 5.4.

    >>> t = np.arange(40) / 10
    >>> true = Path(t, np.column_stack([t, np.sin(t), 0 * t]))
    >>> (row,) = scores({"a": Path(t, true.position + [0.3, 0.4, 0.0])}, {"a": true})
    >>> round(row.rt_le_m.mean, 6)
    0.5
    """
    hint = "Give vehicle -> Path."
    for side, paths in (("estimates", estimates), ("truths", truths)):
        if not named(side, paths, hint):
            raise InputError(side, "none", "must be at least one", hint)
        for name, path in paths.items():
            instance(f"{side}[{name!r}]", path, Path)
    rows = []
    for name, (estimate, moved, truth) in compared(estimates, truths, aligned, max_diff, offset).items():
        raw = np.linalg.norm(estimate.position - truth.position, axis=1)
        error = np.linalg.norm(moved.position - truth.position, axis=1)
        relative = turns = turned = None
        whole = estimates[name].t + offset, _truth(name, truths, estimates)
        found = remarks(*whole, (estimate, moved, truth), max_diff)
        if len(ends(estimate.position, delta, unit)) < 2:
            found = (*found, f"no relative error: the drive is shorter than {delta:g} {unit}.")
        elif estimate.rotation is not None and truth.rotation is not None:
            relative, turned = (float(rms(error)) for error in relative_error(estimate, truth, delta, unit))
        if moved.rotation is not None and truth.rotation is not None:
            turns = float(rms(angles(moved.rotation, truth.rotation)))
        missed = len(estimates[name].t) - len(raw)
        spread = (rms_interval(raw), rms_interval(error), float(error.max()))
        rows.append(Score(name, len(raw), missed, *spread, relative, turns, turned, _nees(moved, truth), found))
    return rows


def compared(
    estimates: Mapping[str, Path],
    truths: Mapping[str, Path],
    aligned: Aligned = "none",
    max_diff: float = 0.01,
    offset: float = 0.0,
) -> dict[str, tuple[Path, Path, Path]]:
    """Estimate, the same aligned, and truth of each vehicle at the stamps that belong together, as `scores` compares
    them."""
    one_of("aligned", aligned, Aligned)
    pairs = {}
    for name, path in estimates.items():
        truth = _truth(name, truths, estimates)
        i, j = associated(path.t, truth.t, max_diff, offset)
        pairs[name] = _at(replace(path, t=path.t + offset), i), _at(truth, j)
    team = None
    if aligned == "team":
        team = align(*(np.concatenate([pair[k].position for pair in pairs.values()]) for k in (0, 1)))
    made = {}
    for name, (estimate, truth) in pairs.items():
        alone = {"each": False, "sim3": True}.get(aligned)
        motion = team if alone is None else align(estimate.position, truth.position, scale=alone)
        made[name] = estimate, estimate if motion is None else _moved(estimate, motion), truth
    return made


def angles(a: Floats, b: Floats) -> Floats:
    """(T,) deg, of the rotations A^T B between (T, 3, 3) ones.

    >>> angles(np.eye(3)[None], np.diag([-1.0, -1.0, 1.0])[None]).tolist()
    [180.0]
    """
    return np.asarray(np.degrees(Rotation.from_matrix(np.swapaxes(a, -1, -2) @ b).magnitude()))


def rms_interval(error: Floats) -> Interval:
    """Root of the mean square of errors (T,) m with its 95 % interval by a bootstrap over 20 blocks of time: errors of
    one drive are correlated, its blocks hardly.

    >>> rms_interval(np.full(100, 2.0)).mean
    2.0
    """
    count = min(20, len(error))
    found = mean_interval(np.array([np.mean(part**2) for part in np.array_split(error, count)]))
    return Interval(float(rms(error)), float(np.sqrt(max(found.low, 0.0))), float(np.sqrt(found.high)), count)


def _truth(name: str, truths: Mapping[str, Path], estimates: Mapping[str, Path]) -> Path:
    """The truth of that name, or the only one if it has no estimate's name."""
    if name not in truths and (len(truths) > 1 or estimates.keys() & truths.keys()):
        hint = suggestion(name, truths, "Name the files, or the ids in them, alike.")
        raise InputError("vehicle", repr(name), f"has no truth among {', '.join(truths)}", hint)
    return truths.get(name) or next(iter(truths.values()))


def _at(path: Path, k: Ints) -> Path:
    parts: dict[str, Any] = {name: None if value is None else value[k] for name, value in vars(path).items()}
    return Path(**parts)


def _moved(path: Path, motion: Alignment) -> Path:
    turn, cov = motion.rotation, path.covariance
    turned = None if cov is None else motion.scale**2 * (turn @ cov @ turn.T)
    rotation = None if path.rotation is None else turn @ path.rotation
    return Path(path.t, motion.apply(path.position), rotation, turned)


def _nees(estimate: Path, truth: Path) -> float | None:
    if estimate.covariance is None:
        return None
    gap = truth.position - estimate.position
    flat = estimate.covariance[:, 2, 2].max(initial=0.0) == 0.0
    size = 2 if flat else 3
    solved = np.linalg.solve(estimate.covariance[:, :size, :size], gap[:, :size, None])[..., 0]
    return float((gap[:, :size] * solved).sum(axis=1).mean())


def associated(estimate: Floats, truth: Floats, max_diff: float = 0.01, offset: float = 0.0) -> tuple[Ints, Ints]:
    """Indices (n,), (n,) of stamps that belong together: for each of the shorter list the nearest of the longer.

    Args:
        estimate: (M,) s, increasing.
        truth: (K,) s, increasing.
        max_diff: s, stamps further apart than this belong to nothing.
        offset: s, added to the estimate's stamps.

    Raises:
        InputError: no stamps belong together.

    Source: the association of evo (`sync.associate_trajectories`), which gives the same pairs.

    >>> associated(np.array([0.0, 0.1, 0.2]), np.array([0.101, 0.2]))
    (array([1, 2]), array([0, 1]))
    """
    x, y = checked("estimate", estimate, "(M,)", (-1,)), checked("truth", truth, "(K,)", (-1,))
    max_diff, x = number("max_diff", max_diff), x + number("offset", offset, -np.inf)
    swap = len(x) > len(y)
    short, long = (y, x) if swap else (x, y)
    nearest = np.ceil(np.interp(short, long, np.arange(len(long))) - 0.5).astype(np.int64)
    kept = np.flatnonzero(np.abs(long[nearest] - short) <= max_diff)
    if not len(kept):
        spans = f"{span(x)} and {span(y)}"
        hint = "Check the unit of the stamps, the clocks (offset) and the rates (max_diff)."
        raise InputError("stamps", spans, f"must agree within {max_diff:g} s somewhere", hint)
    pair = (kept.astype(np.int64), nearest[kept])
    return (pair[1], pair[0]) if swap else pair


def span(t: Floats) -> str:
    """First and last stamp with all their digits.

    >>> span(np.array([0.1, 1311868230.5]))
    '0.1..1311868230.5 s'
    """
    return f"{t[0].item()!r}..{t[-1].item()!r} s" if len(t) else "no stamps"


def remarks(stamps: Floats, truth: Path, at: tuple[Path, Path, Path], max_diff: float) -> tuple[str, ...]:
    """What a reader should know before believing the scores, a sentence each: stamps that hardly meet, and what takes
    most of an error away, more than half of it.

    Args:
        stamps: (M,) s of the whole estimate.
        truth: the whole truth.
        at: estimate, the same aligned, and truth where they are compared.
        max_diff: s, how far stamps that belong together were allowed to be apart.

    >>> import numpy as np
    >>> t, one = np.arange(9.0), Path(np.zeros(1), np.zeros((1, 3)))
    >>> remarks(1000 * t, Path(t, np.zeros((9, 3))), (one, one, one), 0.01)[0]
    '1 of 9 stamps meet within 0.01 s: 0.0..8000.0 s and 0.0..8.0 s; the estimate looks like ms.'
    """
    found = dict[str, str]()
    for unit, text, before, after in sorted(_explained(truth, *at), key=lambda row: -row[3]):  # the best comes last
        if after < min(before / 2, before - LEAST):
            found[unit] = f"{text} error falls from {before:.3g} to {after:.3g} {unit}."
    return (*_stamps(stamps, truth.t, len(at[0].t), max_diff), *found.values())


def _stamps(given: Floats, truth: Floats, met: int, max_diff: float) -> Iterator[str]:
    count = min(len(given), len(truth))
    if 2 * met >= count:
        return
    ratio = float(np.ptp(given)) / max(float(np.ptp(truth)), 1e-12)
    looks = "another clock (offset), or rates that do not meet (max_diff)?"
    for factor, unit in UNITS.items():
        if 0.5 < ratio / factor < 2:
            looks = f"the estimate looks like {unit}."
        if 0.5 < ratio * factor < 2:
            looks = f"the truth looks like {unit}."
    yield f"{met} of {count} stamps meet within {max_diff:g} s: {span(given)} and {span(truth)}; {looks}"


def _explained(truth: Path, estimate: Path, moved: Path, at: Path) -> Iterator[tuple[str, str, Any, Any]]:
    """What may explain an error, in order: its unit, the explanation, the error without it and with it.

    An alignment hides a mirrored axis where all is flat, so that it is asked for in the plane, too.
    """
    x, y = estimate.position, at.position
    if len(x) < ENOUGH:
        return
    error = np.linalg.norm(moved.position - y, axis=1)
    with suppress(InputError):  # a straight drive, or a standing one: its frame is open, and so is its scale
        for axes in (2, 3):
            a, b = x[:, :axes], y[:, :axes]
            rigid, mirrored = (rms(absolute_error(c, b)) for c in (a, a[:, ::-1]))
            yield "m", "with an axis mirrored, or two swapped, its aligned", rigid, mirrored
        free, text = rms(absolute_error(x, y, scale=True)), f"times {align(x, y, scale=True).scale:.3g}, its aligned"
        yield "m", text, rigid, free
        yield "m", "aligned by itself (align), its", rms(error), rigid
    t, x, error = (values[:: 1 + len(error) // 500] for values in (moved.t, moved.position, error))

    def errors(lag: float) -> tuple[Any, Any]:
        """Without the lag and with it, where the truth reaches then."""
        there = [np.interp(t + lag, truth.t, axis, np.nan, np.nan) for axis in truth.position.T]
        gap = np.linalg.norm(x - np.column_stack(there), axis=1)
        known = np.isfinite(gap)
        return (rms(error[known]), rms(gap[known])) if known.mean() > 0.5 else (0.0, 0.0)

    best = 0.0
    for step in LAGS:
        best = max((best + step * np.arange(-100, 101)).tolist(), key=lambda lag: np.subtract(*errors(lag)))
    yield "m", f"with {best:+.3g} s on its stamps (offset), its", *errors(best)
    if estimate.rotation is None or moved.rotation is None or at.rotation is None:
        return
    last = np.roll(Rotation.from_matrix(estimate.rotation).as_quat(), -1, axis=1)
    other = moved.rotation[0] @ estimate.rotation[0].T @ Rotation.from_quat(last).as_matrix()
    before = rms(angles(moved.rotation, at.rotation))
    yield "°", "read with w first, its rotation", before, rms(angles(other, at.rotation))
