"""The cooperative gain step by step: what a vehicle measures and receives now, its estimate, and what it sends."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from torch import nn

from coopoc.arrays import Floats, number
from coopoc.errors import InputError
from coopoc.kernels.stars.star_stream import resized
from coopoc.methods.noise_model import NoiseModel, motion_noise
from coopoc.methods.stream import fix_or_none, names_of, numbers, three

from .noise_step import new_memory, noise_step, packed
from .star_gain import LAST
from .sums_step import MESSAGE, NEWS, RELATIVE, ROW_SIZE, SLOT, new_history, relative_assumed, sums_step

SENT = LAST + 3
"""Numbers of a message: the sums, and the variance of a fix of now."""
Noise: TypeAlias = "Callable[[Floats, Floats], object]"
"""Fills variances (6,) m^2, of the fix and of the motion, from fix m, velocity m/s and dt s (7,)."""


def net_noise(model: nn.Module) -> Noise:
    """The noise that a NoiseNet estimates of one vehicle from now on."""
    weights: dict[str, Floats] = {name: value.detach().double().numpy() for name, value in model.named_parameters()}
    net, memory = packed(weights), new_memory()
    return lambda given, out: noise_step(net, memory, given, out)


def model_noise(known: NoiseModel) -> Noise:
    """The noise of a NoiseModel."""
    fix, motion = known.gnss_variance, motion_noise(known, None)

    def noise(given: Floats, out: Floats) -> None:
        speed = np.abs(given[3:6])
        speed = np.full(3, np.linalg.norm(speed)) if motion.of_speed else speed
        out[:3], out[3:] = fix, motion.base**2 + (given[6] * np.maximum(motion.ratio * speed, motion.floor)) ** 2

    return noise


@dataclass(frozen=True, eq=False)
class SumsMeasurement:
    """A neighbour as the ego measures it now, with the message that has newly come from it, if any.

    Args:
        id: name of the neighbour.
        relative: (3,) range m, world azimuth rad, inclination rad; NaN for a component that is missing.
        message: (15,) `SumsStream.message` of the neighbour at this step; None where none has arrived.

    Raises:
        InputError: no name, a range <= 0, or a message of other numbers.

    >>> SumsMeasurement("b", [9.0, 0.1, 1.57]).message is None
    True
    """

    id: str
    relative: npt.ArrayLike
    message: npt.ArrayLike | None = None
    row: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        row, relative = np.zeros(ROW_SIZE), numbers(self.relative)
        named = isinstance(self.id, str) and self.id
        if relative.shape != (3,) or not named or not (0.0 < relative[0] < math.inf or math.isnan(relative[0])):
            text = "must have a name and three numbers, the range first and > 0"
            raise InputError("relative", (self.id, self.relative), text, "Give NaN for what was not measured.")
        row[RELATIVE : RELATIVE + 3], row[NEWS] = relative, float(self.message is not None)
        if self.message is not None:
            sent = numbers(self.message)
            if sent.shape != (SENT,) or not np.isfinite(sent).all() or not (sent[LAST:] > 0.0).all():
                allowed = f"must be {SENT} finite numbers, the last three > 0"
                raise InputError("message", self.message, allowed, "Send SumsStream.message as it is.")
            row[MESSAGE : MESSAGE + SENT] = sent
        object.__setattr__(self, "row", row)


class SumsStream:
    """A CooperativeGain of one vehicle that is fed as it drives; `CooperativeGain.start` makes it.

    A vehicle stays known, with its last sums, from its first message on. One that starts again needs another name.

    Args:
        noise: of the vehicle's own fixes and motions.
        relative_std: (3,) m, rad, rad, of no length for unit covariances.
        min_range: m.
    """

    def __init__(self, noise: Noise, relative_std: Floats, min_range: float) -> None:
        self.noise, self.relative = noise, relative_assumed(relative_std, min_range)
        self.slots: dict[str, int] = {}
        self.members: list[str] = []
        self._known, self._variances, self._answer = np.zeros(7), np.zeros(6), np.zeros(12)
        self._numbers: Floats = np.zeros(0)
        self._history: Floats = np.zeros(0)
        self._index, self._fixes = np.zeros(3, np.int64), np.ones((1, 1, 0, 3))
        self._reserve(16, 8)

    def _reserve(self, vehicles: int, most: int) -> None:
        """Room for so many vehicles, the ego among them, and for `most` members of the star."""
        before, most_before = self._fixes.shape[2], int(self._index[1])
        place = np.append(self._index[3 + 3 * most_before :], np.full(vehicles - before, -1))
        self._history = new_history(vehicles, most, self._history, (before, most_before))
        if most > most_before:
            self._numbers = resized(self._numbers, int(self._index[0]), most_before, most)
        head = [self._index[0], most, self._index[2]]
        self._index = np.concatenate([head, np.zeros(3 * most), place]).astype(np.int64)
        self._inbox = np.zeros((most, ROW_SIZE))
        fixes = np.ones((1, 1, vehicles, 3))
        fixes[:, :, :before], self._fixes = self._fixes, fixes

    @property
    def message(self) -> Floats:
        """(15,) what the vehicle broadcasts after this step: motion m, its variance m^2, 1/r and (fix - motion)/r, each
        summed since the start of the stream, and the variance r m^2 of a fix of now."""
        own = self._history[:LAST]
        return np.concatenate([own, self._variances[:3]])

    @property
    def neighbours(self) -> dict[str, Floats]:
        """Positions (3,) m of the neighbours in the star."""
        return dict(zip(self.members, self._answer[12:].reshape(-1, 3).copy(), strict=True))

    def step(
        self,
        gnss: npt.ArrayLike | None,
        velocity: npt.ArrayLike,
        dt: float,
        neighbours: Sequence[SumsMeasurement] = (),
    ) -> tuple[Floats, Floats | None]:
        """Position (3,) m and covariance (3, 3) m^2 of the ego; NaN and None before its first fix.

        Args:
            gnss: (3,) m of the ego; None or NaN for no fix.
            velocity: (3,) m/s of the ego, the mean over the step.
            dt: s since the last step.
            neighbours: the relative measurements of now, one for each neighbour.

        Raises:
            InputError: numbers that are not finite, or a neighbour that is given twice. The filter is then as it was.
        """
        names = names_of("neighbours", neighbours, SumsMeasurement)
        self._read(gnss, velocity, dt)
        slots = [self.slots.get(name, -1) for name in names]
        if -1 in slots or len(names) >= len(self._inbox):
            slots = self._places(names)
        inbox = self._inbox[: len(names)]
        for row, one in zip(inbox, neighbours, strict=True):
            row[:] = one.row
        inbox[:, SLOT] = slots
        self.noise(self._known, self._variances)
        answer = np.empty(12 + 3 * len(names))
        memory = self._numbers, self._index, self._history, self._fixes
        if not sums_step(self._known, self._variances, inbox, *memory, self.relative, answer):
            return np.full(3, np.nan), None
        self.members, self._answer = names, answer
        return answer[:3], answer[3:12].reshape(3, 3)

    def _read(self, gnss: npt.ArrayLike | None, velocity: npt.ArrayLike, dt: float) -> None:
        """Take the measurements of a step, checked; the usual ones without the checks that name what is wrong."""
        known = self._known
        with suppress(TypeError, ValueError):
            known[:3], known[3:6], known[6] = np.nan if gnss is None else gnss, velocity, dt
            z, u = (0.0 if gnss is None else known[0] + known[1] + known[2]), known[3] + known[4] + known[5]
            long = len(velocity) == 3 and (gnss is None or len(gnss) == 3)  # type: ignore[arg-type]
            if long and 0.0 < dt < math.inf and math.isfinite(z + u):
                return
        known[:3], known[3:6], known[6] = fix_or_none(gnss), three("velocity", velocity), _length(dt)

    def _places(self, names: Sequence[str]) -> list[int]:
        """Rows of the vehicles in the history, with room for all."""
        for name in names:
            self.slots.setdefault(name, 1 + len(self.slots))
        vehicles, most = self._fixes.shape[2], len(self._inbox)
        if len(self.slots) >= vehicles or len(names) >= most:
            self._reserve(max(vehicles, 2 * (len(self.slots) + 1)), max(most, 2 * (len(names) + 1)))
        return [self.slots[name] for name in names]


def _length(dt: float) -> float:
    hint = "Give the seconds since the last step."
    found: float = number("dt", dt, sys.float_info.min, allowed="finite and > 0", hint=hint)
    return found
