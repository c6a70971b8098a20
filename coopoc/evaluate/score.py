"""Scores of trajectories that anyone estimated, against a truth: APE, RPE, RT-LE, NEES and intervals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from ..arrays import Floats, Ints, checked, instance, named, number
from ..errors import InputError
from ..plugins import one_of, suggestion
from ..short_repr import short_repr
from .alignment import Alignment, align
from .association import associated
from .relative_error import Unit, ends, relative_error
from .score_remarks import remarks
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

    __repr__ = short_repr

    def __post_init__(self) -> None:
        count = len(checked("t", self.t, "(T,)", (-1,)))
        shapes = {"t": (count,), "position": (count, 3), "rotation": (count, 3, 3), "covariance": (count, 3, 3)}
        for name, shape in shapes.items():
            if name in ("t", "position") or getattr(self, name) is not None:
                axes = str(("T", *shape[1:])).replace("'", "")
                object.__setattr__(self, name, checked(name, getattr(self, name), axes, shape))


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
    nees: float | None
    remarks: tuple[str, ...] = field(default=())


def scores(
    estimates: Mapping[str, Path],
    truths: Mapping[str, Path],
    *,
    aligned: Aligned = "none",
    max_diff: float = 0.01,
    offset: float = 0.0,
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
        offset: s, added to the estimates' stamps.
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
    one_of("aligned", aligned, ("none", "each", "team"))
    one_of("unit", unit, get_args(Unit))
    hint = "Give vehicle -> Path."
    for side, paths in (("estimates", estimates), ("truths", truths)):
        if not named(side, paths, hint):
            raise InputError(side, "none", "must be at least one", hint)
        for name, path in paths.items():
            instance(f"{side}[{name!r}]", path, Path)
    blocks = number("blocks", blocks, 2, kind=int, allowed=">= 2")
    alone = len(estimates) == len(truths) == 1
    true_of = {name: _truth(name, truths, alone) for name in estimates}
    pairs = {}
    for name, path in estimates.items():
        i, j = associated(path.t, true_of[name].t, max_diff, offset)
        pairs[name] = _at(path, i), _at(true_of[name], j)
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
        stamps = estimates[name].t + offset, true_of[name].t
        found = remarks(stamps, (estimate.position, truth.position), max_diff)
        if len(ends(estimate.position, delta, unit)) < 2:
            found = (*found, f"no relative error: the drive is shorter than {delta:g} {unit}.")
        elif estimate.rotation is not None and truth.rotation is not None:
            both = (estimate.position, estimate.rotation), (truth.position, truth.rotation)
            relative = float(np.sqrt(np.square(relative_error(*both, delta, unit)).mean()))
        missed = len(estimates[name].t) - len(raw)
        spread = (rms_interval(raw, blocks), rms_interval(error, blocks), float(error.max()))
        rows.append(Score(name, len(raw), missed, *spread, relative, _nees(moved, truth), found))
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


def _truth(name: str, truths: Mapping[str, Path], alone: bool) -> Path:
    """The truth of that name, or the only one."""
    if name not in truths and not alone:
        hint = suggestion(name, truths, "Name the files, or the ids in them, alike.")
        raise InputError("vehicle", repr(name), f"has no truth among {', '.join(truths)}", hint)
    return truths.get(name) or next(iter(truths.values()))


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
