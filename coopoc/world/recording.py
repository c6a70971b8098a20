"""Recording: all that vehicles may see of a drive, in R noise realisations. It holds no truth."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ..arrays import TINY, Bools, Floats, Ints, checked, instance, last_true, plain, refuse, remade, texts, whole
from ..errors import InputError
from ..text import short_repr
from .fleet import check_steps, clock, columns, interval, names
from .links import Links, drop_steep_azimuths, stretches
from .plausible import MAX_POSITION, MAX_SPEED, MAX_YAW_RATE, headings, plausible, radians
from .sensors import Sensors
from .v2x import V2X

Vehicles = Sequence[int | str]
"""Columns or ids."""


@dataclass(frozen=True, eq=False)
class Body:
    """Yaw rates and headings that vehicles measure, in R runs of T steps.

    Args:
        yaw_rate: (R, T, N) rad/s, mean over the step that ends at t; NaN where the vehicle is absent.
        heading: (R, T, N) rad from +x, anticlockwise, of a compass; NaN where there is none.

    Raises:
        InputError: arrays of other shapes, or in degrees.

    >>> Body(np.zeros((1, 2, 1)), np.full((1, 2, 1), np.nan)).yaw_rate.shape
    (1, 2, 1)
    """

    yaw_rate: Floats
    heading: Floats

    __repr__ = short_repr
    __reduce__ = remade

    def __post_init__(self) -> None:
        shape = (-1, -1, -1)
        for name in ("yaw_rate", "heading"):
            self.__dict__[name] = checked(name, getattr(self, name), "(R, T, N)", shape)
            shape = self.yaw_rate.shape
        radians("yaw_rate", self.yaw_rate, MAX_YAW_RATE)
        headings(self.heading)


DEGREES_STD = 0.5
"""rad, of a standard deviation that is rather one in degrees."""
UNLIKELY = "unlikely: "
UNITS_NOTE = "velocities are in m/s, headings and yaw rates in radians and anticlockwise, headings from east"
"""First word of a note on what a recording holds, and what may be wrong with odometry."""
COMPARED_SECONDS, LONG_STDS, APART_SHARE, CONTRADICTING_SHARE = 10.0, 6.0, 0.4, 0.3
"""s between the fixes whose distance is compared with the odometry's; standard deviations of a fix, stated and as they
scatter, that the longer of the two must have (the shorter one: one); share of both lengths by which they contradict
each other; share of such pairs, of all."""
MAX_TAG = 100.0
"""m, from a vehicle's position to its antenna."""
NOTHING_SIMULATED = "nothing is simulated"
"""Words in the notes of a recording that holds measurements as they were logged."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Measurements of N vehicles over T steps in R runs, in the local east-north-up frame.

    Args:
        ids: (N,) names.
        t: (T,) s.
        gnss: (R, T, N, 3) m.
        velocity: (R, T, N, 3) m/s, with x_t ~ x_{t-1} + dt u_t; both NaN where absent, a fix alone where it is missing.
        links: L directed links; `observers` are the columns whose links were recorded.
        relative: (R, L, 3) range m, world azimuth rad, inclination rad of the neighbour as the observer sees it.
        broadcasts: (T, N) True where a vehicle broadcasts.
        arrival: (R, L) step at which the neighbour's broadcast of the link's step arrives, -1 if lost or not sent.
        sensors: what a method may know (the bias is not among it).
        v2x: the channel: neighbours, radius, rate, latency, loss, cap.
        notes: labels that every table and figure carries (what is simulated, what uses truth).
        body: yaw rates and headings of a recording in body frames: `velocity` is then forward, left and up, azimuths
            count from the observer's heading; None for a recording in the world frame.
        landmarks: columns of members that stand at their `gnss`, which is known exactly; they need no message, and
            links to them count in no budget.
        fix_factor: (T, N) by which the deviation of each fix is larger than `sensors` says; none: all are 1.
        motion_variance: (T, N) m^2/s by which each motion is less certain than `sensors` says, as of a vehicle without
            odometry beside others; none: all are 0.
        shown: columns of vehicles without odometry, whose velocity is what their fixes have shown.
        tags: (N, 3) m forward, left and up from the position of each vehicle to its antenna, between which ranges are;
            none: all are 0, as those of landmarks must be. Pose filters take them off.

    Raises:
        InputError: arrays of other shapes or kinds, links of steps or columns that are not there, more of them than
            `v2x.max_neighbours`, links of absent vehicles, a message that arrives before it is sent, infinite numbers.
    """

    ids: tuple[str, ...]
    t: Floats
    gnss: Floats
    velocity: Floats
    links: Links
    relative: Floats
    broadcasts: Bools
    arrival: Ints
    sensors: Sensors
    v2x: V2X
    observers: tuple[int, ...]
    notes: tuple[str, ...] = ()
    body: Body | None = None
    landmarks: tuple[int, ...] = ()
    fix_factor: Floats = ()  # type: ignore[assignment]
    motion_variance: Floats = ()  # type: ignore[assignment]
    shown: tuple[int, ...] = ()
    tags: Floats = ()  # type: ignore[assignment]

    __reduce__ = remade

    def __post_init__(self) -> None:
        for name, kind in (("links", Links), ("sensors", Sensors), ("v2x", V2X)):
            instance(name, getattr(self, name), kind)
        ids, t, links = names(self.ids), clock(self.t), len(self.links)
        gnss = checked("gnss", self.gnss, "(R, T, N, 3)", (-1, len(t), len(ids), 3))
        shapes = {
            "velocity": ("(R, T, N, 3)", gnss.shape, float),
            "relative": ("(R, L, 3)", (len(gnss), links, 3), float),
            "broadcasts": ("(T, N)", gnss.shape[1:3], bool),
            "arrival": ("(R, L)", (len(gnss), links), int),
            "observers": ("(O,)", (-1,), int),
        }
        self.__dict__.update(ids=ids, t=t, gnss=gnss, notes=texts("notes", self.notes))
        self.__dict__.update({name: checked(name, getattr(self, name), *shape) for name, shape in shapes.items()})
        self.__dict__["observers"] = tuple(np.asarray(self.observers).tolist())
        check_measurements(self.gnss, self.velocity, self.relative)
        for name in ("landmarks", "shown"):
            self.__dict__[name] = tuple(columns(name, getattr(self, name), ids))
        at, moves = (values[:, :, list(self.landmarks)] for values in (self.gnss, self.velocity))
        allowed, hint = "must be one position throughout, with a velocity of 0", "A vehicle is no landmark."
        refuse("landmarks", at, ~(at == at[:1, :1]) | (moves != 0), allowed, hint)
        vehicles = np.flatnonzero(~np.isin(self.links.neighbour, self.landmarks))
        check_links(self.links, self.observers, self.velocity, self.arrival, self.v2x.max_neighbours, vehicles)
        if self.body is not None:
            rate = checked("yaw_rate", instance("body", self.body, Body).yaw_rate, "(R, T, N)", gnss.shape[:3])
            wrong = np.isnan(rate) != np.isnan(self.velocity[..., 0])
            allowed = "must be there with a velocity, and only there"
            refuse("yaw_rate", rate, wrong, allowed, "A vehicle that stands has 0.")
        for name, least, stated in (("fix_factor", TINY, 1), ("motion_variance", 0.0, 0)):
            shape = gnss.shape[1:3] if plain(getattr(self, name)).size else (0,)
            values = checked(name, getattr(self, name), "(T, N) or (0,)", shape)
            wrong, allowed = ~((values >= least) & (values < np.inf)), f"must be {'>' * stated or '>='} 0 and finite"
            refuse(name, values, wrong, allowed, f"{stated} means as `sensors` states.")
            self.__dict__[name] = values
        given = plain(self.tags)  # empty and of objects where rows are not equally long
        tags = self.tags if given.size or given.dtype == object else np.zeros((len(ids), 3))
        self.__dict__["tags"] = tags = checked("tags", tags, "(N, 3)", (len(ids), 3))
        plausible("tags", tags, MAX_TAG)
        self.sensors.check_assumed()
        self.__dict__["notes"] = (*(note for note in self.notes if UNLIKELY not in note), *unlikely(self))

    @property
    def dt(self) -> float:
        """Sampling interval, s."""
        return interval(self.t)

    @property
    def fix_scale(self) -> Floats:
        """(T, N, 1) `fix_factor`, or ones."""
        return np.broadcast_to(self.fix_factor if self.fix_factor.size else 1.0, self.gnss.shape[1:3])[..., None]

    @property
    def motion_extra(self) -> Floats:
        """(T, N, 1) m^2 a step, of `motion_variance`, or zeros."""
        more = self.dt * self.motion_variance if self.motion_variance.size else 0.0
        return np.broadcast_to(more, self.gnss.shape[1:3])[..., None]

    @property
    def present(self) -> Bools:
        """(T, N) whether a member is there."""
        return np.isfinite(self.velocity[0, ..., 0])

    @property
    def vehicles(self) -> list[int]:
        """Columns of the members that are no landmarks."""
        return [k for k in range(len(self.ids)) if k not in self.landmarks]

    @property
    def measured(self) -> bool:
        """Whether the notes say that nothing is simulated."""
        return any(NOTHING_SIMULATED in note for note in self.notes)

    @property
    def unlikely(self) -> tuple[str, ...]:
        """The notes on what is unlikely, which every track of this recording has, too."""
        return tuple(note for note in self.notes if UNLIKELY in note)

    @property
    def runs(self) -> int:
        """R."""
        return int(self.gnss.shape[0])

    def of_runs(self, runs: slice | Ints) -> "Recording":
        """The same drive in some of its runs; a slice of them copies nothing.

        >>> from coopoc import Fleet, Sensors, observe
        >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
        >>> observe(fleet, Sensors(), runs=5).of_runs(slice(1, 4)).runs
        3
        >>> observe(fleet, Sensors(), runs=5).of_runs([4, 0]).runs
        2
        """
        if not isinstance(runs, slice):
            runs = checked("runs", runs, "(number of runs,)", (-1,), int)
            refuse("runs", runs, (runs < 0) | (runs >= self.runs), f"must be in 0..{self.runs - 1}", "Count from 0.")
        parts = {name: getattr(self, name)[runs] for name in ("gnss", "velocity", "relative", "arrival")}
        body = None if self.body is None else Body(self.body.yaw_rate[runs], self.body.heading[runs])
        return replace(self, body=body, **parts)

    def between(self, start: int, stop: int) -> "Recording":
        """Steps start..stop-1 of the drive; a message that arrives later is lost.

        >>> from coopoc import Fleet, Sensors, observe
        >>> fleet = Fleet(("a",), [0, 0.1, 0.2], np.zeros((3, 1, 3)), np.zeros((3, 1, 3)))
        >>> len(observe(fleet, Sensors()).between(1, 3).t)
        2
        """
        check_steps(start, stop, 0)
        kept = np.flatnonzero((self.links.step >= start) & (self.links.step < stop))
        part, links, arrival, body = slice(start, stop), self.links, self.arrival[:, kept], self.body
        return replace(
            self,
            t=self.t[part],
            gnss=self.gnss[:, part],
            velocity=self.velocity[:, part],
            links=Links(links.step[kept] - start, links.observer[kept], links.neighbour[kept]),
            relative=self.relative[:, kept],
            broadcasts=self.broadcasts[part],
            arrival=np.where((arrival >= 0) & (arrival < stop), arrival - start, -1),
            body=body and Body(body.yaw_rate[:, part], body.heading[:, part]),
            fix_factor=self.fix_factor[part],
            motion_variance=self.motion_variance[part],
        )

    def stretches(
        self, vehicle: int | str, shortest: int = 2, fixed: bool = True, known: bool = False
    ) -> tuple[tuple[int, int], ...]:
        """(start, stop) of the steps at which a vehicle is there without a break, each from a fix in all runs
        on, or else from the first step.

        `recording.between(start, stop)` is what a method takes that follows it.

        Args:
            vehicle: index or id.
            shortest: number of steps.
            fixed: whether each begins with a fix.
            known: whether the position at step 0 is, so that the first needs no fix there.

        >>> from coopoc import Fleet, Sensors, observe
        >>> fleet = Fleet(("a",), [0, 0.1, 0.2], np.zeros((3, 1, 3)), np.zeros((3, 1, 3)))
        >>> observe(fleet, Sensors()).stretches("a")
        ((0, 3),)
        """
        (col,) = columns("vehicle", [vehicle], self.ids)
        least, every = whole("shortest", shortest), not instance("fixed", fixed, bool)
        has_fix = np.asarray(np.isfinite(self.gnss[:, :, col, 0]).all(axis=0)) | every
        has_fix[: instance("known", known, bool)] = True
        there = self.present[:, col]
        firsts = [(a + int(np.argmax(has_fix[a:b])), b) for a, b in stretches(there) if has_fix[a:b].any()]
        return tuple((a, b) for a, b in firsts if b - a >= least)

    @cached_property
    def usable_relative(self) -> Floats:
        """(R, L, 3) `relative` without azimuths of what is straight above or below, as estimators take it."""
        return drop_steep_azimuths(self.relative)

    def observing(self, egos: Vehicles) -> list[int]:
        """Columns of the egos, absent or not; InputError if one is unknown or no observer of this recording."""
        cols = columns("egos", egos, self.ids)
        if not cols:
            raise InputError("egos", egos, "must name at least one vehicle", "Give [0] for the first.")
        observers = frozenset(self.observers)
        for ego, col in zip(egos, cols, strict=True):
            if col not in observers:
                allowed = f"has no links here, only {list(self.observers)} have"
                raise InputError("egos", repr(ego), allowed, "Name it in observe(..., observers=[...]).")
        return cols

    def columns(self, egos: Vehicles, fixed: bool = True) -> list[int]:
        """Columns of the egos; InputError if one is unknown, no observer of this recording, absent at times, or, if it
        must be `fixed`, without a first fix. Later ones may be missing (NaN)."""
        cols, fixed = self.observing(egos), instance("fixed", fixed, bool)
        for ego, column in zip(egos, cols, strict=True):
            if np.isnan(self.velocity[:, :, column]).any():
                hint = (
                    "Cut it with recording.between(...), recording.stretches(ego) names its parts, or choose another."
                )
                raise InputError("egos", repr(ego), "is absent at some steps", hint)
            if fixed and np.isnan(self.gnss[:, 0, column]).any():
                hint = "Cut the drive, or take the cooperative filter."
                raise InputError("egos", repr(ego), "has no fix at step 0", hint)
        return cols

    def __repr__(self) -> str:
        return (
            f"Recording({self.runs} runs x {len(self.t)} steps x {len(self.ids)} vehicles, {len(self.links)} links, "
            f"K <= {self.v2x.max_neighbours})"
        )


def check_recording(value: Any, body: bool = False) -> Recording:
    """The value if it is a Recording in the frame that is asked for, the world or its vehicles' own.

    Args:
        value: any object.
        body: whether it must be in body frames.

    Raises:
        InputError: anything else.
    """
    recording = instance("recording", value, Recording, "co.observe(fleet, sensors) makes one of a fleet.")
    if (recording.body is None) == body:
        hints = (
            "Take a pose filter, or co.in_world(recording) where there is a compass.",
            'observe(..., frame="body"), read_log(..., frame="body").',
        )
        frames = ("the world frame", "body frames")
        raise InputError("recording", f"in {frames[not body]}", f"must be in {frames[body]} here", hints[body])
    return recording


def check_measurements(gnss: Floats, velocity: Floats, relative: Floats) -> None:
    """InputError unless every number is finite or stands for a missing measurement.

    Args:
        gnss: (R, T, N, 3) m, NaN on all axes for a missing fix.
        velocity: (R, T, N, 3) m/s, NaN on all axes and in all runs for an absent vehicle.
        relative: (R, L, 3) m, rad, rad, NaN where a component was not measured.
    """
    if not len(gnss):
        raise InputError("gnss", "no run", "must have at least one", "Use observe(..., runs=1).")
    arrays = {"gnss": (gnss, MAX_POSITION), "velocity": (velocity, MAX_SPEED), "relative": (relative, MAX_POSITION)}
    for name, (values, limit) in arrays.items():
        plausible(name, values, limit)
        if np.isfinite(values.sum()):  # which needs no array of its own
            continue
        missing = np.isnan(values)
        if name != "relative":
            partly = missing != missing[..., :1]
            refuse(name, values, partly, "must be NaN on all axes or on none", "Set all three to NaN.")
        if name == "velocity":
            refuse(name, values, missing != missing[:1], "must be NaN in all runs or in none", "Absence is no noise.")
    radians("relative angles", relative[..., 1:])
    hint, ranges = "Make it NaN: no direction is seen in one place.", relative[..., 0]
    refuse("relative", ranges, ranges <= 0, "must be a range > 0 m", hint)


def check_links(
    links: Links, observers: tuple[int, ...], velocity: Floats, arrival: Ints, most: int, counted: Ints
) -> None:
    """InputError unless links join present vehicles, at most `most` per step and observer, and messages take time.

    Args:
        links: L directed links.
        observers: columns that may observe.
        velocity: (R, T, N, 3) m/s, NaN where absent.
        arrival: (R, L) step of arrival, -1 for never.
        most: largest number of neighbours.
        counted: indices of the links that count among them.
    """
    _, steps, vehicles, _ = velocity.shape
    columns = {"links.observer": links.observer, "links.neighbour": links.neighbour, "observers": np.array(observers)}
    for name, values in columns.items():
        refuse(name, values, (values < 0) | (values >= vehicles), f"must be in 0..{vehicles - 1}", "Name a column.")
    refuse("links.step", links.step, links.step >= steps, f"must be in 0..{steps - 1}", "Drop the links after the end.")
    refuse(
        "links.observer",
        links.observer,
        ~np.isin(links.observer, observers),
        "must be among the observers",
        "Add it there.",
    )
    absent = np.isnan(velocity[0, :, :, 0])
    for name in ("observer", "neighbour"):
        column = getattr(links, name)
        gone = absent[links.step, column]
        refuse(
            f"links.{name}", column, gone, "must be present at the link's step", "Drop the links of absent vehicles."
        )
    many, first = np.zeros(len(counted), bool), max(len(counted) - most, 0)
    step, observer = links.step[counted], links.observer[counted]
    many[most:] = (step[most:] == step[:first]) & (observer[most:] == observer[:first])
    refuse("links.observer", observer, many, f"must have at most max_neighbours = {most} a step", "Raise it.")
    early = (arrival < links.step) & (arrival != -1)
    refuse("arrival", arrival, early, "must be -1 (lost) or a step no earlier than the link's", "Count steps from 0.")


def unlikely(recording: Recording) -> tuple[str, ...]:
    """Notes on a recording whose settings or measurements are rather in other units, or contradict each other."""
    sensors = recording.sensors
    sentences = [
        f"{name} is {std:.3g} rad, which is {np.rad2deg(std):.0f}°"
        for name in ("azimuth_std", "inclination_std", "heading_std", "heading_bias_std", "yaw_rate_std")
        if (std := getattr(sensors, name)) > DEGREES_STD
    ]
    if recording.body is None and recording.tags.any():
        sentences.append(
            f"ranges between tags up to {abs(recording.tags).max():.2g} m from their vehicles are those between "
            'vehicles, as methods of positions take them; a PoseFilter (frame="body") takes off the tags'
        )
    if share := _contradicting(recording):
        sentences.append(f"fixes and odometry contradict each other in {100 * share:.0f} % of the drive: {UNITS_NOTE}")
    return tuple(UNLIKELY + text for text in sentences)


def _contradicting(recording: Recording) -> float:
    """Share of the pairs of fixes of the first run, `COMPARED_SECONDS` s apart, that contradict the odometry between
    them; 0 below `CONTRADICTING_SHARE`, and where too little moves. Without a heading only lengths are compared."""
    body, stated = recording.body, float(np.hypot(*recording.sensors.fix_std[:2]))
    lag = max(1, min(len(recording.t) - 1, round(COMPARED_SECONDS / recording.dt)))
    fixes, u = (values[0, ..., :2] @ [1, 1j] for values in (recording.gnss, recording.velocity))
    heading = np.zeros(u.shape)
    turned = heading
    if body is not None:
        heading, turned = body.heading[0], np.cumsum(np.nan_to_num(body.yaw_rate[0]), 0) * recording.dt
    path = np.cumsum(np.nan_to_num(u * np.exp(1j * turned)), axis=0) * recording.dt
    newest, column = last_true(np.isfinite(fixes))[::lag], np.arange(u.shape[1])
    ends = (values[newest, column] for values in (fixes, path, np.cumsum(np.isnan(u), 0)))
    moved, driven, gaps = (np.diff(values, axis=0) for values in ends)
    turn = np.exp(1j * (heading - turned))[newest[:-1], column]
    moved, driven = np.where(np.isnan(turn), (abs(moved), abs(driven)), (moved, driven * turn))
    rough = abs(np.diff(fixes, 2, axis=0))  # of white noise sqrt(6) times a fix's
    noise = max(np.median(rough[np.isfinite(rough)]) / 2.0 if np.isfinite(rough).any() else 0.0, stated)
    short, long = np.sort([abs(moved), abs(driven)], axis=0)
    far = (long > LONG_STDS * noise) & (short > noise) & ~np.isin(column, recording.shown)
    far &= (newest[:-1] >= 0) & (np.diff(newest, axis=0) > 0) & (gaps == 0)
    apart = far & (abs(moved - driven) > APART_SHARE * (abs(moved) + abs(driven)))
    share = float(apart.sum() / max(far.sum(), 1))
    return share if share > CONTRADICTING_SHARE and far.sum() > 2 else 0.0
