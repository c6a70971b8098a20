"""MDS: multidimensional scaling of the ranges among the ego and its neighbours, laid over their fixes, step by step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..errors import InputError
from ..plugins import one_of
from ..world.inbox import Inbox
from ..world.recording import Recording, check_recording
from ..world.v2x import FIX_AND_VELOCITY, Message
from .bridge import bridge
from .egos import Estimate, follow_egos
from .noise_model import NoiseModel, resolve
from .options import check_options
from .scaling import complete, fit, majorise, shape
from .star import StarStep, star_steps
from .track import Track


@dataclass(frozen=True, eq=False)
class MDS:
    """Per step: ranges, missing ones completed, classical scaling, Procrustes to the fixes (Borg and Groenen, "Modern
    Multidimensional Scaling", 2005, chapters 12 and 20).

    No step knows of another. The ego measures its own ranges; those among its neighbours come in their messages, where
    the recording has their links (`observe` with all vehicles as observers): the notes give their share. Shortest paths
    complete the rest. If all lead through the ego it seems to stand in the middle of its neighbours, and is worse off
    than with its fix alone (`town10`, K <= 10: 8.9 m against 6.1 m); `missing="angles"` takes those distances from the
    ego's azimuths and inclinations instead (3.6 m), which MDS as such does not use. With `iterations`, majorisation of
    measured ranges and fixes follows, weighted by their variances, whose limit is a local maximum of their likelihood.

    Fails where geometry does: in a platoon on one lane the shape has rank one, and across the lane all are put on one
    line through the fixes; vehicles on a plane leave z to the noise of the ranges; a reflection is decided by the fixes
    alone. It claims no covariance. Where no range connects two vehicles, their fixes give the distance.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        iterations: of majorisation, 0 for none.
        ranges: how many of its ranges, nearest first, a neighbour's message lists; 0 leaves the ego's star.
        missing: "paths" or "angles".
    """

    noise_model: NoiseModel | str = "nominal"
    iterations: int = 0
    ranges: int = 10
    missing: Literal["paths", "angles"] = "paths"
    name: str = "mds"
    cooperative: bool = True

    def __post_init__(self) -> None:
        check_options(self)
        for field in ("iterations", "ranges"):
            value = getattr(self, field)
            if value < 0:
                raise InputError(field, value, "must be a whole number >= 0", "Use 0 for none.")
        one_of("missing", self.missing, ("paths", "angles"))

    @property
    def message(self) -> Message:
        """Fix, velocity, id and time (8) and an id and a range per neighbour of the sender: the longest one."""
        return Message("fix, velocity and ranges", FIX_AND_VELOCITY.numbers + 2 * self.ranges)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent.

        Messages are no longer than the budget's `max_neighbours` makes them, and without ranges in a star.
        """
        recording, known, notes = bridge(recording, resolve(self.noise_model, recording))
        links = recording.links
        columns = check_recording(recording).columns(egos)
        neighbours = np.unique(links.neighbour[np.isin(links.observer, columns)])
        listed = min(self.ranges, recording.v2x.max_neighbours) if np.isin(neighbours, recording.observers).any() else 0
        method = replace(self, ranges=listed)
        find, count = _finder(recording, listed), np.zeros(2, dtype=np.int64)

        def follow(ego: int, box: Inbox) -> Iterator[Estimate]:
            return method._follow(recording, ego, box, known, find, count)

        track = follow_egos(method, recording, egos, follow, missing=True)
        between = f"{100 * count[0] / max(count[1], 1):.0f} % of the distances between neighbours were measured"
        return replace(track, covariance=None, notes=(between, *known.notes, *notes))

    def _follow(
        self, recording: Recording, ego: int, box: Inbox, known: NoiseModel, find: Finder, count: Ints
    ) -> Iterator[Estimate]:
        unclaimed = np.full((recording.runs, 3, 3), np.nan)
        for star in star_steps(recording, ego, box, known):
            span = slice(box.start[star.step], box.start[star.step + 1])
            sent = np.concatenate([np.full((recording.runs, 1), star.step), box.newest[:, span]], axis=1)
            members = np.concatenate([[ego], recording.links.neighbour[star.links]])
            measured = _ranges(recording, members, sent, find)
            measured[:, 0, 1:] = star.relative[..., 0]
            points = self._locate(measured, star, sent >= 0, known)
            pairs = np.isfinite(measured[:, 1:, 1:]) | np.isfinite(np.swapaxes(measured[:, 1:, 1:], 1, 2))
            count += np.array([pairs.sum(), pairs.size - len(pairs) * len(star.links)])
            theirs = np.where(sent[:, 1:, None] >= 0, points[:, 1:], np.nan)
            yield Estimate(star.step, points[:, 0], unclaimed, star.links, theirs)

    def _locate(self, measured: Floats, star: StarStep, held: Bools, known: NoiseModel) -> Floats:
        """Positions (R, n, 3) of the star from its ranges (R, n, n), and the fixes held (R, n)."""
        anchor_weight = np.where(held[..., None], 1.0 / star.fix_variance, 0.0)
        seen = np.concatenate([np.zeros((len(held), 1, 3)), star.vector], axis=1)
        apart = np.linalg.norm(seen[:, :, None] - seen[:, None], axis=-1) if self.missing == "angles" else None
        guess = np.linalg.norm(star.fix[:, :, None] - star.fix[:, None], axis=-1)
        apart = None if apart is None else np.where(np.isfinite(apart), apart, guess)
        distance = complete(measured, apart)
        distance = np.where(np.isfinite(distance), distance, guess)
        points = fit(shape(distance), star.fix, anchor_weight.mean(axis=2))
        if not self.iterations:
            return points
        ends = np.isfinite(measured) * 1.0
        variance = 1.0 if known.sensors is None else known.sensors.range_std**2
        return majorise(
            points, distance, (ends + np.swapaxes(ends, 1, 2)) / variance, star.fix, anchor_weight, self.iterations
        )


Finder = Callable[[Ints, Ints, Ints], Ints]


def _finder(recording: Recording, most: int) -> Finder:
    """Link index of (step, observer, neighbour), -1 if the observer's message at that step does not list it."""
    links, vehicles = recording.links, len(recording.ids)
    group = links.step * vehicles + links.observer
    first = np.searchsorted(group, group)
    listed = np.flatnonzero(np.arange(len(links)) - first < most)
    key = group[listed] * vehicles + links.neighbour[listed]
    order = np.argsort(key)
    key, listed = key[order], listed[order]

    def find(step: Ints, observer: Ints, neighbour: Ints) -> Ints:
        wanted = (step * vehicles + observer) * vehicles + neighbour
        if not len(key):
            return np.full(wanted.shape, -1)
        place = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
        return np.where(key[place] == wanted, listed[place], -1)

    return find


def _ranges(recording: Recording, members: Ints, sent: Ints, find: Finder) -> Floats:
    """(R, n, n) m, ranges in the members' newest messages, NaN where none."""
    if len(members) == 1:
        return np.full((recording.runs, 1, 1), np.nan)
    link = find(sent[:, :, None], members[None, :, None], members[None, None, :])
    known = (link >= 0) & (sent >= 0)[:, :, None]
    runs = np.arange(recording.runs)[:, None, None]
    return np.where(known, recording.relative[runs, np.maximum(link, 0), 0], np.nan)
