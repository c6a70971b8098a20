"""Plausibility: what nothing measures is refused; what is unlikely, as odometry that fixes contradict, is noted."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..arrays import Floats, refuse
from .links import wrap

if TYPE_CHECKING:
    from .recording import Recording

FARTHEST, FASTEST, FASTEST_TURN = 1e8, 1e4, 35.0
"""m, m/s and rad/s (2000 °/s): what lies beyond was not measured on Earth, and its square leaves no digits to what
stands beside it."""
TWO_TURNS, UNWRAPPED = 4 * np.pi, 1e6
"""rad, beyond which an angle is in degrees or unwrapped; and beyond which an unwrapped one has lost its digits."""
COARSE = 0.01
"""m, of the resolution of float32 that matters."""
WIDE = 0.5
"""rad, of a standard deviation that is rather one in degrees."""
UNLIKELY = "unlikely: "
UNITS = "velocities are in m/s, headings and yaw rates in radians and anticlockwise, headings from east"
"""First word of a note on what a recording holds, and what may be wrong with odometry."""
LAG, LONG, APART, SHARE = 10.0, 6.0, 0.4, 0.25
"""s between the fixes whose distance is compared with the odometry's; standard deviations of a fix that one of the two
must be long; share of both lengths by which they contradict each other; and share of such pairs, of all."""


def plausible(field: str, values: Floats, limit: float, hint: str = "Is it in another unit?") -> None:
    """InputError for the first number beyond the limit, and for positions that float32 has rounded; NaN is missing.

    >>> plausible("velocity", np.array([3.0, -1e9]), FASTEST)
    Traceback (most recent call last):
    coopoc.errors.InputError: velocity[1] = -1000000000.0: must be within +-10000 in SI units. Is it in another unit?
    """
    if not values.size:
        return
    largest = max(np.fmax.reduce(values, axis=None), -np.fmin.reduce(values, axis=None))
    if largest > limit:
        refuse(field, values, np.abs(values) > limit, f"must be within +-{limit:g} in SI units", hint)
    if (step := float(np.spacing(np.float32(largest)))) > COARSE and limit == FARTHEST:
        there = values[np.isfinite(values)]
        rounded = np.full(values.shape, bool((there == there.astype(np.float32)).all() and (there % 1).any()))
        allowed = f"must have more digits than those of float32, which are {step:g} m apart there"
        refuse(field, values, rounded, allowed, "Subtract a local origin before you convert to float32.")


def radians(field: str, values: Floats, limit: float = TWO_TURNS) -> None:
    """InputError for the first angle that is in degrees; NaN is missing.

    >>> radians("azimuth", np.array([90.0]))
    Traceback (most recent call last):
    coopoc.errors.InputError: azimuth[0] = 90.0: must be within +-12.5664 in SI units. Convert degrees by \
np.deg2rad, and wrap what is unwrapped.
    """
    plausible(field, values, limit, "Convert degrees by np.deg2rad, and wrap what is unwrapped.")


def headings(values: Floats, velocity: Floats | None = None) -> None:
    """InputError for headings (..., T, N) in degrees. They may be unwrapped, but do not jump by more than two turns, as
    degrees do at 360, and beyond two turns are no courses of velocities (T, N, 3) m/s once they are converted."""
    radians("heading", values, UNWRAPPED)
    wrong, far = np.abs(np.diff(values, axis=-2, prepend=values[..., :1, :])) > TWO_TURNS, np.abs(values) > TWO_TURNS
    if velocity is not None and far.any():
        moving = far & (np.abs(velocity[..., :2]).max(axis=-1) > 1.0)
        course = np.arctan2(velocity[..., 1], velocity[..., 0])
        off = [np.abs(wrap(turn - course))[moving] for turn in (values, np.deg2rad(values))]
        wrong |= moving & bool(moving.any() and np.median(off[1]) < min(0.2, np.median(off[0])))
    refuse(
        "heading",
        values,
        wrong,
        "must be in radians, and jump by less than two turns",
        "Convert degrees by np.deg2rad.",
    )


def unlikely(recording: Recording) -> tuple[str, ...]:
    """Notes on a recording whose settings or measurements are rather in other units, or contradict each other."""
    sensors, v2x = recording.sensors, recording.v2x
    found = [
        f"{name} is {std:.3g} rad, which is {np.rad2deg(std):.0f}°"
        for name in ("azimuth_std", "inclination_std", "heading_std", "heading_bias_std", "yaw_rate_std")
        if (std := getattr(sensors, name)) > WIDE
    ]
    if v2x.latency > v2x.max_age and len(recording.links):
        found.append(f"no message is used: latency is {v2x.latency:g} s, max_age {v2x.max_age:g} s")
    if share := _contradicting(recording):
        found.append(f"fixes and odometry contradict each other in {100 * share:.0f} % of the drive: {UNITS}")
    return tuple(UNLIKELY + text for text in found)


def _contradicting(recording: Recording) -> float:
    """Share of the pairs of fixes of the first run, `LAG` s apart, that contradict the odometry between them; 0 below
    `SHARE`, and where too little moves. Without a heading only the lengths are compared."""
    body, lag = recording.body, max(1, min(len(recording.t) - 1, round(LAG / recording.dt)))
    fixes, u = (values[0, ..., :2] @ [1, 1j] for values in (recording.gnss, recording.velocity))
    heading: Floats = np.zeros(u.shape)
    turned = heading
    if body is not None:
        heading, turned = body.heading[0], np.cumsum(np.nan_to_num(body.yaw_rate[0]), axis=0) * recording.dt
    path = np.cumsum(np.nan_to_num(u * np.exp(1j * turned)), axis=0) * recording.dt
    steps = np.where(np.isfinite(fixes), np.arange(len(u))[:, None], -1)
    newest, column = np.maximum.accumulate(steps, axis=0)[::lag], np.arange(u.shape[1])
    ends = (values[newest, column] for values in (fixes, path, np.cumsum(np.isnan(u), axis=0)))
    moved, driven, gaps = (np.diff(values, axis=0) for values in ends)
    turn = np.exp(1j * (heading - turned))[newest[:-1], column]
    moved, driven = np.where(np.isnan(turn), (np.abs(moved), np.abs(driven)), (moved, driven * turn))
    far = np.fmax(np.abs(moved), np.abs(driven)) > LONG * np.hypot(*recording.sensors.fix_std[:2])
    far &= (newest[:-1] >= 0) & (np.diff(newest, axis=0) > 0) & (gaps == 0)
    apart = far & (np.abs(moved - driven) > APART * (np.abs(moved) + np.abs(driven)))
    share = float(apart.sum() / max(far.sum(), 1))
    return share if share > SHARE and far.sum() > 2 else 0.0
