"""Track: a method's estimates of its egos, and their bytes. Method: the protocol that all follow; checks of options.

An ego that is absent for a while, or has no fix at first, is followed stretch by stretch.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import wraps
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from ..arrays import Bools, Floats, check_arrays, check_fields, checked, instance, named, number, refuse, remade, texts
from ..errors import InputError
from ..text import short_repr
from ..world.fleet import columns, long_table, same_drive
from ..world.recording import Recording, Vehicles, check_recording
from ..world.v2x import NO_MESSAGE, Message

if TYPE_CHECKING:
    import pandas as pd

UNSOUND = (
    "covariances are not symmetric and positive semidefinite: a method of one's own returns others, or the assumed "
    "standard deviations lie too far apart for double precision; raise the smallest"
)
"""Note on covariances that are none."""

ESTIMATES = "x", "covariance", "neighbours", "heading", "heading_covariance"
"""Arrays of a Track; None of what a method does not estimate."""


@dataclass(frozen=True, eq=False)
class Track:
    """Estimates of E egos over T steps in R runs.

    Args:
        t: (T,) s.
        egos: (E,) columns of the Recording.
        x: (R, T, E, 3) m.
        covariance: (R, T, E, 3, 3) m^2, or None if the method claims none.
        received_bytes: (R, E) bytes over the drive, payload and overhead.
        sent_bytes: (R, E) bytes over the drive, payload and overhead.
        seconds: wall time of the method, without loading libraries and compiling.
        neighbours: (R, L, 3) m estimate of each link's neighbour at the link's step, NaN where there is none; or None.
            The links are those of the egos, `recording.links.of(ego)` ego by ego, and no others of the fleet.
        notes: labels for tables and figures, such as "reconstruction".
        heading: (R, T, E) rad in [-pi, pi), or None of a method that does not estimate it.
        heading_covariance: (R, T, E, 4) of the heading with x, y, z and itself, m rad and rad^2; None as above.
        extras: other numbers by name, (R, T, E), or (R, L) by link; states with their standard deviations under the
            name and "_std".
        ids: of all vehicles of the Recording, so that no other fleet's truth is taken for theirs; () if unknown.
        absent: (T, E) True where an ego was not there, and its estimates are NaN; None: it always was.

    >>> covariance = np.full((1, 1, 1, 3, 3), 50.0) + 100.0 * np.eye(3)  # correlated, and sound
    >>> Track([0.0], (0,), np.zeros((1, 1, 1, 3)), covariance, [[0]], [[0]], 0.0).notes
    ()
    """

    t: Floats
    egos: tuple[int, ...]
    x: Floats
    covariance: Floats | None
    received_bytes: Floats
    sent_bytes: Floats
    seconds: float
    neighbours: Floats | None = None
    notes: tuple[str, ...] = ()
    heading: Floats | None = None
    heading_covariance: Floats | None = None
    extras: Mapping[str, Floats] = field(default_factory=dict)
    ids: tuple[str, ...] = ()
    absent: Bools | None = None

    __repr__ = short_repr
    __reduce__ = remade

    def __post_init__(self) -> None:
        egos = checked("egos", self.egos, "(E,)", (-1,), int)
        refuse("egos", egos, egos < 0, "must be >= 0", "Give columns of the recording, from 0 on.")
        self.__dict__["egos"] = tuple(egos.tolist())
        x = checked("x", self.x, "(R, T, E, 3)", (-1, -1, -1, 3))
        runs, steps = x.shape[:2]
        shapes = {
            "t": ("(T,)", (steps,)),
            "x": ("(R, T, E, 3)", (runs, steps, len(egos), 3)),
            "covariance": ("(R, T, E, 3, 3)", (*x.shape, 3)),
            "received_bytes": ("(R, E)", (runs, len(egos))),
            "sent_bytes": ("(R, E)", (runs, len(egos))),
            "neighbours": ("(R, L, 3)", (runs, -1, 3)),
            "heading": ("(R, T, E)", x.shape[:3]),
            "heading_covariance": ("(R, T, E, 4)", (*x.shape[:3], 4)),
        }
        check_arrays(self, shapes)
        late = np.append(True, np.diff(np.nan_to_num(self.t)) > 0)[:steps] == 0
        refuse("t", self.t, late | ~np.isfinite(self.t), "must be finite and increase", "Give seconds for every step.")
        for name in ("received_bytes", "sent_bytes"):
            moved = getattr(self, name)
            refuse(name, moved, ~(moved >= 0) | np.isinf(moved), "must be finite and >= 0", "Give 0 for none.")
        self.__dict__["seconds"] = number("seconds", self.seconds)
        for name in ("notes", "ids"):
            self.__dict__[name] = texts(name, getattr(self, name))
        if self.ids:
            columns("egos", self.egos, self.ids)
        by_name = named("extras", self.extras, "Give name -> (R, T, E), {} for none.")
        each, by_link = ("(R, T, E)", x.shape[:3]), {}
        if self.neighbours is not None:
            by_link[2] = "(R, L)", self.neighbours.shape[:2]
        extras = {name: checked(f"extras[{name}]", v, *by_link.get(np.ndim(v), each)) for name, v in by_name.items()}
        self.__dict__["extras"] = extras
        if self.absent is not None:
            self.__dict__["absent"] = checked("absent", self.absent, "(T, E)", x.shape[1:3], bool)
        there = np.ones(x.shape[1:3], bool) if self.absent is None else ~self.absent
        lost = there & ~np.isfinite(self.x).all(-1)
        if lost.any():
            run, step, ego = np.argwhere(lost)[0]
            raise InputError(
                "x",
                f"not finite in run {run} at step {step} of ego {self.egos[ego]}",
                "an estimate must be finite",
                "The method diverged: lower its gain, or check the assumed standard deviations.",
            )
        if self.covariance is not None:
            from ..kernels.covariances import unsound

            present = (self.covariance if self.absent is None else self.covariance[:, there]).reshape(-1, 3, 3)
            if (count := unsound(present)) and not any(UNSOUND in note for note in self.notes):
                self.__dict__["notes"] = (*self.notes, f"{count} of {len(present)} {UNSOUND}")

    def to_frame(self) -> "pd.DataFrame":
        r"""A row per run, step and ego, for pandas.

        Columns: `run`, `step`, `t` s, `ego` (the vehicle's id, or its column in the Recording where the track has no
        ids), `x`, `y`, `z` m; with a covariance `std_x`, `std_y`, `std_z` m, $\sqrt{P_{ii}}$; with a heading `heading`
        and `std_heading` rad; then the extras of shape (R, T, E).

        >>> Track([0.0], (0,), np.ones((1, 1, 1, 3)), None, [[0]], [[0]], 0.0).to_frame().columns.tolist()
        ['run', 'step', 't', 'ego', 'x', 'y', 'z']
        """
        runs, steps = self.x.shape[:2]
        egos = [self.ids[ego] for ego in self.egos] if self.ids else self.egos
        index = np.ogrid[:runs, :steps]
        columns = {"run": index[0][..., None], "step": index[1][..., None], "t": self.t[:, None]}
        columns |= {"ego": np.array(egos, object if self.ids else int)}
        columns |= {name: self.x[..., axis] for axis, name in enumerate("xyz")}
        if self.covariance is not None:
            columns |= {f"std_{name}": np.sqrt(self.covariance[..., axis, axis]) for axis, name in enumerate("xyz")}
        if self.heading is not None:
            columns["heading"] = self.heading
        if self.heading_covariance is not None:
            columns["std_heading"] = np.sqrt(self.heading_covariance[..., 3])
        return long_table(columns | {k: v for k, v in self.extras.items() if v.ndim == 3})


def of_recording(track: Track, recording: Recording) -> None:
    """InputError unless a track is one of this recording: of its runs, times and vehicles."""
    recording = instance("recording", recording, Recording, "Give the track first, then its recording.")
    same_drive(recording, instance("track", track, Track).ids or recording.ids, track.t)
    columns("egos", track.egos, recording.ids)
    if len(track.x) != recording.runs:
        raise InputError("track", f"{len(track.x)} runs", f"must have {recording.runs}", "Take recording.of_runs(...).")


LOST_STDS = 100.0
"""Standard deviations (norm of that of the fixes) between an estimate and a fix, beyond which a method is lost."""


def far_off(x: Floats, recording: Recording, columns: Sequence[int]) -> Bools:
    """(R, E) whether estimates (R, T, E, 3) m are ever farther from a fix than LOST_STDS standard deviations."""
    gap = recording.gnss.take(columns, axis=2)
    gap -= x
    far = np.einsum("...c,...c->...", gap, gap) > LOST_STDS**2 * np.square(recording.sensors.gnss_std).sum()
    return np.asarray(far.any(1))


@runtime_checkable
class Method(Protocol):
    """A frozen dataclass that is callable: recording, egos -> Track."""

    @property
    def name(self) -> str:
        """Name in tables, figures and the command line."""

    @property
    def cooperative(self) -> bool:
        """True if it uses other vehicles while it decides."""

    @property
    def message(self) -> Message:
        """The message that each vehicle broadcasts."""

    def __call__(self, recording: Recording, egos: Vehicles = (0,)) -> Track:
        """Estimates of the egos."""


class Alone:
    """A method of one vehicle by itself, which sends and receives nothing."""

    cooperative = False
    message = NO_MESSAGE


class Checked:
    """A dataclass whose options are checked when it is made.

    >>> from coopoc import JointFilter
    >>> JointFilter(exact="no")
    Traceback (most recent call last):
    coopoc.errors.InputError: exact = 'no': must be bool. Give JointFilter(exact=...).
    """

    def __post_init__(self) -> None:
        check_fields(self)


def start_of(x0: Floats | None, fixes: Floats) -> Floats:
    """A known start x0 (R, E, 3) or (E, 3) m, else the first fixes (R, E, 3) m; InputError for another shape or NaN."""
    if x0 is None:
        return fixes
    actual = f"shape {np.shape(x0)}" if np.isfinite(x0).all() else "not finite"
    if actual not in (f"shape {fixes.shape}", f"shape {fixes.shape[1:]}"):
        allowed = f"must be finite, (R, E, 3) = {fixes.shape} or (E, 3)"
        raise InputError("x0", actual, allowed, "Give one position per ego.")
    return np.broadcast_to(x0, fixes.shape)


def in_stretches(call: Callable[..., Track]) -> Callable[..., Track]:
    """A method's `__call__` that begins anew after each gap of an ego; its estimate is NaN where there is none.

    A position x0 that is known at first holds for a stretch that begins there.

    >>> from coopoc import Fleet, Kalman, Sensors, observe
    >>> fleet = Fleet(("a",), np.arange(6) / 10, np.zeros((6, 1, 3)), np.zeros((6, 1, 3)))
    >>> seen = observe(fleet, Sensors())
    >>> u = seen.velocity.copy()
    >>> u[:, 2] = np.nan
    >>> Kalman()(replace(seen, velocity=u)).absent.ravel().tolist()
    [False, False, True, False, False, False]
    """

    @wraps(call)
    def across(self: Any, recording: Recording, egos: Vehicles = (0,)) -> Track:
        columns = check_recording(recording).observing(egos)
        whole = (0, len(recording.t))
        known = (x0 := getattr(self, "x0", None)) is not None
        cuts = {column: recording.stretches(column, fixed=needs_fix(self), known=known) for column in columns}
        if all(pieces in ((), (whole,)) for pieces in cuts.values()):
            return noted(call(self, recording, egos))
        for column, pieces in cuts.items():
            if not pieces:
                never = "is never present at two successive steps with a fix"
                raise InputError("egos", repr(recording.ids[column]), never, "Choose another ego.")
        parts, starts = {}, start_of(x0, recording.gnss[:, 0, columns])
        for k, column in enumerate(columns):
            for cut in cuts[column]:
                own = replace(self, x0=None if cut[0] else starts[:, [k]]) if known else self
                parts[column, cut] = call(own, recording.between(*cut), [recording.ids[column]])
        return noted(_joined(recording, columns, parts))

    return across


def follow(method: Method, recording: Recording, egos: Vehicles) -> Track:
    """Track of any method across gaps, also of one that does not handle gaps itself."""
    instance("method", method, Method, "Give co.Kalman(), or one as in docs/extend.md.")  # type: ignore[type-abstract]
    return in_stretches(type(method).__call__)(method, recording, egos)


def needs_fix(method: Any) -> bool:
    """Whether a method can begin with a fix only."""
    return bool(getattr(method, "needs_fix", True))


def noted(track: Track) -> Track:
    """The track with a note of its gaps; InputError for an ego that has no estimate at all, or for what is no Track."""
    track = instance("what the method returns", track, Track, "docs/extend.md shows one.")
    if track.absent is None:
        return track
    for ego in np.array(track.egos)[track.absent.all(0)].tolist():
        hint = "Choose another ego, or measure ranges and both angles to neighbours that have fixes."
        raise InputError("egos", repr(track.ids[ego]), "has no fix, and no neighbour shows where it is", hint)
    gaps = f"absent, or not placed yet, at {track.absent.sum()} of {track.absent.size} steps: no estimate there"
    return replace(track, notes=tuple(dict.fromkeys((*track.notes, gaps))))


def _joined(recording: Recording, columns: list[int], parts: dict[tuple[int, tuple[int, int]], Track]) -> Track:
    """Tracks of one ego each, in stretches of the recording, as one of all."""
    (runs, steps), links = recording.gnss.shape[:2], recording.links
    own_links = [links.of(column) for column in columns]
    ends = np.cumsum([0, *map(len, own_links)])
    absent, notes, whole = np.ones((steps, len(columns)), bool), dict[str, None](), dict[str, Any]()
    received, sent = np.zeros((2, runs, len(columns)))
    for (column, (start, stop)), track in parts.items():
        e = columns.index(column)
        absent[start:stop, e] = False if track.absent is None else track.absent[:, 0]
        received[:, e] += track.received_bytes[:, 0]
        sent[:, e] += track.sent_bytes[:, 0]
        here = ends[e] + np.flatnonzero((links.step[own_links[e]] >= start) & (links.step[own_links[e]] < stop))
        for name, values in (*((name, getattr(track, name)) for name in ESTIMATES), *track.extras.items()):
            if values is None:
                continue
            by_link = name == "neighbours" or values.ndim == 2
            if name not in whole:
                size = (runs, ends[-1]) if by_link else (runs, steps, len(columns))
                whole[name] = np.full((*size, *values.shape[len(size) :]), np.nan)
            if by_link:
                whole[name][:, here] = values
            else:
                whole[name][:, start:stop, e] = values[:, :, 0]
        notes |= dict.fromkeys(track.notes)
    made = {name: whole.pop(name, None) for name in ESTIMATES}
    return Track(
        recording.t,
        tuple(columns),
        received_bytes=received,
        sent_bytes=sent,
        seconds=sum(track.seconds for track in parts.values()),
        notes=tuple(notes),
        extras=whole,
        ids=recording.ids,
        absent=absent,
        **made,
    )
