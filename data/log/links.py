"""Relative measurements and messages of a log as links of a Recording, each at the nearest step to its time."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from coopoc.arrays import AnyArray, Bools, Floats, Ints
from coopoc.world.fleet import Fleet
from coopoc.world.links import Links, spherical, to_vector, wrap
from coopoc.world.recording import Recording
from coopoc.world.sensing import schedule
from coopoc.world.v2x import V2X

from ..assemble import SAME
from ..planar import first_of_each
from .motion import COURSE, Member, Steps
from .units import Rows, Summary

COMPONENTS: Mapping[str, int] = {"range": 0, "azimuth": 1, "bearing": 1, "inclination": 2}
NEAR = 10.0
"""Distances, over what the two move until the step, below which the direction is not known well enough."""


class Linked(NamedTuple):
    """Links of a log, sorted as `Links` wants them.

    Attributes:
        links: who measured whom, or received a message of whom.
        relative: (L, 3) m, rad, rad, NaN where it was not measured.
        broadcasts: (T, N) True where a vehicle sends.
        arrival: (L,) step of arrival, -1 where lost or not sent.
    """

    links: Links
    relative: Floats
    broadcasts: Bools
    arrival: Ints


class Measured(NamedTuple):
    """M relative measurements of pairs that are there.

    Attributes:
        value: (M,) range m, azimuth (in body frames bearing) rad, or inclination rad.
        component: (M,) which of the three.
        step: (M,) nearest to its time.
        lag: (M,) s from the step to its time.
        observer: (M,) column of the vehicle that measured.
        partner: (M,) column of what was measured.
    """

    value: Floats
    component: Ints
    step: Ints
    lag: Floats
    observer: Ints
    partner: Ints


def linked(rows: Rows, members: Mapping[str, Member], steps: Steps) -> Linked:
    """Links of all relative measurements and messages.

    A bearing becomes an azimuth by the heading of its observer at its own time; in body frames an azimuth becomes a
    bearing by the heading that was measured. Then all are brought to the step. Of several measurements of a kind of one
    pair at a step the nearest in time is kept. Where heights are all 0, an inclination that was not measured is pi/2
    beside a range and a direction. A message at a step without a measurement is a link without one. Where no message
    was logged at all, every vehicle sends at every step and all arrives at once.
    """
    there = np.stack([np.isfinite(one.velocity[:, 0]) for one in members.values()], axis=1)
    summary, sent = steps.summary, rows.take(rows.of("message"))
    pairs, component, value = _measured(rows.take(rows.in_group("relative")), members, there, steps)
    messages, arrived, broadcasts = _messages(sent, tuple(members), there, steps)
    keys, index = np.unique(np.concatenate([pairs, messages]), axis=0, return_inverse=True)
    index = index.reshape(-1)
    relative, arrival = np.full((len(keys), 3), np.nan), np.full(len(keys), -1)
    relative[index[: len(pairs)], component] = value
    arrival[index[len(pairs) :]] = arrived
    if steps.planar:
        flat = np.isfinite(relative[:, :2]).all(axis=1) & np.isnan(relative[:, 2])
        relative[flat, 2] = np.pi / 2
        if flat.any():
            summary.assume("inclinations are pi/2: no height was logged, so that all are taken to be in one plane")
    if not len(sent):
        arrival, broadcasts = keys[:, 0].copy(), there
        if len(keys):
            summary.assume("no messages were logged: every vehicle sends at every step, and all arrive at once")
    words = ("ranges", "bearings" if steps.body else "azimuths", "inclinations or elevations")
    for k, what in enumerate(words):
        summary.count(what, int(np.isfinite(relative[:, k]).sum()) if (component == k).any() else 0)
    order = np.lexsort((np.nan_to_num(relative[:, 0], nan=np.inf), keys[:, 1], keys[:, 0]))
    return Linked(Links(*keys[order].T), relative[order], broadcasts, arrival[order])


def under(recording: Recording, v2x: V2X, *, runs: int = 1, seed: int = 0, logged: bool = True) -> Recording:
    """A real recording with the nearest K neighbours of a channel, and the logged messages, else those of the channel.

    Landmarks of a recording in body frames are no neighbours: all that are measured stay, and they send nothing.

    Args:
        recording: of a log, in one run.
        v2x: K, radius m, and the channel.
        runs: R, of simulated losses; without them all runs would be alike, and there is one.
        seed: of the channel.
        logged: whether the recording's messages are real, and stay as they are.
    """
    links, marks = recording.links, list(recording.landmarks)
    marked = np.isin(links.neighbour, marks)
    near = np.flatnonzero(~(recording.relative[0, :, 0] > v2x.radius) & ~marked)
    near = near[first_of_each(v2x.max_neighbours, links.step[near], links.observer[near])]
    kept = np.union1d(near, np.flatnonzero(marked))
    fewer = Links(links.step[kept], links.observer[kept], links.neighbour[kept])
    parts: dict[str, Any] = {"gnss": recording.gnss, "velocity": recording.velocity}
    parts |= {name: getattr(recording, name)[:, kept] for name in ("relative", "arrival")}
    broadcasts = recording.broadcasts
    if not logged:
        still = np.zeros((len(recording.t), len(recording.ids), 3))
        times = v2x.loss > 0 and recording.runs == 1
        runs = runs if times else recording.runs
        broadcasts, arrival = schedule(Fleet(recording.ids, recording.t, still, still), fewer, v2x, runs, seed)
        parts["arrival"] = np.where(np.isin(fewer.neighbour, marks), -1, arrival)
        broadcasts = broadcasts & np.isfinite(recording.velocity[0, :, :, 0])
        broadcasts[..., marks] = False
        if times:
            parts = {name: np.broadcast_to(part, (runs, *part.shape[1:])) for name, part in parts.items()}
    return replace(recording, links=fewer, broadcasts=broadcasts, v2x=v2x, **parts)


def of_vehicles(rows: Rows, landmarks: Collection[str], summary: Summary) -> Rows:
    """Rows in which vehicles measure: a range that a landmark measured is one to it; whatever else it measured or sent
    says nothing without its heading."""
    mine, theirs = (np.isin(names, list(landmarks)) for names in (rows.vehicle, rows.partner))
    turned = mine & ~theirs & rows.of("range")
    vehicle, partner = (np.where(turned, b, a) for a, b in ((rows.vehicle, rows.partner), (rows.partner, rows.vehicle)))
    left = mine & ~turned & rows.in_group("relative", "message")
    summary.refuse_rows("messages of landmarks, and what they measured but ranges to vehicles", rows, left)
    return replace(rows, vehicle=vehicle, partner=partner).take(~left)


def _columns(names: AnyArray, ids: Sequence[str]) -> Ints:
    number = {name: k for k, name in enumerate(ids)}
    return np.array([number.get(name, -1) for name in names.tolist()], dtype=np.int64)


def _measured(rows: Rows, members: Mapping[str, Member], there: Bools, steps: Steps) -> tuple[Ints, Ints, Floats]:
    """(M, 3) step, observer, neighbour, (M,) component, and (M,) range m, azimuth (in body frames bearing) rad or
    inclination rad, one of each."""
    observer, partner = (_columns(names, tuple(members)) for names in (rows.vehicle, rows.partner))
    (step, _), body, summary = steps.nearest(rows.t), steps.body, steps.summary
    lag = rows.t - steps.grid[step]
    value = rows.value.copy()
    component = np.array([COMPONENTS[kind] for kind in rows.kind.tolist()], dtype=np.int64)
    turned = rows.of("azimuth" if body else "bearing")
    for column, (name, one) in enumerate(members.items()):
        mine = turned & (observer == column)
        value[mine] += (-1 if body else 1) * one.heading(rows.t[mine]) if one.heading is not None else np.nan
        if mine.any() and one.course:
            summary.assume(COURSE.format("{}", one.course), name)
    value[turned] = np.arctan2(np.sin(value[turned]), np.cos(value[turned]))
    known, inside = (observer >= 0) & (partner >= 0), step >= 0
    both = known & inside & there[step, observer] & there[step, partner]
    for wrong, reason in (
        (~known, "relative measurements of members without a position"),
        (known & ~inside, "relative measurements outside the recording"),
        (known & inside & ~both, "relative measurements while one of the two is absent"),
        (both & np.isnan(value), f"{'azimuths' if body else 'bearings'} at times without a heading"),
    ):
        summary.refuse_rows(reason, rows, wrong)
    good = np.flatnonzero(both & np.isfinite(value))
    good = good[np.argsort(np.abs(lag[good]), kind="stable")]
    seen = Measured(value[good], component[good], step[good], lag[good], observer[good], partner[good])
    brought = _to_step(seen, list(members.values()), steps)
    brought = np.where(seen.component == 1, wrap(brought), brought)
    keys = np.column_stack([seen.step, seen.observer, seen.partner, seen.component])
    first = np.unique(keys, axis=0, return_index=True)[1]
    again = np.sort(np.delete(good, first))
    summary.refuse_rows("relative measurements beside a nearer one of the same pair, kind and step", rows, again)
    return keys[first, :3], keys[first, 3], brought[first]


def _messages(rows: Rows, ids: Sequence[str], there: Bools, steps: Steps) -> tuple[Ints, Ints, Bools]:
    """(M, 3) step sent, receiver, sender, (M,) step of arrival or -1, and (T, N) who sends when."""
    sender, receiver, every = _columns(rows.vehicle, ids), _columns(rows.partner, ids), np.arange(len(ids))
    (step, _), summary = steps.nearest(rows.t), steps.summary
    sent = (sender >= 0) & (step >= 0) & there[step, sender]
    to_all = rows.partner == ""
    here = there[step, receiver] & (receiver >= 0)
    summary.refuse_rows("messages of a sender that is absent or has no position", rows, ~sent)
    reason = "messages to a receiver that is absent or has no position"
    summary.refuse_rows(reason, rows, sent & ~to_all & ~here)
    broadcasts = np.zeros(there.shape, dtype=bool)
    broadcasts[step[sent], sender[sent]] = True
    meant = np.where(to_all[:, None], sender[:, None] != every, receiver[:, None] == every)
    k, j = np.nonzero(meant & there[step] & sent[:, None])
    late = rows.arrival[k] - rows.t[k]
    never = np.iinfo(np.int64).max
    after = np.maximum(np.ceil((np.nan_to_num(late, posinf=0.0) - 2 * SAME) / steps.dt), 0).astype(np.int64)
    arrived = np.where(np.isinf(late), never, step[k] + after)
    keys, index = np.unique(np.column_stack([step[k], j, sender[k]]), axis=0, return_inverse=True)
    first: Ints = np.full(len(keys), never)
    np.minimum.at(first, index.reshape(-1), arrived)
    _, once = np.unique(index, return_index=True)
    summary.refuse_rows("messages beside another of the same pair and step", rows, np.sort(np.delete(k, once)))
    summary.count("messages", int(sent.sum()))
    summary.count("messages that were lost", int(np.isinf(rows.arrival[sent]).sum()))
    return keys.reshape(-1, 3), np.where(first == never, -1, first), broadcasts


def _to_step(seen: Measured, members: Sequence[Member], steps: Steps) -> Floats:
    """Values (M,) at their steps: z + f(now) - f(then), f being the range, azimuth or inclination of a vector.

    In the world `now` is the vector g from the observer to the partner at the step, from the last fixes and the
    odometry since, and `then` is g + lag du, with the difference du of their velocities. In body frames a bearing grows
    by lag w, with the observer's yaw rate w; what stands, and was measured by range and bearing at one time, moves by
    lag v, with the observer's velocity v; how a vehicle moves in the observer's frame is not known. Nothing is moved
    where the vectors or the range are not far longer than what lies between.
    """
    velocity, fixes, rate = (
        np.stack([getattr(one, name) for one in members], axis=1) for name in ("velocity", "gnss", "yaw_rate")
    )
    lag = seen.lag[:, None]
    after = np.minimum(seen.step + (seen.lag > 0), len(velocity) - 1)

    def during(of_step: Floats, column: Ints) -> Floats:
        """(M, ...) means over the step in which each time lies; of the one before where the member is absent then."""
        absent = np.isnan(velocity[after, column, 0])
        return np.asarray(of_step[np.where(absent, seen.step, after), column])

    moved, value = lag * during(velocity, seen.observer), seen.value
    if steps.body:
        keys = np.column_stack([seen.step, seen.lag, seen.observer, seen.partner])
        same = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
        polar = np.tile([np.nan, np.nan, np.pi / 2], (len(same), 1))
        polar[same, seen.component] = seen.value
        then = to_vector(polar)[same]
        then[~np.array([one.stands for one in members])[seen.partner]] = np.nan
        now = then + moved
        value = value + np.where(seen.component == 1, seen.lag * during(rate, seen.observer), 0.0)
    else:
        path = np.cumsum(np.nan_to_num(velocity) * steps.dt, axis=0)
        known = np.where(np.isfinite(fixes[..., 0]), np.arange(len(path))[:, None], -1)
        last = np.maximum.accumulate(known, axis=0)
        place = np.where(last[..., None] >= 0, (fixes - path)[last, np.arange(len(members))] + path, np.nan)
        now = place[seen.step, seen.partner] - place[seen.step, seen.observer]
        then = now + lag * during(velocity, seen.partner) - moved
    change = np.column_stack(spherical(*now.T)) - np.column_stack(spherical(*then.T))
    change[:, 1:] = wrap(change[:, 1:])
    distance = np.where(seen.component == 0, seen.value, np.inf)
    far = np.minimum(np.linalg.norm(now, axis=1), distance) > NEAR * np.linalg.norm(now - then, axis=1)
    found: Floats = value + np.where(far, change[np.arange(len(change)), seen.component], 0.0)
    return found
