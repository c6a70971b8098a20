"""Scores of trajectories that anyone estimated, against a truth: APE, RPE, RT-LE, NEES and intervals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..arrays import Floats, Ints, number
from ..errors import InputError
from ..plugins import suggestion, unknown
from .alignment import Alignment, align
from .association import associated
from .relative_error import Unit, relative_error
from .statistics import Interval, mean_interval

Aligned = Literal["none", "each", "team"]


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
        rpe_m: root of the mean squared relative error, None without rotations.
        nees: mean of e^T P^-1 e, 3 if consistent (2 where heights claim no variance), None without covariances.
    """

    vehicle: str
    poses: int
    missed: int
    rt_le_m: Interval
    ape_m: Interval
    ape_max_m: float
    rpe_m: float | None
    nees: float | None


def scores(
    estimates: Mapping[str, Path],
    truths: Mapping[str, Path],
    *,
    aligned: Aligned = "none",
    max_diff: float = 0.01,
    delta: float = 1.0,
    unit: Unit = "steps",
    blocks: int = 20,
) -> list[Score]:
    """One row for each vehicle of the estimates.

    Args:
        estimates: by vehicle.
        truths: by vehicle; one truth for one estimate needs no common name.
        aligned: "none" compares in the frame given; "each" aligns every vehicle by itself (evo's `-a`); "team" moves
            all by one motion, which keeps where they are to each other.
        max_diff: s, how far stamps that belong together may be apart.
        delta: of the relative error.
        unit: of `delta`.
        blocks: of time, over which intervals are drawn: errors of one drive are correlated, its blocks hardly.

    Raises:
        InputError: a vehicle without a truth, stamps that do not meet, positions that leave the alignment open.

    Source: APE and RPE after Sturm et al., IROS 2012; NEES after Bar-Shalom et al. 2001, section 5.4.

    >>> t = np.arange(40) / 10
    >>> true = Path(t, np.column_stack([t, np.sin(t), 0 * t]))
    >>> (row,) = scores({"a": Path(t, true.position + [0.3, 0.4, 0.0])}, {"a": true})
    >>> round(row.rt_le_m.mean, 6)
    0.5
    """
    if aligned not in ("none", "each", "team"):
        raise unknown("aligned", aligned, ("none", "each", "team"))
    blocks = number("blocks", blocks, 2, kind=int, allowed=">= 2")
    pairs = {name: _pair(name, path, truths, len(estimates), max_diff) for name, path in estimates.items()}
    team = None
    if aligned == "team":
        team = align(*(np.concatenate([pair[k].position for pair in pairs.values()]) for k in (0, 1)))
    rows = []
    for name, (estimate, truth) in pairs.items():
        motion = team or (align(estimate.position, truth.position) if aligned == "each" else None)
        moved = estimate if motion is None else _moved(estimate, motion)
        raw = np.linalg.norm(estimate.position - truth.position, axis=1)
        error = np.linalg.norm(moved.position - truth.position, axis=1)
        relative = None
        if estimate.rotation is not None and truth.rotation is not None:
            both = (estimate.position, estimate.rotation), (truth.position, truth.rotation)
            relative = float(np.sqrt(np.square(relative_error(*both, delta, unit)).mean()))
        missed = len(estimates[name].t) - len(raw)
        spread = (rms_interval(raw, blocks), rms_interval(error, blocks), float(error.max()))
        rows.append(Score(name, len(raw), missed, *spread, relative, _nees(moved, truth)))
    return rows


def rms_interval(error: Floats, blocks: int = 20) -> Interval:
    """Root of the mean square of errors (T,) m with its 95 % interval by a bootstrap over blocks of time.

    >>> rms_interval(np.full(100, 2.0)).mean
    2.0
    """
    count = min(blocks, len(error))
    squares = np.array([np.mean(part**2) for part in np.array_split(error, count)])
    rms = float(np.sqrt(np.mean(error**2)))
    if count < 2:
        return Interval(rms, np.nan, np.nan, count)
    found = mean_interval(squares)
    return Interval(rms, float(np.sqrt(max(found.low, 0.0))), float(np.sqrt(found.high)), count)


def _pair(name: str, path: Path, truths: Mapping[str, Path], count: int, max_diff: float) -> tuple[Path, Path]:
    """Estimate and truth at the instants that they share."""
    if name not in truths and not (count == len(truths) == 1):
        hint = suggestion(name, truths, "Name the files, or the ids in them, alike.")
        raise InputError("vehicle", repr(name), f"has no truth among {', '.join(truths)}", hint)
    truth = truths.get(name) or next(iter(truths.values()))
    i, j = associated(path.t, truth.t, max_diff)
    return _at(path, i), _at(truth, j)


def _at(path: Path, k: Ints) -> Path:
    rotation = None if path.rotation is None else path.rotation[k]
    return Path(path.t[k], path.position[k], rotation, None if path.covariance is None else path.covariance[k])


def _moved(path: Path, motion: Alignment) -> Path:
    turn, cov = motion.rotation, path.covariance
    turned = None if cov is None else turn @ cov @ turn.T
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
