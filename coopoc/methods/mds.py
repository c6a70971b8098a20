"""MDS: classical multidimensional scaling of the ranges in a star, fitted to the fixes by weighted Procrustes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Floats, Ints
from ..world.inbox import Inbox
from ..world.recording import Recording, check_recording
from ..world.v2x import FIX_AND_VELOCITY, Message
from .egos import Estimate, follow_egos
from .noise_model import NoiseModel, resolve
from .star import StarStep, bridged, stars
from .track import Track, check_options

LISTED = 10
"""How many of its ranges, nearest first, a neighbour's message lists."""


@dataclass(frozen=True, eq=False)
class MDS:
    """Per step: ranges, missing ones completed, classical scaling, Procrustes to the fixes (Borg and Groenen, "Modern
    Multidimensional Scaling", 2005, chapters 12 and 20).

    No step knows of another. The ego measures its own ranges; those among its neighbours come in their messages, where
    the recording has their links (`observe` with all vehicles as observers): the notes give their share. Shortest paths
    complete the rest. If all lead through the ego it seems to stand in the middle of its neighbours, and is worse off
    than with its fix alone (`town10`, K <= 10: 8.9 m against 6.1 m; 3.6 m if those distances come from the ego's
    angles, which MDS as such does not use).

    Fails where geometry does: in a platoon on one lane the shape has rank one, and across the lane all are put on one
    line through the fixes; vehicles on a plane leave z to the noise of the ranges; a reflection is decided by the fixes
    alone. It claims no covariance. Where no range connects two vehicles, their fixes give the distance.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
    """

    noise_model: NoiseModel | str = "nominal"
    name: str = "mds"
    cooperative: bool = True
    message: Message = Message("fix, velocity and ranges", FIX_AND_VELOCITY.numbers + 2 * LISTED)

    def __post_init__(self) -> None:
        check_options(self)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent.

        Messages hold fix, velocity, id and time (8) and an id and a range per neighbour of the sender; they are no
        longer than the budget's `max_neighbours` makes them, and without ranges in a star.
        """
        known, links = resolve(self.noise_model, recording), recording.links
        columns = check_recording(recording).columns(egos, missing=True)
        neighbours = np.unique(links.neighbour[np.isin(links.observer, columns)])
        listed = min(LISTED, recording.v2x.max_neighbours) if np.isin(neighbours, recording.observers).any() else 0
        method = replace(self, message=Message(self.message.name, FIX_AND_VELOCITY.numbers + 2 * listed))
        find, count, unclaimed = _finder(recording, listed), np.zeros(2), np.full((recording.runs, 3, 3), np.nan)

        def run(ego: int, box: Inbox) -> Iterator[Estimate]:
            for star, held in bridged_stars(recording, ego, known, method.message, box):
                sent = np.append(np.full((recording.runs, 1), star.step), held, axis=1)
                measured = _ranges(recording, star.member, sent, find)
                measured[:, 0, 1:] = star.relative[..., 0]
                points = _locate(measured, star)
                pairs = np.isfinite(measured[:, 1:, 1:]) | np.isfinite(np.swapaxes(measured[:, 1:, 1:], 1, 2))
                count[:] += pairs.sum(), pairs.size - len(pairs) * len(star.link)
                theirs = np.where(held[..., None] >= 0, points[:, 1:], np.nan)
                yield Estimate(star.step, points[:, 0], unclaimed, star.link, theirs)

        track = follow_egos(method, recording, egos, run, missing=True)
        between = f"{100 * count[0] / max(count[1], 1):.0f} % of the distances between neighbours were measured"
        return replace(track, covariance=None, notes=(between, *known.notes, *bridging_note(recording)))


def bridged_stars(
    recording: Recording, ego: int, known: NoiseModel, message: Message, box: Inbox
) -> Iterator[tuple[StarStep, Ints]]:
    """The star at every step for a method without a memory, and the steps (R, n-1) of the messages held, -1 for none.

    Where a fix is missing the last one counts, moved by the vehicle's own odometry; without one yet, no position does.
    """
    x, variance = bridged(recording, known)
    variance = np.broadcast_to(variance, x.shape)
    for star in stars(recording, ego, known, message, sent=(x, variance)):
        star.position[:, 0], star.variance[:, 0] = x[:, star.step, ego], variance[:, star.step, ego]
        yield star, box.newest[:, box.start[star.step] : box.start[star.step + 1]]


def bridging_note(recording: Recording) -> tuple[str, ...]:
    """A note on `bridged`, where it has replaced fixes."""
    driving = np.isfinite(recording.velocity)
    share = 100 * (np.isnan(recording.gnss) & driving).sum() / driving.sum()
    note = f"{share:.0f} % of the fixes are missing: the last one is brought forward with the velocity"
    return () if recording.complete else (note,)


def complete(measured: Floats) -> Floats:
    """All distances: the mean of the two ends' measurements; where neither did, the shortest path.

    Args:
        measured: (B, n, n) m, NaN where i has not measured j.

    >>> nan = np.nan
    >>> complete(np.array([[[nan, 3, 5], [3, nan, nan], [nan, nan, nan]]]))[0, 1, 2]
    np.float64(8.0)
    """
    ends = np.stack([measured, np.swapaxes(measured, 1, 2)])
    known = np.isfinite(ends).sum(axis=0)
    direct = np.where(known > 0, np.nansum(ends, axis=0) / np.maximum(known, 1), np.inf)
    own = np.arange(measured.shape[1])
    direct[:, own, own] = 0.0
    path = direct.copy()
    for k in own:
        path = np.minimum(path, path[:, :, k, None] + path[:, None, k, :])
    return np.where(np.isfinite(direct), direct, path)


def shape(distance: Floats) -> Floats:
    """Classical scaling: X = V sqrt(Lambda) of the three largest eigenpairs of B = -1/2 J D^2 J, (B, n, 3) m, centred.

    Exact up to a rigid motion or reflection if the distances are those of points in space.

    Args:
        distance: (B, n, n) m, symmetric.

    >>> line = shape(np.abs(np.arange(3.0)[:, None] - np.arange(3.0))[None])[0]
    >>> np.abs(line[:, 0]).round(6).tolist()
    [1.0, 0.0, 1.0]
    """
    square = distance**2
    rows = square.mean(axis=2, keepdims=True)
    gram = -0.5 * (square - rows - np.swapaxes(rows, 1, 2) + rows.mean(axis=1, keepdims=True))
    value, vector = np.linalg.eigh(gram)
    top = min(3, distance.shape[1])
    points = np.zeros((*distance.shape[:2], 3))
    points[..., :top] = vector[..., -top:][..., ::-1] * np.sqrt(np.maximum(value[:, None, -top:], 0.0))[..., ::-1]
    return points


def fit(points: Floats, target: Floats, weight: Floats) -> Floats:
    """The points moved to the target: min over R in O(3) and t of sum_i w_i |R x_i + t - z_i|^2 (weighted Procrustes).

    R = V U^T of the singular vectors U S V^T of sum w (x - xm)(z - zm)^T: it is a reflection where that fits better,
    because distances do not distinguish a shape from its mirror image.

    Args:
        points: (B, n, 3) m.
        target: (B, n, 3) m.
        weight: (B, n) >= 0, not all zero.
    """
    share = (weight / weight.sum(axis=1, keepdims=True))[..., None]
    middle, there = (share * points).sum(axis=1, keepdims=True), (share * target).sum(axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(np.swapaxes(share * (points - middle), 1, 2) @ (target - there))
    moved: Floats = (points - middle) @ (u @ vt) + there
    return moved


def _locate(measured: Floats, star: StarStep) -> Floats:
    """Positions (R, n, 3) of the star from its ranges (R, n, n) and the positions that are held."""
    guess = np.linalg.norm(star.position[:, :, None] - star.position[:, None], axis=-1)
    distance = complete(measured)
    distance = np.where(np.isfinite(distance), distance, guess)
    return fit(shape(distance), star.position, (1.0 / star.variance).mean(axis=2))


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
        index = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
        return np.where(key[index] == wanted, listed[index], -1)

    return find


def _ranges(recording: Recording, members: Ints, sent: Ints, find: Finder) -> Floats:
    """(R, n, n) m, ranges in the members' newest messages, NaN where none."""
    if len(members) == 1:
        return np.full((recording.runs, 1, 1), np.nan)
    link = find(sent[:, :, None], members[None, :, None], members[None, None, :])
    known = (link >= 0) & (sent >= 0)[:, :, None]
    runs = np.arange(recording.runs)[:, None, None]
    return np.where(known, recording.relative[runs, np.maximum(link, 0), 0], np.nan)
