"""Association of relative measurements and messages of a log with steps and pairs: the links of a Recording."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pandas as pd
from numpy.linalg import norm
from pandas import DataFrame

from coopoc import V2X, Links, Recording, Sensors
from coopoc.arrays import Bools, Floats, Ints, last_true, runs_in_memory
from coopoc.world.links import spherical, wrap
from coopoc.world.sensing import schedule

from .motion import COURSE, Members, Steps, stacked
from .units import Rows, Summary, in_group, only, stated_std

COMPONENTS = {"range": 0, "azimuth": 1, "bearing": 1, "inclination": 2}
LINK_COLUMNS = ["step", "observer", "neighbour"]
NEAR_MOTIONS, NEAR_STDS = 10.0, 4.0
"""Distances, over what the two move until the step, and over the standard deviation of a fix, below both of which a
direction is not known well enough."""
RADAR = "{} ranges beside a direction count for who measured them alone: a radar's partner does not know them"
TWO_WAY = "{} ranges count for the other end, too: two-way ranging is known to both ends (else mutual=False)"


def linked(rows: Rows, members: Members, steps: Steps, mutual: bool) -> tuple[Links, Floats, Bools, Ints]:
    """Links of all relative measurements and messages.

    A bearing becomes an azimuth by the heading of its observer at its own time; in body frames an azimuth becomes a
    bearing by the heading that was measured. Then all are brought to the step. Of several measurements of a kind of one
    pair at a step the nearest in time is kept; a `mutual` range without a
    direction is one of the other end, too, if that has none. Where
    heights are all 0, an inclination that was not measured is pi/2 beside a range and a direction. A message at a step
    without a measurement is a link without one. Where no message was logged at all, every vehicle sends at every step
    and all arrives at once.

    Returns:
        Who measured whom, or received a message of whom; (L, 3) m, rad, rad, NaN where it was not measured; (T, N) True
        where a vehicle sends; (L,) step of arrival, -1 where lost or not sent.
    """
    there = np.isfinite(stacked(members, "velocity")[..., 0])
    summary, sent = steps.summary, only(rows, "message")
    measured = _measured(rows, members, there, steps)
    if mutual:
        far = measured[(measured["component"] == 0) & ~stacked(members, "stands")[measured["neighbour"]]]
        aimed = measured[measured["component"] == 1]
        reached = far.set_index(LINK_COLUMNS).index.isin(aimed.set_index(LINK_COLUMNS).index)
        if reached.any():
            summary.assume(RADAR, str(int(reached.sum())))
        back = far[~reached]
        heard = back["neighbour"] * len(members) + back["observer"]
        own = measured["observer"] * len(members) + measured["neighbour"]
        summary.reversed_pairs = np.setdiff1d(heard, own).tolist()
        both = pd.concat([measured, back.rename(columns={"observer": "neighbour", "neighbour": "observer"})])
        both = both.drop_duplicates([*LINK_COLUMNS, "component"])
        if len(both) > len(measured):
            summary.assume(TWO_WAY, str(len(both) - len(measured)))
        measured = both
    arrived, broadcasts = _messages(sent, tuple(members), there, steps)
    table = measured.pivot(index=LINK_COLUMNS, columns="component", values="value").reindex(columns=[0, 1, 2])
    table = table.join(arrived, how="outer").reset_index()
    table = table.iloc[np.lexsort((table[0], table["observer"], table["step"]))]
    relative, arrival = table[[0, 1, 2]].to_numpy(dtype=float), table["arrival"].fillna(-1).to_numpy(dtype=np.int64)
    if steps.planar:
        flat = np.isfinite(relative[:, :2]).all(1) & np.isnan(relative[:, 2])
        relative = np.where(flat[:, None] & (np.arange(3) == 2), np.pi / 2, relative)
        if flat.any():
            summary.assume("inclinations are pi/2: no height was logged, so that all are taken to be in one plane")
    links = Links(*table[LINK_COLUMNS].to_numpy(dtype=np.int64).T)
    if not len(sent):
        arrival, broadcasts = links.step.copy(), there
        if len(links):
            summary.assume("no messages were logged: every vehicle sends at every step, and all arrive at once")
    return links, relative, broadcasts, arrival


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
    rank = DataFrame({"step": links.step[near], "observer": links.observer[near]}).groupby(["step", "observer"])
    near = near[rank.cumcount() < v2x.max_neighbours]
    kept = np.union1d(near, np.flatnonzero(marked))
    recording = replace(with_links(recording, kept), v2x=v2x)
    if logged:
        return recording
    if v2x.loss > 0 and recording.runs == 1:
        runs = runs_in_memory(runs, 8 * recording.broadcasts.size + 4 * len(kept))
        recording = recording.of_runs(np.zeros(runs, int))
    broadcasts, arrival = schedule(recording.ids, recording.t, recording.links, v2x, recording.runs, seed)
    broadcasts = broadcasts & recording.present
    broadcasts[..., marks] = False
    return replace(recording, broadcasts=broadcasts, arrival=np.where(marked[kept], -1, arrival))


def with_links(recording: Recording, kept: Bools | Ints) -> Recording:
    """The recording with some of its links, and what was measured and arrives over these."""
    links = Links(*(each[kept] for each in (recording.links.step, recording.links.observer, recording.links.neighbour)))
    return replace(recording, links=links, relative=recording.relative[:, kept], arrival=recording.arrival[:, kept])


def of_vehicles(rows: Rows, landmarks: Collection[str], summary: Summary) -> Rows:
    """Rows in which vehicles measure: a range that a landmark measured is one to it; whatever else it measured or sent
    says nothing without its heading."""
    vehicle, partner = rows["vehicle"], rows["partner"]
    own, theirs = vehicle.isin(landmarks), partner.isin(landmarks)
    turned = own & ~theirs & (rows["kind"] == "range")
    left = own & ~turned & in_group(rows, "relative", "message")
    summary.refuse("messages of landmarks, and their measurements other than ranges to vehicles", rows[left])
    rows = rows.assign(vehicle=vehicle.mask(turned, partner), partner=partner.mask(turned, vehicle))
    return rows[~left]


def _columns(names: "pd.Series[str]", ids: Collection[str]) -> Ints:
    """(M,) columns of names, -1 where they are no member."""
    return pd.Index(list(ids)).get_indexer(pd.Index(names))


def _measured(rows: Rows, members: Members, there: Bools, steps: Steps) -> DataFrame:
    """One of each step, observer, neighbour (columns of members) and component of a link, with its value: range m,
    azimuth (in body frames bearing) rad or inclination rad."""
    std, rows = stated_std(rows, "x", "y"), rows[in_group(rows, "relative")]
    summary, body, value = steps.summary, steps.body, rows["value"].to_numpy(copy=True)
    observer, neighbour = (_columns(rows[who], members) for who in ("vehicle", "partner"))
    t, turned = rows["t"].to_numpy(), rows["kind"].eq("azimuth" if body else "bearing").to_numpy()
    step, lag = steps.nearest(t)
    for column, (name, member) in enumerate(members.items()):
        of_observer = turned & (observer == column)
        heading = member.heading.at(t[of_observer])
        value[of_observer] += -heading if body else heading
        if of_observer.any() and member.heading.source:
            summary.assume(COURSE.format("{}", member.heading.source), name)
    members_too, inside = (observer >= 0) & (neighbour >= 0), step >= 0
    both = members_too & inside & there[step, observer] & there[step, neighbour]
    good = both & np.isfinite(value)
    absent = {*rows["vehicle"], *rows["partner"]} - {*members}
    for wrong, reason in (
        (~members_too, f"relative measurements of members without a position ({', '.join(sorted(absent))})"),
        (members_too & ~inside, "relative measurements outside the recording"),
        (members_too & inside & ~both, "relative measurements while one of the two is absent"),
        (both & ~good, f"{'azimuths' if body else 'bearings'} at times without a heading"),
    ):
        summary.refuse(reason, rows[wrong])
    numbers = {"step": step, "lag": lag, "observer": observer, "neighbour": neighbour, "value": value}
    table = rows.assign(**numbers, component=rows["kind"].map(COMPONENTS).astype(int))[good]
    table = table.sort_values("lag", key=np.abs, kind="stable")
    again = table.duplicated([*LINK_COLUMNS, "component"])
    summary.refuse(
        "relative measurements beside a nearer one of the same pair, kind and step", table[again].sort_index()
    )
    table = table[~again]
    words = ("ranges", "bearings" if body else "azimuths", "inclinations or elevations")
    moved, vague, full = _to_step(table, members, steps, NEAR_STDS * (std if std > 0.0 else Sensors().gnss_std[0]))
    summary.refuse("relative measurements between steps, of partners too near to move them to one", table[vague])
    summary.refuse("relative measurements at their maximum, of partners farther away", table[full])
    kept: DataFrame = table.assign(value=moved).loc[~vague & ~full, [*LINK_COLUMNS, "component", "value"]]
    for word, number in zip(words, np.bincount(kept["component"], minlength=3).tolist(), strict=True):
        summary.count(word, number)
    return kept


def _messages(rows: Rows, ids: Collection[str], there: Bools, steps: Steps) -> tuple[DataFrame, Bools]:
    """Step of arrival, or -1, of each step, observer and neighbour with a message, and (T, N) who sends when."""
    sender, receiver = (_columns(rows[who], ids) for who in ("vehicle", "partner"))
    (step, _), summary, to_all = steps.nearest(rows["t"].to_numpy()), steps.summary, rows["partner"].eq("").to_numpy()
    sent = (sender >= 0) & (step >= 0) & there[step, sender]
    absent = sent & ~to_all & ~((receiver >= 0) & there[step, receiver])
    summary.refuse("messages of a sender that is absent or has no position", rows[~sent])
    summary.refuse("messages to a receiver that is absent or has no position", rows[absent])
    broadcasts = np.zeros(there.shape, bool)
    broadcasts[step[sent], sender[sent]] = True
    columns = np.arange(len(ids))
    meant = np.where(to_all[:, None], sender[:, None] != columns, receiver[:, None] == columns)
    k, j = np.nonzero(meant & there[step] & sent[:, None])
    late = (rows["arrival"] - rows["t"]).to_numpy()
    arrival = step[k] + np.maximum(np.ceil((late[k] - 2e-6) / steps.dt), 0.0)
    table = DataFrame({"step": step[k], "observer": j, "neighbour": sender[k], "arrival": arrival})
    summary.refuse(
        "messages beside another of the same pair and step", rows.iloc[k[table.duplicated(LINK_COLUMNS).to_numpy()]]
    )
    summary.count("messages", int(sent.sum()))
    summary.count("messages that were lost", int(np.isinf(late[sent]).sum()))
    return table.groupby(LINK_COLUMNS)[["arrival"]].min().replace(np.inf, -1), broadcasts


def _to_step(table: DataFrame, members: Members, steps: Steps, std: float) -> tuple[Floats, Bools, Bools]:
    """Values (M,) at their steps: z + f(g) - f(g + lag du), f being the range, azimuth or inclination of the vector g
    from the observer to the neighbour at the step, from the last fixes and the odometry since, and du the difference of
    their velocities in the world; and which are vague: g is no longer than `std` m and no more than NEAR_MOTIONS times
    lag du, or a range would not stay above 0. Nothing is moved where g or du is not known, but ranges and bearings of
    one time to what stands, which give g from the observer. In body frames a bearing grows by lag w, too, with the
    observer's yaw rate w. And which are as long as the longest range, where most of these fall short of g by more than
    `std`.
    """
    velocity, fixes, rate = (stacked(members, name) for name in ("moves", "gnss", "yaw_rate"))
    step, observer, neighbour, component = (table[name].to_numpy() for name in (*LINK_COLUMNS, "component"))
    value, lag = table["value"].to_numpy(), table["lag"].to_numpy()
    after = np.minimum(step + (lag > 0), len(velocity) - 1)

    def during(of_step: Floats, column: Ints) -> Floats:
        """(M, ...) means over the step in which each time lies; of the one before where the member is absent then."""
        return of_step[np.where(np.isnan(velocity[after, column, 0]), step, after), column]

    path = np.cumsum(np.nan_to_num(velocity) * steps.dt, 0)
    last = last_true(np.isfinite(fixes[..., 0]))
    position = np.where(last[..., None] >= 0, (fixes - path)[last, np.arange(len(members))] + path, np.nan)
    now = position[step, neighbour] - position[step, observer]
    then = now + lag[:, None] * (during(velocity, neighbour) - during(velocity, observer))
    change = np.column_stack(spherical(*now.T)) - np.column_stack(spherical(*then.T))
    change[:, 1:] = wrap(change[:, 1:])
    if steps.body:
        at_once = [table[name] for name in ("t", "observer", "neighbour")]
        far, aside = (table["value"].where(component == k).groupby(at_once).transform("first") for k in (0, 1))
        seen = np.array(far * np.exp(1j * aside))
        there = seen + lag * (during(stacked(members, "velocity"), observer)[:, :2] @ [1, 1j])
        less = np.column_stack([abs(there) - abs(seen), np.angle(there * seen.conj()), 0.0 * lag])
        stands = stacked(members, "stands")[neighbour] & np.isnan(change[:, 0])
        change = np.where(stands[:, None], less, change)
        value = np.where(component == 1, value + lag * during(rate, observer), value)
    distance = np.where(component == 0, value, np.inf)
    away = norm(now, axis=1)
    full = (component == 0) & (value == value[component == 0].max(initial=0.0))
    full &= full.any() and np.median(np.nan_to_num(away - value)[full]) > std
    gap, far = np.minimum(away, distance), NEAR_MOTIONS * norm(now - then, axis=1)
    value = value + np.nan_to_num(change[np.arange(len(change)), component])
    vague = ((gap <= far) & (gap <= std)) | ((component == 0) & (value <= 0.0))
    return np.where(component == 1, wrap(value), value), vague, full
