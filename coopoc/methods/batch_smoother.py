"""The whole-drive smoother of the whole fleet: all positions at all steps from everything that was ever measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from tqdm import tqdm

from ..arrays import Floats, Ints
from ..errors import InputError
from ..kernels.compile import use_kernels
from ..world.exchange import Exchange
from ..world.recording import Recording
from ..world.v2x import Message
from .central_filter import CENTRE, UPLOAD, centre, own_blocks, staying
from .kalman import solo_filter
from .knowledge import Knowledge, resolve
from .network import apply, information, pair_sightings, present
from .star import rows
from .track import Track
from .whole_fleet import fleet_track

AFTERWARDS = "not causal: every estimate knows the whole drive"


@dataclass(frozen=True, eq=False)
class BatchSmoother:
    """argmin of sum |x_t - x_{t-1} - dt u_t|^2_Q + sum |z - x|^2_GNSS + sum |h(x_j - x_i) - y|^2 over fleet and drive.

    The converted measurements make a linear problem; from its solution one exact Gauss-Newton step on range and angles
    is enough on average (performance.md section 1.1 of the design notes). Steps with the same factors, each a tenth of
    its cost, follow until none moves a position by `settle`: then it is the most probable drive. Time makes the normal
    equations block-tridiagonal with blocks of 3N x 3N, and motion noise is diagonal, so that one sweep eliminates step
    after step,

        S_t = J_t + D,   J_{t+1} = D S_t^-1 J_t + F_{t+1},   D = diag(1 / q),

    and one sweep back gives positions and their marginal covariances, Sigma_t = S_t^-1 + S_t^-1 D Sigma_{t+1} D S_t^-1.

    Not causal: a reference for what the drive holds. O(T (3N)^3) and T (3N)^2 numbers per sweep, one run at a time:
    60 vehicles and 900 steps take 230 MB. A sighting counts if a message gets through between the two, however late.

    Args:
        knowledge: "identity", "nominal" or a Knowledge. exact_steps: Gauss-Newton steps after the linear solution.
        settle: m, the
            largest step to stop at; inf stops after those.
    """

    knowledge: Knowledge | str = "nominal"
    exact_steps: int = 1
    settle: float = 1e-3
    name: str = "batch-smoother"
    cooperative: bool = True
    message: Message = UPLOAD

    def __post_init__(self) -> None:
        if self.exact_steps != int(self.exact_steps) or self.exact_steps < 0:
            raise InputError("exact_steps", self.exact_steps, "must be a whole number >= 0", "Use 1; 0 is linear only.")
        if not self.settle > 0:
            raise InputError("settle", f"{self.settle} m", "must be > 0", "Use 1e-3, or infinity for no further steps.")

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or if not all vehicles observed."""
        known = resolve(self.knowledge, recording)
        steps, notes = self.exact_steps if known.exact_relative else 0, [AFTERWARDS, CENTRE]

        def solve(contacts: Exchange) -> tuple[Floats, Floats]:
            smooth = _by_kernels if use_kernels() else _in_numpy
            bar = tqdm(total=recording.runs * (1 + steps) * len(recording.t), desc=self.name, unit="step", delay=2.0)
            with bar:
                settling = [Settling(self.settle) for _ in range(recording.runs)]
                each = smooth(recording, contacts, known, steps, settling, bar.update)
            lost = sum(s.given_up for s in settling)
            if lost:
                notes.append(f"{lost} of {recording.runs} runs did not settle within {self.settle:g} m")
            return np.stack([x for x, _ in each]), np.stack([cov for _, cov in each])

        track = fleet_track(self, recording, egos, lambda: centre(recording, self.message), solve)
        return replace(track, notes=tuple(notes))


@dataclass
class Settling:
    """Whether Gauss-Newton steps have become small, or no longer become smaller: then it is given up.

    >>> settling = Settling(1e-3)
    >>> [settling(largest) for largest in (0.5, 0.1, 1e-4)], settling.given_up
    ([False, False, True], False)
    """

    tolerance: float
    last: float = np.inf
    given_up: bool = False

    def __call__(self, largest: float) -> bool:
        """True to stop after a step that moved some position by `largest` m."""
        small = self.tolerance == np.inf or largest <= self.tolerance
        self.given_up = not small and not largest < self.last
        self.last = largest
        return small or self.given_up


@dataclass(frozen=True, eq=False)
class _Drive:
    """One run around positions `at` (T, N, 3) m, NaN where absent.

    Args:
        here: T times the columns that are present. start: (T+1,) start[t]:start[t+1] are the pairs of step t.
        first, second: (P,) columns. weight, pull: (P, 3, 3), (P, 3) what the pairs measured of the difference.
        fix_weight: (3,) 1/m^2. fix_gap: (T, N, 3) m. motion_weight: (T, N, 3) 1/m^2. motion_gap: (T, N, 3) m.
    """

    at: Floats
    here: list[Ints]
    start: Ints
    first: Ints
    second: Ints
    weight: Floats
    pull: Floats
    fix_weight: Floats
    fix_gap: Floats
    motion_weight: Floats
    motion_gap: Floats


@dataclass(frozen=True, eq=False)
class _Eliminated:
    """One step given the next: its S^-1 and pull, the rows of those who stay here and there, D and motion gap there."""

    inverse: Floats
    pull: Floats
    old: Ints
    new: Ints
    weight: Floats
    gap: Floats


def _by_kernels(
    recording: Recording, contacts: Exchange, known: Knowledge, steps: int, settling: Sequence[Settling],
    tick: Callable[[], object],
) -> list[tuple[Floats, Floats]]:
    """`_smooth` of every run, compiled; the runs share one memory."""
    from ..kernels.fleet_sweep import Memory, smooth
    from ..kernels.sighting import unfolded

    there = present(recording)
    place, memory = np.where(there, np.cumsum(there, axis=1) - 1, -1), Memory(3 * there.sum(axis=1))
    std = known.sensors.relative_std if known.sensors else np.zeros(0)
    least = known.sensors.min_range if known.sensors else 0.0
    variance = np.broadcast_to(known.process_variance(recording), recording.gnss.shape)
    at, _ = solo_filter(recording.gnss, recording.velocity, variance, known.gnss_variance, recording.dt)
    found = []
    for run, moved in enumerate(recording.dt * recording.velocity):
        alive = contacts.to_first[run] | contacts.to_second[run]
        pairs = (contacts.first, contacts.second, contacts.sight, contacts.sight_back)
        start = np.searchsorted(contacts.step[alive], np.arange(len(there) + 1))
        seen = unfolded(recording.relative[run : run + 1])[0]
        graph = (place, *(column[alive] for column in pairs), start, seen, std, least)
        own = (1.0 / known.gnss_variance, recording.gnss[run], 1.0 / variance[run], moved)
        found.append(smooth(at[run], graph, own, steps, settling[run], memory, tick))
    return found


def _in_numpy(
    recording: Recording, contacts: Exchange, known: Knowledge, steps: int, settling: Sequence[Settling],
    tick: Callable[[], object],
) -> list[tuple[Floats, Floats]]:
    """`_smooth` of every run."""
    return [_smooth(recording, contacts, known, run, steps, settling[run], tick) for run in range(recording.runs)]


def _smooth(
    recording: Recording, contacts: Exchange, known: Knowledge, run: int, steps: int, settled: Settling,
    tick: Callable[[], object],
) -> tuple[Floats, Floats]:  # fmt: skip
    """Positions (T, N, 3) and covariances (T, N, 3, 3) of one run, NaN where a vehicle is absent."""
    gnss, velocity = recording.gnss[run], recording.velocity[run]
    variance = np.broadcast_to(known.process_variance(recording), recording.gnss.shape)[run]
    at = solo_filter(gnss[None], velocity[None], variance[None], known.gnss_variance, recording.dt)[0][0]
    alive = contacts.to_first[run] | contacts.to_second[run]
    step, first, second = contacts.step[alive], contacts.first[alive], contacts.second[alive]
    sights = contacts.sight[alive], contacts.sight_back[alive]
    here = [np.flatnonzero(row) for row in present(recording)]
    start = np.searchsorted(step, np.arange(len(gnss) + 1))

    def around(at: Floats, exact: bool) -> _Drive:
        vector = (at[step, second] - at[step, first])[None]
        weight, pull = pair_sightings(recording.relative[run][None], *sights, vector if exact else None, known)
        pull = pull if exact else pull - apply(weight, vector)
        moved = recording.dt * velocity - np.diff(at, axis=0, prepend=np.nan)
        return _Drive(at, here, start, first, second, weight[0], pull[0], 1.0 / known.gnss_variance, gnss - at,
                      1.0 / variance, moved)  # fmt: skip

    stages: list[_Eliminated] = []
    for exact in range(steps + 1):
        drive = around(at, exact > 0)
        stages = _eliminate(drive, tick)
        before, at = at, _substitute(drive, stages)
    while steps and not settled(float(np.nanmax(np.abs(at - before)))):
        drive = around(at, exact=True)
        before, at = at, _substitute(drive, _again(drive, stages))
    return at, _marginals(drive, stages)


def _substitute(drive: _Drive, stages: Sequence[_Eliminated]) -> Floats:
    """Positions (T, N, 3) that solve the linear problem."""
    x = drive.at.copy()
    error: Floats = np.zeros(0)
    for t in range(len(stages) - 1, -1, -1):
        stage = stages[t]
        ahead = np.zeros_like(stage.pull)
        ahead[stage.old] = stage.weight * (error[stage.new] - stage.gap)
        error = stage.inverse @ (stage.pull + ahead)
        x[t, drive.here[t]] += error.reshape(-1, 3)
    return x


def _marginals(drive: _Drive, stages: Sequence[_Eliminated]) -> Floats:
    """Covariances (T, N, 3, 3) of all positions."""
    cov = np.full((*drive.at.shape, 3), np.nan)
    spread: Floats = np.zeros((0, 0))
    for t in range(len(stages) - 1, -1, -1):
        stage = stages[t]
        back = stage.inverse[:, stage.old] * stage.weight
        spread = stage.inverse + back @ spread[np.ix_(stage.new, stage.new)] @ back.T
        cov[t, drive.here[t]] = own_blocks(spread[None])[0]
    return cov


def _again(drive: _Drive, stages: Sequence[_Eliminated]) -> list[_Eliminated]:
    """The same factors for other pulls and gaps."""
    found = []
    prior_pull: Floats = np.zeros(3 * len(drive.here[0]))
    for t, stage in enumerate(stages):
        pull = _gained(drive, t)[1] + prior_pull
        later = drive.here[t + 1] if t + 1 < len(stages) else drive.here[t][:0]
        gap = drive.motion_gap[t + 1, later[staying(drive.here[t], later)[0]]].ravel() if len(later) else np.zeros(0)
        found.append(replace(stage, pull=pull, gap=gap))
        less, prior_pull = pull.copy(), np.zeros(3 * len(later))
        less[stage.old] -= stage.weight * gap
        prior_pull[stage.new] = stage.weight * (gap + (stage.inverse @ less)[stage.old])
    return found


def _eliminate(drive: _Drive, tick: Callable[[], object]) -> list[_Eliminated]:
    """Every step given the next one, the last as it is."""
    stages = []
    prior: Floats = np.zeros((3 * len(drive.here[0]),) * 2)
    prior_pull: Floats = np.zeros(len(prior))
    for t, here in enumerate(drive.here):
        total, pull = _gained(drive, t)
        total, pull = total + prior, pull + prior_pull
        later = drive.here[t + 1] if t + 1 < len(drive.here) else here[:0]
        stays, was = staying(here, later)
        new, old, columns = rows(stays), rows(was), later[stays]
        weight = drive.motion_weight[t + 1, columns].ravel() if len(later) else np.zeros(0)
        gap = drive.motion_gap[t + 1, columns].ravel() if len(later) else np.zeros(0)
        stiff = total.copy()
        stiff[old, old] += weight
        inverse = np.linalg.inv(stiff)
        stages.append(_Eliminated(inverse, pull, old, new, weight, gap))
        ahead = weight[:, None] * inverse[old]
        known = ahead @ total[:, old]  # D - D S^-1 D without the cancellation where a vehicle hardly moves
        prior, prior_pull = np.zeros((3 * len(later),) * 2), np.zeros(3 * len(later))
        prior[np.ix_(new, new)] = (known + known.T) / 2
        prior_pull[new] = known @ gap + ahead @ pull
        tick()
    return stages


def _gained(drive: _Drive, t: int) -> tuple[Floats, Floats]:
    """Information (3n, 3n) and pull (3n,) of the fixes and pairs of step t."""
    here, span = drive.here[t], slice(drive.start[t], drive.start[t + 1])
    first, second = np.searchsorted(here, drive.first[span]), np.searchsorted(here, drive.second[span])
    total, pull = information(len(here), first, second, drive.weight[None, span], drive.pull[None, span])
    total[0, np.arange(3 * len(here)), np.arange(3 * len(here))] += np.tile(drive.fix_weight, len(here))
    return total[0], pull[0] + (drive.fix_weight * drive.fix_gap[t, here]).ravel()
