"""Relative measurements and messages of a log as links of a Recording, each at the nearest step to its time."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

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
    there = np.stack([np.isfinite(member.velocity[:, 0]) for member in members.values()], axis=1)
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
    for k in np.unique(component).tolist():
        summary.count(words[k], int(np.isfinite(relative[:, k]).sum()))
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


def _columns(names: AnyArray, ids: Collection[str]) -> Ints:
    """(M,) columns of names, -1 where they are no member."""
    return pd.Index(list(ids)).get_indexer(pd.Index(names)).astype(np.int64)


def _measured(rows: Rows, members: Mapping[str, Member], there: Bools, steps: Steps) -> tuple[Ints, Ints, Floats]:
    """(M, 3) step, observer, neighbour, (M,) component, and (M,) range m, azimuth (in body frames bearing) rad or
    inclination rad, one of each."""
    observer, partner = (_columns(names, members) for names in (rows.vehicle, rows.partner))
    (step, lag), body, value = steps.nearest(rows.t), steps.body, rows.value.copy()
    component = np.array([COMPONENTS[kind] for kind in rows.kind.tolist()], dtype=np.int64)
    turned = rows.of("azimuth" if body else "bearing")
    for column, (name, member) in enumerate(members.items()):
        mine = turned & (observer == column)
        value[mine] += (-1 if body else 1) * member.heading(rows.t[mine]) if member.heading is not None else np.nan
        if mine.any() and member.course:
            steps.summary.assume(COURSE.format("{}", member.course), name)
    members_too, inside = (observer >= 0) & (partner >= 0), step >= 0
    both = members_too & inside & there[step, observer] & there[step, partner]
    good = both & np.isfinite(value)
    for wrong, reason in (
        (~members_too, "relative measurements of members without a position"),
        (members_too & ~inside, "relative measurements outside the recording"),
        (members_too & inside & ~both, "relative measurements while one of the two is absent"),
        (both & ~good, f"{'azimuths' if body else 'bearings'} at times without a heading"),
    ):
        steps.summary.refuse_rows(reason, rows, wrong)
    keys = np.column_stack([step, observer, partner, component])
    order = np.argsort(np.abs(lag), kind="stable")
    order = order[good[order]]
    keys, first = np.unique(keys[order], axis=0, return_index=True)
    again = np.sort(np.delete(order, first))
    steps.summary.refuse_rows("relative measurements beside a nearer one of the same pair, kind and step", rows, again)
    chosen = (step[order], lag[order], observer[order], partner[order])
    measured = Measured(value[order], component[order], *chosen)
    return keys[:, :3], keys[:, 3], _to_step(measured, list(members.values()), steps)[first]


def _messages(rows: Rows, ids: Collection[str], there: Bools, steps: Steps) -> tuple[Ints, Ints, Bools]:
    """(M, 3) step sent, receiver, sender, (M,) step of arrival or -1, and (T, N) who sends when."""
    sender, receiver, columns = _columns(rows.vehicle, ids), _columns(rows.partner, ids), np.arange(len(ids))
    (step, _), summary, to_all = steps.nearest(rows.t), steps.summary, rows.partner == ""
    sent = (sender >= 0) & (step >= 0) & there[step, sender]
    absent = sent & ~to_all & ~((receiver >= 0) & there[step, receiver])
    summary.refuse_rows("messages of a sender that is absent or has no position", rows, ~sent)
    summary.refuse_rows("messages to a receiver that is absent or has no position", rows, absent)
    broadcasts = np.zeros(there.shape, dtype=bool)
    broadcasts[step[sent], sender[sent]] = True
    meant = np.where(to_all[:, None], sender[:, None] != columns, receiver[:, None] == columns)
    k, j = np.nonzero(meant & there[step] & sent[:, None])
    steps_later = np.maximum(np.ceil((rows.arrival[k] - rows.t[k] - 2 * SAME) / steps.dt), 0)
    frame = pd.DataFrame({"step": step[k], "receiver": j, "sender": sender[k], "arrival": step[k] + steps_later})
    again = frame.duplicated(["step", "receiver", "sender"]).to_numpy()
    summary.refuse_rows("messages beside another of the same pair and step", rows, k[again])
    summary.count("messages", int(sent.sum()))
    summary.count("messages that were lost", int(np.isinf(rows.arrival[sent]).sum()))
    first = frame.groupby(["step", "receiver", "sender"], as_index=False)["arrival"].min()
    arrival = np.nan_to_num(first["arrival"], posinf=-1).astype(np.int64)
    return first[["step", "receiver", "sender"]].to_numpy(dtype=np.int64), arrival, broadcasts


def _to_step(rows: Measured, members: Sequence[Member], steps: Steps) -> Floats:
    """Values (M,) at their steps: z + f(now) - f(then), f being the range, azimuth or inclination of a vector.

    In the world `now` is the vector g from the observer to the partner at the step, from the last fixes and the
    odometry since, and `then` is g + lag du, with the difference du of their velocities. In body frames a bearing grows
    by lag w, with the observer's yaw rate w; what stands, and was measured by range and bearing at one time, moves by
    lag v, with the observer's velocity v; how a vehicle moves in the observer's frame is not known. Nothing is moved
    where the vectors or the range are not far longer than what lies between.
    """
    velocity, fixes, rate = (
        np.stack([getattr(member, name) for member in members], axis=1) for name in ("velocity", "gnss", "yaw_rate")
    )
    value, lag = rows.value, rows.lag[:, None]
    after = np.minimum(rows.step + (rows.lag > 0), len(velocity) - 1)

    def during(of_step: Floats, column: Ints) -> Floats:
        """(M, ...) means over the step in which each time lies; of the one before where the member is absent then."""
        absent = np.isnan(velocity[after, column, 0])
        return np.asarray(of_step[np.where(absent, rows.step, after), column])

    moved = lag * during(velocity, rows.observer)
    if steps.body:
        keys = np.column_stack([rows.step, rows.lag, rows.observer, rows.partner])
        same = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
        polar = np.tile([np.nan, np.nan, np.pi / 2], (len(same), 1))
        polar[same, rows.component] = value
        then = to_vector(polar)[same]
        then[~np.array([member.stands for member in members])[rows.partner]] = np.nan
        now = then + moved
        value = value + np.where(rows.component == 1, rows.lag * during(rate, rows.observer), 0.0)
    else:
        path = np.cumsum(np.nan_to_num(velocity) * steps.dt, axis=0)
        fixed = np.where(np.isfinite(fixes[..., 0]), np.arange(len(path))[:, None], -1)
        last = np.maximum.accumulate(fixed, axis=0)
        position = np.where(last[..., None] >= 0, (fixes - path)[last, np.arange(len(members))] + path, np.nan)
        now = position[rows.step, rows.partner] - position[rows.step, rows.observer]
        then = now + lag * during(velocity, rows.partner) - moved
    change = np.column_stack(spherical(*now.T)) - np.column_stack(spherical(*then.T))
    change[:, 1:] = wrap(change[:, 1:])
    distance = np.where(rows.component == 0, rows.value, np.inf)
    far = np.minimum(np.linalg.norm(now, axis=1), distance) > NEAR * np.linalg.norm(now - then, axis=1)
    value = value + np.where(far, change[np.arange(len(change)), rows.component], 0.0)
    return np.where(rows.component == 1, wrap(value), value)
