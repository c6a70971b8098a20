"""Attack: a share of the vehicles broadcasts displaced fixes, as a spoofed or a lying receiver does."""

from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Floats, check_fields, extent, instance, seed_of
from .fleet import columns
from .recording import Recording, Vehicles
from .sensors import stream


@dataclass(frozen=True)
class Spoofing:
    r"""Offset of the fixes of spoofed vehicles, $o_t = \pm\, U(low, high) \min(1, (t - start) / ramp)$ on each axis.

    Every vehicle has random signs and sizes of its own, unless they collude.

    >>> Spoofing(0.2, start=30.0).note
    '20 % of the vehicles spoofed, fixes 5 to 40 m off on each axis, from 30 s on'
    """

    share: float = 0.2
    """Probability that a vehicle is spoofed, in [0, 1]."""
    offset: tuple[float, float] = (5.0, 40.0)
    """(low, high) m, on each axis."""
    start: float = 0.0
    """s into the drive."""
    ramp: float = 0.0
    """s over which the offset grows to its full size; 0: it jumps."""
    collude: bool = False
    """Whether all spoofed vehicles of a run have the same offset, so that they confirm one another."""

    def __post_init__(self) -> None:
        seconds = (0, 1e9, "finite and >= 0, 0 from the first step on, at once")
        check_fields(self, {"share": (0, 1, "in [0, 1]"), "start": seconds, "ramp": seconds})
        self.__dict__["offset"] = extent("offset", self.offset, "Give (low, high) in metres: signs are drawn.")

    def size(self, t: Floats) -> Floats:
        """(T,) share of the full offset at times t s.

        >>> Spoofing(start=1.0, ramp=2.0).size(np.array([0.0, 1.0, 2.0, 9.0])).tolist()
        [0.0, 0.0, 0.5, 1.0]
        """
        since = t - t[0] - self.start
        return np.asarray(np.clip(since / self.ramp, 0.0, 1.0) if self.ramp else since >= -1e-9, float)

    @property
    def note(self) -> str:
        """The attack in words."""
        low, high = self.offset
        return (
            f"{100 * self.share:g} % of the vehicles spoofed, fixes {low:g} to {high:g} m off on each axis"
            + (f", from {self.start:g} s on" if self.start else "")
            + (f", growing over {self.ramp:g} s" if self.ramp else "")
            + (", all alike" if self.collude else "")
        )


def spoofed(
    recording: Recording,
    attack: Spoofing | float,
    seed: int = 0,
    honest: Vehicles = (),
    *,
    remove_outliers: bool = False,
) -> Recording:
    """The recording with the fixes of spoofed vehicles displaced, gnss' = gnss + o.

    Which vehicles are spoofed, and by what, is keyed by (seed, run, id): a vehicle spoofed at a share of 20 % is
    spoofed by the same offset at 30 %, and no other noise changes. Velocities and relative measurements stay true. A
    spoofed vehicle reads its own false fix, too: name the egos among the honest ones.

    Args:
        recording: of an honest fleet.
        attack: or its share alone.
        seed: of the attack.
        honest: columns or ids of egos that are never spoofed.
        remove_outliers: whether false fixes are missing (NaN) instead, as for an estimator that knows of the attack.

    Raises:
        InputError: a share outside [0, 1], seed < 0, an honest vehicle that is none of the recording.

    >>> from coopoc import Fleet, Sensors, observe
    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> seen = observe(fleet, Sensors())
    >>> abs(spoofed(seen, 1.0, honest=["a"]).gnss - seen.gnss)[0, :, :, 0].round(1)
    array([[ 0. , 14.9],
           [ 0. , 14.9]])
    """
    attack = attack if isinstance(attack, Spoofing) else Spoofing(attack)
    seed = seed_of(seed)
    instance("remove_outliers", remove_outliers, bool, "Give True to remove false fixes.")
    spared = columns("honest", honest, recording.ids)
    offset = np.zeros((recording.runs, len(recording.ids), 3))
    for run in range(recording.runs):
        common = _offset(stream(seed, "attack", run, ""), attack)
        for column, name in enumerate(recording.ids):
            draws = stream(seed, "attack", run, name)
            if draws.uniform() < attack.share and column not in spared:
                offset[run, column] = common if attack.collude else _offset(draws, attack)
    error = attack.size(recording.t)[:, None, None] * offset[:, None]
    gnss = np.where(error != 0, np.nan, recording.gnss) if remove_outliers else recording.gnss + error
    return replace(recording, gnss=gnss, notes=(*recording.notes, attack.note + ", removed" * remove_outliers))


def _offset(draws: np.random.Generator, attack: Spoofing) -> Floats:
    size = draws.uniform(*attack.offset, 3)
    return np.where(draws.uniform(size=3) < 0.5, size, -size)
