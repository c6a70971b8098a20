"""Clients: the training drives, each with its own noise, cut into private segments."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from math import nan
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from coopoc import V2X, Fleet, InputError, Sensors, observe
from coopoc.arrays import TINY, AnyArray, Floats, check_fields, instance, number, one_of, whole
from coopoc.text import short_repr
from coopoc.world.sensors import stream

Start = Literal["gnss", "true"]
LONG_PIECES = 9
"""Training pieces that a long piece is as long as: 900 steps, the paper's test drive."""


class Batch(NamedTuple):
    """Input of S models, B segments each: gnss, NaN where a fix is missing, velocity, truth, NaN where there is none
    and no loss counts (T, S, B, 3); x0 (S, B, 3); dt s; whether x0 is the truth; factors (T + 1, S, B, 1) of the
    deviations of fixes from that of x0 on, None where all are 1."""

    gnss: Tensor
    velocity: Tensor
    truth: Tensor
    x0: Tensor
    dt: float
    exact: bool = False
    scale: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Segments:
    """n sub-trajectories of T steps after a start sample, in float32, each relative to an origin near it.

    Args:
        gnss: (n, T + 1, 3) m; sample 0 only starts the filter.
        velocity: (n, T + 1, 3) m/s.
        truth: (n, T + 1, 3) m.
        true_start: whether the filter starts at the truth (KalmanNet's published loop) or at the first fix.
        dt: s.
        scale: (n, T + 1, 1) factors of the deviations of fixes, as `Recording.fix_scale`; None: all are 1.
    """

    gnss: Tensor
    velocity: Tensor
    truth: Tensor
    true_start: bool
    dt: float
    scale: Tensor | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_fields(self, {"dt": (1e-9, 1e9, "> 0 s")})
        shape = tuple(self.truth.shape)
        for name, wanted in {"gnss": shape, "velocity": shape, "truth": (*shape[:2], 3)}.items():
            actual = tuple(getattr(self, name).shape)
            if actual != wanted:
                allowed = "must be a tensor (n, T + 1, 3) as the others are"
                raise InputError(name, f"shape {actual}", allowed, "Make segments with learned.clients(...).")

    def __len__(self) -> int:
        return len(self.truth)

    def batch(self, index: Tensor) -> Batch:
        """Segments `index` (S, B)."""
        drives = torch.from_numpy(self._drives.take(index.numpy(), axis=2))
        gnss, velocity, truth = drives[:, 1:].unbind()
        scale = None if self.scale is None else self.scale[index].movedim(2, 0)
        return Batch(gnss, velocity, truth, drives[2 * self.true_start, 0], self.dt, self.true_start, scale)

    @cached_property
    def _drives(self) -> AnyArray:
        """gnss, velocity and truth (3, T + 1, n, 3) with time first, as a batch has it."""
        return np.ascontiguousarray(np.stack([self.gnss, self.velocity, self.truth]).swapaxes(1, 2))

    def take(self, index: Sequence[int]) -> "Segments":
        """The pieces `index`."""
        return self._each(lambda name: getattr(self, name)[list(index)])

    @classmethod
    def join(cls, parts: "Sequence[Segments]") -> "Segments":
        """All pieces of several parts in their order; the parts agree in dt and start. Behind the end of shorter ones
        there is neither a fix nor a truth.

        >>> each = [Segments(*torch.ones(3, 1, steps, 3), True, 0.1) for steps in (2, 4)]
        >>> Segments.join(each).truth[0, :, 0], Segments.join(each).velocity[0, :, 0]
        (tensor([1., 1., nan, nan]), tensor([1., 1., 0., 0.]))
        """
        agreed = {(p.dt, p.true_start) for p in parts}
        if len(agreed) != 1:
            raise InputError("pieces", agreed, "must agree in dt and start", "Cut all clients alike.")
        if any(p.scale is not None for p in parts):
            parts = [p if p.scale is not None else replace(p, scale=torch.ones_like(p.gnss[..., :1])) for p in parts]
        beyond, longest = {"velocity": 0.0, "scale": 1.0}, max(p.truth.shape[1] for p in parts)

        def padded(part: Segments, name: str) -> Tensor:
            return pad(getattr(part, name), (0, 0, 0, longest - part.truth.shape[1]), value=beyond.get(name, nan))

        return parts[0]._each(lambda name: torch.cat([padded(part, name) for part in parts]))

    def double(self) -> "Segments":
        """The same pieces in float64."""
        return self._each(lambda name: getattr(self, name).double())

    def _each(self, made: Callable[[str], Tensor]) -> "Segments":
        """The same pieces with every tensor field replaced by what `made` gives for its name."""
        tensors: dict[str, Any] = {
            f.name: made(f.name) for f in fields(self) if isinstance(getattr(self, f.name), Tensor)
        }
        return replace(self, **tensors)


def mirrored(batch: Batch, draws: Sequence[torch.Generator]) -> Batch:
    """Each piece (S, B) mirrored at random: the sign of every axis, and x exchanged with y, from S generators.

    Neither the motion nor the noise of the training drives prefers east to west or east to north, but a net trained on
    a few streets does: its features are directions in the world frame.

    >>> here = torch.tensor([1.0, 2.0, 3.0]).expand(2, 1, 400, 3)
    >>> made = mirrored(Batch(here, here, here, here[0], 0.1), [torch.Generator()]).gnss.mean(dim=(0, 1, 2))
    >>> bool((made.abs() < 0.4).all())
    True
    """
    dice = torch.stack([torch.rand((batch.x0.shape[1], 4), generator=draw) for draw in draws])
    signs, swap = torch.where(dice[..., :3] < 0.5, -1.0, 1.0), dice[..., 3:] < 0.5

    def turn(vectors: Tensor) -> Tensor:
        return torch.where(swap, vectors.index_select(-1, torch.tensor([1, 0, 2])), vectors) * signs

    gnss, velocity, truth = turn(torch.stack([batch.gnss, batch.velocity, batch.truth])).unbind()
    return batch._replace(gnss=gnss, velocity=velocity, truth=truth, x0=turn(batch.x0))


@dataclass(frozen=True, eq=False)
class Client:
    """One vehicle with its private pieces, disjoint for training and validation, and its drive in long pieces.

    Nothing is trained on `long`: it shows whether a net that learned from short pieces holds over a whole drive.
    """

    name: str
    training: Segments
    validation: Segments
    long: Segments

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("training", "validation", "long"):
            check_segments(name, getattr(self, name))


def check_segments(field: str, value: object) -> None:
    """InputError unless these are Segments of at least one piece."""
    if not len(instance(field, value, Segments)):
        raise InputError(
            field, "no piece", "must have at least one", "Give a longer drive, or one that begins at a fix."
        )


def clients(
    fleet: Fleet,
    sensors: Sensors | None = None,
    *,
    seed: int = 0,
    start: Start = "gnss",
    piece: int = 100,
    split: float = 0.8,
) -> tuple[Client, ...]:
    """Every vehicle of a training fleet as a client: its noisy drive in pieces, `split` of them for training.

    A piece is `piece` steps after one start sample; the last incomplete one, and one that begins without a fix, are
    dropped. Which pieces validate is drawn
    once from the seed, and so is the noise, as the paper implies.

    Args:
        fleet: drives (T, N); a vehicle may leave early.
        sensors: default `Sensors.paper_training()`.
        seed: of noise and split.
        start: "gnss" (first fix) or "true".
        piece: steps of a segment.
        split: share of the segments that train.

    Raises:
        InputError: a choice that does not exist, or a vehicle with fewer than two pieces.

    References:
        arXiv 2411.05847, section IV.A; KalmanNet_TSP for the start at the truth.

    >>> t = np.arange(303) / 10
    >>> line = Fleet(("a",), t, np.zeros((303, 1, 3)), np.zeros((303, 1, 3)))
    >>> [(len(c.training), len(c.validation)) for c in clients(line)]
    [(2, 1)]
    """
    one_of("start", start, Start)
    check_pieces(piece, split)
    fleet = instance("fleet", fleet, Fleet)
    sensors = Sensors.paper_training() if sensors is None else instance("sensors", sensors, Sensors)
    recording = observe(fleet, sensors, V2X(max_neighbours=0, rate=1 / fleet.dt), seed=seed)
    agreed, longest = [], min(LONG_PIECES * piece, max(int(fleet.present.sum(0).min()) - 1, 1))
    for column, name in enumerate(fleet.ids):
        there = np.flatnonzero(fleet.present[:, column])
        if len(there) and there[-1] - there[0] >= len(there):
            raise InputError("fleet", f"{name} leaves and comes back", "must be one drive", "Cut it with between(...).")
        drive = [a[there, column] for a in (recording.gnss[0], recording.velocity[0], fleet.position)]
        pieces = _cut(drive, piece, fleet.dt, start)
        if len(pieces) < 2:
            hint = f"Give it at least {2 * (piece + 1)} steps or shorten the pieces."
            raise InputError("fleet", f"{name} with {len(pieces)} pieces of {piece}", "needs at least two", hint)
        order = stream(seed, "split", 0, name).permutation(len(pieces)).tolist()
        count = min(max(int(split * len(pieces)), 1), len(pieces) - 1)
        long = _cut(drive, longest, fleet.dt, start)
        training, validation = pieces.take(sorted(order[:count])), pieces.take(sorted(order[count:]))
        agreed.append(Client(name, training, validation, long))
    return tuple(agreed)


def check_pieces(piece: int, split: float) -> None:
    """InputError unless drives can be cut into pieces so long, of which this share trains."""
    whole("piece", piece, 2, hint="The paper has 100 steps.")
    number("split", split, TINY, np.nextafter(1.0, 0.0), allowed="in (0, 1)", hint="The paper has 0.8.")


def _cut(drive: Sequence[Floats], piece: int, dt: float, start: Start) -> Segments:
    """Segments of one vehicle's gnss, velocity and truth (T, 3)."""
    count = len(drive[0]) // (piece + 1)
    gnss, velocity, truth = (d[: count * (piece + 1)].reshape(count, piece + 1, 3) for d in drive)
    begun = np.isfinite(gnss[:, 0, 0])
    origin = truth[begun, :1]
    parts = (gnss[begun] - origin, velocity[begun], truth[begun] - origin)
    fixes, speeds, truths = (torch.tensor(part, dtype=torch.float32) for part in parts)
    return Segments(fixes, speeds, truths, start == "true", dt)
