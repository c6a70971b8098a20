"""Diffusion: adapt-then-combine least mean squares on the fleet's graph Laplacian."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from ..arrays import Bools, Floats
from ..errors import InputError
from ..world.exchange import Exchange, exchange
from ..world.recording import Recording
from ..world.spherical import to_vector
from ..world.v2x import Message
from .knowledge import Knowledge, resolve
from .network import collect, present
from .track import Track
from .whole_fleet import fleet_track

MOST = 0.1
"""Largest step of the adaptation, as published."""
ADRIFT = "diffusion on L alone: positions come from the fixes of first meetings only and drift with the velocity noise"


@dataclass(frozen=True, eq=False)
class Diffusion:
    """ATC-LMS (methods.md section 4.2): adapt w_i on the vehicle's own row of the Laplacian, then combine.

        psi_i = w_i + mu L_i^T (delta_i - L_i w_i),   mu = min(2 / |L_i|^2, 0.1),
        w_i = c_ii psi_i + sum_j c_ij psi_j,          c_ij = 1 / max(deg_i + 1, deg_j + 1)  (Metropolis),

    with L_i = deg_i at i and -1 at those that i sees, and delta_i = -sum_j of its measured vectors x_j - x_i. As
    published the position comes only from the initialisation, because L is singular: it says nothing of where the
    fleet is. Between steps estimates move with the measured velocities, so that they drift. `anchored` adds the row of
    the own fix, [L; I]. No weight here knows how good an estimate is: this is no filter, and it claims no covariance.

    Published are estimates of all vehicles in each, 150 rounds a step, a warm start for some neighbours and fixes for
    the others. Here a vehicle keeps estimates of itself and of those that it is in contact with, which is what its row
    needs and what a growing fleet does not lengthen; all are warm-started, a new one starts at its fix, or with
    `anchored` at its own estimate, which bears losses better.

    Broadcast per round: position and id of each vehicle kept (4 numbers) and of the sender (4), and time; the first
    round adds where to start the sender and its velocity (6). Two vehicles combine if the messages of the step get
    through both ways.

    Args:
        knowledge: "identity": rows of unit weight, as published. Otherwise delta_i has variance deg_i times the mean
            per-axis variance of its vectors, which weighs it against the own fix; without `anchored` nothing changes.
        rounds: a step. anchored: use the own fix at every step.
    """

    knowledge: Knowledge | str = "identity"
    rounds: int = 3
    anchored: bool = False
    name: str = "diffusion"
    cooperative: bool = True

    def __post_init__(self) -> None:
        if self.rounds != int(self.rounds) or self.rounds < 1:
            raise InputError("rounds", self.rounds, "must be a whole number >= 1", "150 is as published.")

    @property
    def message(self) -> Message:
        """All estimates that the sender keeps, in every round; where to start it and its velocity once."""
        return Message("estimates", 5, rounds=self.rounds, opening=6, per_neighbour=4)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or if not all vehicles observed."""
        known = resolve(self.knowledge, recording)
        notes = () if self.anchored else (ADRIFT,)
        return fleet_track(
            self, recording, egos, lambda: exchange(recording, self.message),
            lambda contacts: (_late(self._follow(recording, contacts, known), recording, contacts.delay), None), notes,
        )  # fmt: skip

    def _follow(self, recording: Recording, contacts: Exchange, known: Knowledge) -> Floats:
        """Own estimates (R, T, N, 3)."""
        runs, steps, n = recording.gnss.shape[:3]
        there, me = present(recording), np.arange(n)
        w: Floats = np.zeros((runs, n, n, 3))
        kept: Bools = np.zeros((runs, n, n), dtype=bool)
        x = np.full_like(recording.gnss, np.nan)
        for t in tqdm(range(steps), desc=self.name, unit="step", delay=2.0):
            hears = _hears(contacts, t, runs, n)
            keeps = hears | (np.eye(n, dtype=bool) & there[t])
            fix = np.where(there[t, :, None], recording.gnss[:, t], 0.0)
            moved = np.where(there[t, :, None], recording.dt * recording.velocity[:, t], 0.0)
            own = np.where(kept[:, me, me][..., None], w[:, me, me] + moved, fix)
            new = own if self.anchored else fix
            w = np.where((keeps & kept)[..., None], w + moved[:, None], new[:, None]) * keeps[..., None]
            w, kept = self._rounds(recording, contacts, t, w, hears, fix, known), keeps
            x[:, t, there[t]] = w[:, me, me][:, there[t]]
        return x

    def _rounds(
        self, recording: Recording, contacts: Exchange, t: int, w: Floats, hears: Bools, fix: Floats, known: Knowledge
    ) -> Floats:
        """Estimates (R, N, N, 3) of each vehicle, of those that it keeps, after the rounds of one step."""
        n, me = w.shape[1], np.arange(w.shape[1])
        laplacian, delta, variance = _rows(recording, contacts, t, hears, known)
        degree = laplacian[:, me, me][..., None]
        anchor = variance / known.gnss_variance if self.anchored else np.zeros(3)
        step = np.minimum(2.0 / np.maximum(degree**2 + degree + anchor, 2.0), MOST)
        size = hears.sum(axis=2) + 1
        mix = hears / np.maximum(size[:, :, None], size[:, None])
        held = (hears | np.eye(n, dtype=bool)).astype(float)
        alone = (1.0 - mix @ held)[..., None]
        for _ in range(self.rounds):
            gap = step * (delta - np.einsum("rij,rijc->ric", laplacian, w))
            toward = step * anchor * (fix - w[:, me, me])
            w = w + gap[:, :, None] * laplacian[..., None]
            w[:, me, me] += toward
            others = (mix @ (held[..., None] * w).reshape(len(w), n, -1)).reshape(w.shape)
            w = (others + alone * w) * held[..., None]
        return w


def _hears(contacts: Exchange, t: int, runs: int, n: int) -> Bools:
    """(R, N, N) True where two vehicles exchange messages at a step."""
    span = slice(contacts.start[t], contacts.start[t + 1])
    first, second = contacts.first[span], contacts.second[span]
    hears = np.zeros((runs, n, n), dtype=bool)
    hears[:, first, second] = hears[:, second, first] = contacts.to_first[:, span] & contacts.to_second[:, span]
    return hears


def _rows(
    recording: Recording, contacts: Exchange, t: int, hears: Bools, known: Knowledge
) -> tuple[Floats, Floats, Floats]:
    """Each vehicle's row of the Laplacian (R, N, N), its delta (R, N, 3) m, and what variance that has (R, N, 1) m^2.

    A row holds those that the vehicle sees and hears.
    """
    span = slice(contacts.start[t], contacts.start[t + 1])
    link = np.concatenate([contacts.sight[span], contacts.sight_back[span]])
    link = link[link >= 0]
    i, j = recording.links.observer[link], recording.links.neighbour[link]
    weight = hears[:, i, j].astype(float)
    laplacian = np.zeros(hears.shape)
    laplacian[:, i, j] = -weight
    n = hears.shape[1]
    degree = collect(weight, i, n)
    laplacian[:, np.arange(n), np.arange(n)] = degree
    relative = recording.relative[:, link]
    delta = -collect(weight[..., None] * to_vector(relative), i, n)
    if known.sensors is None:
        return laplacian, delta, np.ones((*degree.shape, 1))
    of_one = np.trace(known.relative_cov(relative), axis1=-2, axis2=-1) / 3
    return laplacian, delta, np.maximum(collect(weight * of_one, i, n), 1.0)[..., None]


def _late(x: Floats, recording: Recording, delay: int) -> Floats:
    """Estimates of `delay` steps ago moved on with the measured velocities; before the first one, the first fix."""
    path = np.cumsum(recording.dt * recording.velocity, axis=1)
    old = np.maximum(np.arange(x.shape[1]) - delay, 0)
    moved: Floats = x[:, old] + path - path[:, old]
    return moved
