"""Relative measurements and messages of a log as links of a Recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from coopoc.arrays import Bools, Floats, Ints
from coopoc.world.fleet import Fleet
from coopoc.world.links import Links, wrap
from coopoc.world.recording import Recording
from coopoc.world.sensing import schedule
from coopoc.world.v2x import V2X

from .log_moved import Measured, brought, brought_in_body
from .log_rows import Rows
from .log_summary import Tally
from .log_vehicle import COURSE, Vehicle
from .rows import SAME

COMPONENTS = ("range", "azimuth", "inclination")


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


def linked(rows: Rows, vehicles: Mapping[str, Vehicle], grid: Floats, planar: bool, tally: Tally) -> Linked:
    """Links of all relative measurements and messages, at the nearest step to their time.

    A bearing becomes an azimuth by the heading of its observer at its own time; in body frames an azimuth becomes a
    bearing by the heading that was measured. Then all are brought to the step (`log_moved`). Of several measurements of
    a kind of one pair at a step the nearest in time is kept. Where heights are all 0, an inclination that was not
    measured is pi/2 beside a range and a direction. A message at a step without a measurement is a link without one.
    Where no message was logged at all, every vehicle sends at every step and all arrives at once.
    """
    ids = list(vehicles)
    there = np.stack([np.isfinite(one.velocity[:, 0]) for one in vehicles.values()], axis=1)
    body = any(one.yaw_rate is not None for one in vehicles.values())
    measured = _measured(rows, vehicles, grid, there, body, tally)
    messages = rows.take(rows.kind == "message")
    sent, arrival_of, broadcasts = _messages(messages, ids, grid, there, tally)
    keys = sorted(set(measured) | set(arrival_of))
    step, observer, neighbour = np.array(keys, dtype=np.int64).reshape(-1, 3).T
    relative = np.array([measured.get(key, (np.nan,) * 3) for key in keys]).reshape(-1, 3)
    if planar:
        flat = np.isfinite(relative[:, :2]).all(axis=1) & np.isnan(relative[:, 2])
        relative[flat, 2] = np.pi / 2
        if flat.any():
            tally.assume("inclinations are pi/2: no height was logged, so that all are taken to be in one plane")
    order = np.lexsort((np.where(np.isnan(relative[:, 0]), np.inf, relative[:, 0]), observer, step))
    if sent:
        arrival = np.array([arrival_of.get(key, -1) for key in keys], dtype=np.int64)
    else:
        arrival, broadcasts = step.copy(), there
        if len(keys):
            tally.assume("no messages were logged: every vehicle sends at every step, and all arrive at once")
    words = ("ranges", "bearings" if body else "azimuths", "inclinations or elevations")
    for name, what, column in zip(COMPONENTS, words, relative.T, strict=True):
        tally.count(what, _logged(rows, name, column))
    return Linked(Links(step[order], observer[order], neighbour[order]), relative[order], broadcasts, arrival[order])


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
    links, reach = recording.links, recording.relative[0, :, 0]
    marked = np.isin(links.neighbour, recording.landmarks)
    near = np.flatnonzero(~(reach > v2x.radius) & ~marked)
    key = links.step[near] * len(recording.ids) + links.observer[near]
    first = np.append(True, np.diff(key) != 0)[: len(key)]
    rank = np.arange(len(key)) - np.maximum.accumulate(np.where(first, np.arange(len(key)), 0))
    kept = np.union1d(near[rank < v2x.max_neighbours], np.flatnonzero(marked))
    fewer = Links(links.step[kept], links.observer[kept], links.neighbour[kept])
    parts: dict[str, Any] = {
        "gnss": recording.gnss,
        "velocity": recording.velocity,
        "relative": recording.relative[:, kept],
        "arrival": recording.arrival[:, kept],
    }
    broadcasts = recording.broadcasts
    if not logged:
        still = np.zeros((len(recording.t), len(recording.ids), 3))
        times = v2x.loss > 0 and recording.runs == 1
        runs = runs if times else recording.runs
        fleet = Fleet(recording.ids, recording.t, still, still)
        broadcasts, arrival = schedule(fleet, fewer, v2x, runs, seed)
        parts["arrival"] = np.where(np.isin(fewer.neighbour, recording.landmarks), -1, arrival)
        broadcasts = broadcasts & np.isfinite(recording.velocity[0, :, :, 0])
        broadcasts[..., list(recording.landmarks)] = False
        if times:
            parts = {name: np.broadcast_to(part, (runs, *part.shape[1:])) for name, part in parts.items()}
    return replace(recording, links=fewer, broadcasts=broadcasts, v2x=v2x, **parts)


def _measured(
    rows: Rows, vehicles: Mapping[str, Vehicle], grid: Floats, there: Bools, body: bool, tally: Tally
) -> dict[tuple[int, int, int], list[float]]:
    """(step, observer, neighbour) -> range m, azimuth rad (in body frames bearing), inclination rad."""
    ids = list(vehicles)
    rows = rows.take(rows.group == "relative")
    number = {name: k for k, name in enumerate(ids)}
    observer = np.array([number.get(name, -1) for name in rows.vehicle.tolist()], dtype=np.int64)
    partner = np.array([number.get(name, -1) for name in rows.partner.tolist()], dtype=np.int64)
    step, lag = _steps(rows.t, grid)
    value = rows.value.copy()
    component = np.array([_component(kind) for kind in rows.kind.tolist()], dtype=np.int64)
    turned = rows.kind == ("azimuth" if body else "bearing")
    for column, one in enumerate(vehicles.values()):
        mine = turned & (observer == column)
        value[mine] += (-1 if body else 1) * one.heading(rows.t[mine]) if one.heading is not None else np.nan
        if mine.any() and one.course:
            tally.assume(COURSE.format("{}", one.course), ids[column])
    value[turned] = np.arctan2(np.sin(value[turned]), np.cos(value[turned]))
    known = (observer >= 0) & (partner >= 0)
    inside = step >= 0
    both = known & inside
    both[both] = there[step[both], observer[both]] & there[step[both], partner[both]]
    for wrong, reason in (
        (~known, "relative measurements of members without a position"),
        (known & ~inside, "relative measurements outside the recording"),
        (known & inside & ~both, "relative measurements while one of the two is absent"),
        (both & np.isnan(value), f"{'azimuths' if body else 'bearings'} at times without a heading"),
    ):
        if wrong.any():
            tally.refuse(reason, int(wrong.sum()), rows.place(int(np.flatnonzero(wrong)[0])))
    good = np.flatnonzero(both & np.isfinite(value))
    good = good[np.argsort(np.abs(lag[good]), kind="stable")]
    which = Measured(value[good], component[good], step[good], lag[good], observer[good], partner[good])
    every = list(vehicles.values())
    moved = brought_in_body(which, every) if body else brought(which, every, float(grid[1] - grid[0]))
    moved = np.where(which.component == 1, wrap(moved), moved)
    found: dict[tuple[int, int, int], list[float]] = {}
    again: list[int] = []
    for k, brought_value in zip(good.tolist(), moved.tolist(), strict=True):
        entry = found.setdefault((int(step[k]), int(observer[k]), int(partner[k])), [np.nan] * 3)
        if np.isnan(entry[component[k]]):
            entry[component[k]] = brought_value
        else:
            again.append(k)
    if again:
        reason = "relative measurements beside a nearer one of the same pair, kind and step"
        tally.refuse(reason, len(again), rows.place(min(again)))
    return found


def _messages(
    rows: Rows, ids: Sequence[str], grid: Floats, there: Bools, tally: Tally
) -> tuple[bool, dict[tuple[int, int, int], int], Bools]:
    """Whether there are any, (step sent, receiver, sender) -> step of arrival or -1, and (T, N) who sends when."""
    number = {name: k for k, name in enumerate(ids)}
    broadcasts = np.zeros(there.shape, dtype=bool)
    arrivals: dict[tuple[int, int, int], int] = {}
    step, _ = _steps(rows.t, grid)
    dt = grid[1] - grid[0]
    for k in range(len(rows)):
        sender, at = number.get(rows.vehicle[k], -1), int(step[k])
        if sender < 0 or at < 0 or not there[at, sender]:
            reason = "messages of a sender that is absent or has no position"
            tally.refuse(reason, 1, rows.place(k))
            continue
        broadcasts[at, sender] = True
        named = rows.partner[k]
        receivers = [number.get(named, -1)] if named else [k for k in range(len(ids)) if k != sender]
        for receiver in receivers:
            if receiver < 0 or not there[at, receiver]:
                if named:
                    tally.refuse("messages to a receiver that is absent or has no position", 1, rows.place(k))
                continue
            late = rows.arrival[k] - rows.t[k]
            arrived = -1 if np.isinf(late) else at + max(int(np.ceil((late - 2 * SAME) / dt)), 0)
            key = (at, receiver, sender)
            before = arrivals.get(key, -1)
            if key in arrivals:
                tally.refuse("messages beside another of the same pair and step", 1, rows.place(k))
            arrivals[key] = arrived if before < 0 else min(before, arrived) if arrived >= 0 else before
        tally.count("messages", 1)
        tally.count("messages that were lost", int(np.isinf(rows.arrival[k])))
    return len(rows) > 0, arrivals, broadcasts


def _steps(t: Floats, grid: Floats) -> tuple[Ints, Floats]:
    """Nearest step of each time, -1 outside, and how far it is, s."""
    dt = grid[1] - grid[0]
    step = np.rint((t - grid[0]) / dt)
    step = np.where((step >= 0) & (step < len(grid)), step, -1).astype(np.int64)
    return step, np.where(step >= 0, t - grid[step], np.inf)


def _component(kind: str) -> int:
    return {"range": 0, "azimuth": 1, "bearing": 1, "inclination": 2}[kind]


def _logged(rows: Rows, name: str, column: Floats) -> int:
    """Components of the links that were logged, not assumed."""
    kinds = {"azimuth": ("azimuth", "bearing")}.get(name, (name,))
    return int(np.isfinite(column).sum()) if np.isin(rows.kind, list(kinds)).any() else 0
