"""CooperativeGain: the joint filter of a star whose vehicles tell each other how large their noise is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from coopoc.arrays import Bools, Floats, Ints
from coopoc.errors import InputError
from coopoc.methods.egos import Estimate, follow_egos
from coopoc.methods.joint_filter import add_edges, predict
from coopoc.methods.knowledge import Knowledge
from coopoc.methods.network import apply, whitened
from coopoc.methods.star import StarStep, star_steps
from coopoc.methods.track import Track
from coopoc.world.inbox import Inbox
from coopoc.world.recording import Recording
from coopoc.world.v2x import Message

from .noise_net import NoiseNet, tell

NEWEST = Message("fix, velocity and noise", 14)
"""Fix (3), velocity (3), the variance of each (6), id and time (2)."""
SUMS = Message("sums since departure", 14, cumulative=True)
"""Motion (3), its variance (3), 1/r (3) and (fix - motion)/r (3), each summed since departure; id and time (2)."""


@dataclass(frozen=True, eq=False)
class ToldNoise(Knowledge):
    """What the nets of all vehicles tell in one recording, for any filter of a star.

    Args:
        fix, process: (R, T, N, 3) m^2. sensors: relative noise, from the data sheet: vehicles that drive alone in
            training show nothing of it.
    """

    fix: Floats | None = None
    process: Floats | None = None

    @classmethod
    def by(cls, model: NoiseNet, recording: Recording) -> ToldNoise:
        """By the same net on board of every vehicle."""
        fix, process = tell(model, recording)
        return cls("told", recording.sensors, fix=fix, process=process)

    def process_variance(self, recording: Recording, columns: Sequence[int] | None = None) -> Floats:
        """(R, T, N, 3) m^2, or the columns of it."""
        assert self.process is not None
        return self.process if columns is None else self.process.take(columns, axis=2)

    def fix_variance(self, recording: Recording) -> Floats:
        """(R, T, N, 3) m^2."""
        assert self.fix is not None
        return self.fix

    @property
    def gnss_variance(self) -> Floats:
        """There is no constant one: InputError."""
        raise InputError("knowledge", "told noise", "changes from fix to fix, and this method takes constants",
                         "Use a filter of a star, such as JointFilter, or another knowledge.")  # fmt: skip


class Heard(NamedTuple):
    """A step of the star with what its members told.

    Args:
        star: the step. news: (R, n) True where a message of this step says where the member is: then alone its sighting
            is used. lost: (R, n) True where nothing is known of it. worth: (R, n, 3) m^2, variance of a fix as it was
            last told, NaN if it never was.
    """

    star: StarStep
    news: Bools
    lost: Bools
    worth: Floats


@dataclass(frozen=True, eq=False)
class CooperativeGain:
    """Ego and neighbours in one state as in JointFilter, each with the noise that the net on board of it tells.

    Nobody is told the noise of GNSS and velocity; that of range and angles is the data sheet's. A neighbour is used
    when a message of it comes, so without any the ego is filtered exactly as by `NoiseFilter`.

    A message holds sums since departure. The receiver takes the difference to the last sums it has heard of that
    vehicle, so that a message also says what lost ones said: the whole motion in between with its noise, and all fixes
    in between, averaged along that motion. With `sums=False` it holds the newest fix and velocity, as JointFilter's.

    Args:
        noise: the net; or a Knowledge, which all vehicles then assume. sums: what messages hold. name: in tables.

    >>> CooperativeGain(NoiseNet()).message.payload
    56
    """

    noise: NoiseNet | Knowledge
    sums: bool = True
    name: str = "cooperative"
    cooperative: bool = True

    @property
    def message(self) -> Message:
        """What each vehicle broadcasts."""
        return SUMS if self.sums else NEWEST

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and their neighbours.

        Raises:
            InputError: an ego that is unknown or absent; sums over a channel that delays them.
        """
        if self.sums and recording.v2x.latency > 0:
            raise InputError("latency", f"{recording.v2x.latency} s", "must be 0 s with sums",
                             "Use CooperativeGain(noise, sums=False).")  # fmt: skip
        told = ToldNoise.by(self.noise, recording) if isinstance(self.noise, NoiseNet) else self.noise
        return follow_egos(
            self, recording, egos, lambda ego, box: self._follow(recording, ego, box, told), missing=True
        )

    def _follow(self, recording: Recording, ego: int, box: Inbox, told: Knowledge) -> Iterator[Estimate]:
        state: Floats = np.empty((recording.runs, 0, 3))
        spread: Floats = np.empty((recording.runs, 0, 0))
        worth = state
        for heard in (summed if self.sums else newest)(recording, ego, box, told):
            star = heard.star
            spread = revised(spread, worth, heard.worth, star.kept)
            state, spread = predict(state, spread, star)
            state, spread = update(state, spread, heard, told)
            state[:, 1:] = np.where(heard.lost[:, 1:, None], state[:, :1] + star.vector, state[:, 1:])
            worth = heard.worth
            yield Estimate(star.step, state[:, 0], spread[:, :3, :3], star.links, state[:, 1:])


def newest(recording: Recording, ego: int, box: Inbox, told: Knowledge) -> Iterator[Heard]:
    """Every step with the newest message of each member, as old as it may be."""
    runs, r = np.arange(recording.runs)[:, None], np.broadcast_to(told.fix_variance(recording), recording.gnss.shape)
    for star in star_steps(recording, ego, box, told):
        own, links = np.full_like(runs, star.step), slice(box.start[star.step], box.start[star.step + 1])
        sent = np.concatenate([own, box.newest[:, links]], axis=1)
        lost, members = sent < 0, np.concatenate([[ego], recording.links.neighbour[star.links]])
        yield Heard(star, ~lost, lost, np.where(lost[..., None], np.nan, r[runs, np.maximum(sent, 0), members]))


class Account(NamedTuple):
    """What is on record of vehicles, (R, n, ...): the sums (4) of the last message, motion m, its variance m^2, 1/r and
    (fix - motion)/r; its step, -1 before the first; whether it came since the vehicle joined the star; m that it was
    moved by guess since; m that it moves per step; variance of its fixes m^2, NaN if unknown."""

    sums: Floats
    step: Ints
    held: Bools
    guessed: Floats
    pace: Floats
    worth: Floats


def summed(recording: Recording, ego: int, box: Inbox, told: Knowledge) -> Iterator[Heard]:
    """Every step with all that each member did since its last message, where one has come now."""
    shape = (recording.runs, len(recording.ids))
    ledger, zero = np.zeros((*shape, 3, 4)), np.zeros((*shape, 3))
    r = np.broadcast_to(told.fix_variance(recording), recording.gnss.shape)
    process = np.broadcast_to(told.process_variance(recording), recording.gnss.shape)
    record = Account(ledger.copy(), np.full(shape, -1), np.zeros(shape, bool), zero, zero.copy(), zero + np.nan)
    for star in star_steps(recording, ego, box, told):
        t, links = star.step, slice(box.start[star.step], box.start[star.step + 1])
        step = recording.dt * recording.velocity[:, t]
        ledger += _entry(recording.gnss[:, t], step, r[:, t], process[:, t], ledger[..., 0])
        members = np.concatenate([[ego], recording.links.neighbour[star.links]])
        news = np.concatenate([np.ones((recording.runs, 1), bool), box.fresh[:, links]], axis=1)
        last = Account(record.sums[:, members], record.step[:, members], record.held[:, members],
                       record.guessed[:, members], record.pace[:, members], record.worth[:, members])  # fmt: skip
        last.held[:, star.kept < 0] = False
        heard, after = settled(star, last, news, ledger[:, members], r[:, t, members])
        for column, rows in zip(record, after, strict=True):
            column[:, members] = rows
        yield heard


def _entry(fix: Floats, step: Floats, r: Floats, process: Floats, moved: Floats) -> Floats:
    """What a step adds to the sums (R, N, 3, 4) of vehicles that have `moved` so far; what is missing adds nothing."""
    seen = np.isfinite(fix)
    weight = np.where(seen, 1.0 / r, 0.0)
    entry: Floats = np.nan_to_num(np.stack([step, process, weight, (fix - moved - step) / r], axis=-1))
    return entry


def settled(star: StarStep, last: Account, news: Bools, sums: Floats, r: Floats) -> tuple[Heard, Account]:
    """The star with what each member did since the message on record, where there is news (R, n), and the new record.

    Averaging n fixes along the motion adds (n - 1)(2n - 1) / (6 n^2) of the motion's variance to that of the average.
    Without news a member moves on as before; the next message takes that back, and its covariance waits for it.

    Args:
        sums: (R, n, 3, 4) of the messages. r: (R, n, 3) m^2, what they tell of a fix.
    """
    now, again = news[..., None], (news & last.held)[..., None]
    steps = (star.step - last.step)[..., None]
    moved, process, weight, pull = np.moveaxis(sums - last.sums, -1, 0)
    seen = news & (weight > 0).all(axis=-1)
    weight = np.where(seen[..., None], weight, 1.0)
    lag = (steps - 1) * (2 * steps - 1) / (6 * steps**2) * process
    step = replace(
        star, moved=np.where(again, moved - last.guessed, last.pace), process=np.where(again, process, 0.0),
        fix=pull / weight + sums[..., 0], fix_variance=1.0 / weight + lag, heard=seen,
    )  # fmt: skip
    held = news | last.held
    after = Account(
        np.where(now[..., None], sums, last.sums), np.where(news, star.step, last.step), held,
        np.where(now, 0.0, last.guessed + last.pace), np.where(again, moved / steps, np.where(now, 0.0, last.pace)),
        np.where(now, r, last.worth),
    )  # fmt: skip
    return Heard(step, news, ~held, after.worth), after


def revised(spread: Floats, before: Floats, now: Floats, kept: Ints) -> Floats:
    """Covariance (R, 3m, 3m) of the last star when the variances of its members' fixes are told anew.

    It is scaled, per axis, by the sum over members of 1/r as it was told `before` (R, m, 3) over what it is `now`
    (R, n, 3): what is known keeps its mean, and is worth what fixes are worth now. For one vehicle this is `filtered`.
    """
    stays = np.flatnonzero(kept >= 0)
    old, new = 1.0 / before[:, kept[stays]], 1.0 / now[:, stays]
    both = np.isfinite(old) & np.isfinite(new)
    old, new = (np.where(both, each, 0.0).sum(axis=1) for each in (old, new))
    ratio = np.divide(old, new, out=np.ones_like(old), where=new > 0)
    root = np.tile(np.sqrt(ratio), (1, before.shape[1]))
    return np.asarray(spread * root[:, :, None] * root[:, None])


def update(state: Floats, spread: Floats, heard: Heard, told: Knowledge) -> tuple[Floats, Floats]:
    """A linear update with fixes and converted sightings, then one Gauss-Newton step on range and angles, as
    JointFilter; the sighting of who says nothing counts nothing."""
    star, n = heard.star, state.shape[1]
    information, diagonal = np.linalg.inv(spread), np.arange(3 * n)
    weight = np.where(star.heard[..., None], 1.0 / star.fix_variance, 0.0)
    information[:, diagonal, diagonal] += weight.reshape(-1, 3 * n)
    pull = (weight * np.where(star.heard[..., None], star.fix - state, 0.0)).reshape(-1, 3 * n)
    known, gap = heard.news[:, 1:, None, None], state[:, 1:] - state[:, :1]
    root = np.where(known, whitened(gap, star.relative, told)[0], 0.0)
    edge, linear, push = np.swapaxes(root, -1, -2) @ root, information.copy(), pull.copy()
    add_edges(linear, push, edge, apply(edge, star.vector - gap))
    moved = np.linalg.solve(linear, push[..., None])[..., 0]
    point = state + moved.reshape(state.shape)
    root, residual = whitened(point[:, 1:] - point[:, :1], star.relative, told)
    root = np.where(known, root, 0.0)
    back, pull = np.swapaxes(root, -1, -2), pull - apply(information, moved)
    add_edges(information, pull, back @ root, apply(back, residual))
    cov = np.linalg.inv(information)
    return point + apply(cov, pull).reshape(state.shape), cov
