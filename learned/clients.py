"""Clients: the training drives, each with its own noise, cut into pieces that never leave it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.world.fleet import Fleet
from coopoc.world.noise import stream
from coopoc.world.sensing import observe
from coopoc.world.sensors import Sensors
from coopoc.world.v2x import V2X

Noise = Literal["static", "fresh"]
Start = Literal["gnss", "true"]


class Batch(NamedTuple):
    """What S models see at once, each B pieces: gnss, velocity, truth (T, S, B, 3); x0 (S, B, 3); dt s."""

    gnss: Tensor
    velocity: Tensor
    truth: Tensor
    x0: Tensor
    dt: float


@dataclass(frozen=True, eq=False)
class Pieces:
    """n sub-trajectories of T steps after a start sample, in float32, each relative to its first true position.

    Args:
        gnss, velocity, truth, true_velocity: (n, T + 1, 3) m and m/s; sample 0 only starts the filter.
        gnss_std, velocity_std: (n, T + 1, 3) m and m/s of the noise, for fresh draws.
        true_start: (n,) whether the filter starts at the truth (KalmanNet's published loop) or at the first fix.
        dt: s. fresh: draw new noise at every use instead of the noise drawn once.
    """

    gnss: Tensor
    velocity: Tensor
    truth: Tensor
    true_velocity: Tensor
    gnss_std: Tensor
    velocity_std: Tensor
    true_start: Tensor
    dt: float
    fresh: bool = False

    def __len__(self) -> int:
        return len(self.truth)

    def batch(self, index: Tensor, draws: Sequence[torch.Generator] = ()) -> Batch:
        """Pieces `index` (S, B); fresh noise comes from the S generators `draws`."""
        gnss, velocity, truth = self.gnss[index], self.velocity[index], self.truth[index]
        if self.fresh:
            shape = (2, *truth.shape[1:])
            normals = torch.stack([torch.randn(shape, generator=draw) for draw in draws], dim=1)
            gnss = truth + self.gnss_std[index] * normals[0]
            velocity = self.true_velocity[index] + self.velocity_std[index] * normals[1]
        x0 = torch.where(self.true_start[index][..., None], truth[..., 0, :], gnss[..., 0, :])
        steps = [array[..., 1:, :].permute(2, 0, 1, 3).contiguous() for array in (gnss, velocity, truth)]
        return Batch(*steps, x0, self.dt)

    def take(self, index: Sequence[int]) -> Pieces:
        """The pieces `index`."""
        return replace(self, **{name: getattr(self, name)[list(index)] for name in _ARRAYS})

    @classmethod
    def join(cls, parts: Sequence[Pieces]) -> Pieces:
        """All pieces of several parts in their order; the parts agree in length, dt and kind of noise."""
        if len({(p.truth.shape[1], p.dt, p.fresh) for p in parts}) != 1:
            found = [(p.truth.shape[1], p.dt, p.fresh) for p in parts]
            raise InputError("pieces", found, "must agree in length, dt and noise", "Cut all clients alike.")
        return replace(parts[0], **{name: torch.cat([getattr(p, name) for p in parts]) for name in _ARRAYS})


_ARRAYS = ("gnss", "velocity", "truth", "true_velocity", "gnss_std", "velocity_std", "true_start")


@dataclass(frozen=True, eq=False)
class Client:
    """One vehicle with its private pieces, disjoint for training and validation."""

    name: str
    training: Pieces
    validation: Pieces


def clients(
    fleet: Fleet,
    sensors: Sensors | None = None,
    *,
    seed: int = 0,
    noise: Noise = "static",
    start: Start = "gnss",
    piece: int = 100,
    split: float = 0.8,
) -> tuple[Client, ...]:
    """Every vehicle of a training fleet as a client: its noisy drive in pieces, `split` of them for training.

    A piece is `piece` steps after one start sample; the last incomplete one is dropped. Which pieces validate is drawn
    once from the seed. Static noise, drawn once as the paper implies, is the default.

    Args:
        fleet: drives (T, N); a vehicle may leave early. sensors: default `Sensors.paper_training()`.
        seed: of noise and split. noise: "static" or "fresh" (new at every use). start: "gnss" (first fix) or "true".

    Raises:
        InputError: a choice that does not exist, or a vehicle with fewer than two pieces.

    Source: arXiv 2411.05847, section IV.A; KalmanNet_TSP for the start at the truth.

    >>> t = np.arange(303) / 10
    >>> line = Fleet(("a",), t, np.zeros((303, 1, 3)), np.zeros((303, 1, 3)))
    >>> [(len(c.training), len(c.validation)) for c in clients(line)]
    [(2, 1)]
    """
    for name, value, allowed in (("noise", noise, ("static", "fresh")), ("start", start, ("gnss", "true"))):
        if value not in allowed:
            raise InputError(name, repr(value), f"must be one of {allowed}", "Pick one.")
    if piece < 2 or not 0 < split < 1:
        raise InputError("piece, split", (piece, split), "must be >= 2 and in (0, 1)", "The paper has 100 and 0.8.")
    sensors = sensors or Sensors.paper_training()
    if noise == "fresh" and sensors.gnss_bias[1] > 0:
        raise InputError("gnss_bias", sensors.gnss_bias, "must be (0, 0) with fresh noise", "Train without a bias.")
    seen = observe(fleet, sensors, V2X(max_neighbours=0), seed=seed)
    found = []
    for column, name in enumerate(fleet.ids):
        there = np.flatnonzero(fleet.present[:, column])
        if len(there) and there[-1] - there[0] >= len(there):
            raise InputError("fleet", f"{name} leaves and comes back", "must be one drive", "Cut it with between(...).")
        arrays = (seen.gnss[0], seen.velocity[0], fleet.position, fleet.velocity)
        pieces = _cut([a[there, column] for a in arrays], sensors, piece, fleet.dt, noise, start)
        if len(pieces) < 2:
            mend = f"Give it at least {2 * (piece + 1)} steps or shorten the pieces."
            raise InputError("fleet", f"{name} with {len(pieces)} pieces of {piece}", "needs at least two", mend)
        order = stream(seed, "split", 0, name).permutation(len(pieces)).tolist()
        count = min(max(int(split * len(pieces)), 1), len(pieces) - 1)
        found.append(Client(name, pieces.take(sorted(order[:count])), pieces.take(sorted(order[count:]))))
    return tuple(found)


def _cut(drive: Sequence[Floats], sensors: Sensors, piece: int, dt: float, noise: Noise, start: Start) -> Pieces:
    """Pieces of one vehicle's gnss, velocity, truth and true velocity (T, 3)."""
    count = len(drive[0]) // (piece + 1)
    gnss, velocity, truth, true_velocity = (d[: count * (piece + 1)].reshape(count, piece + 1, 3) for d in drive)
    origin = truth[:, :1]
    numbers = (
        gnss - origin, velocity, truth - origin, true_velocity,
        np.broadcast_to(np.array(sensors.gnss_std), gnss.shape), sensors.velocity_std(true_velocity),
    )  # fmt: skip
    tensors = [torch.tensor(n, dtype=torch.float32) for n in numbers]
    return Pieces(*tensors, torch.full((count,), start == "true"), dt, noise == "fresh")
