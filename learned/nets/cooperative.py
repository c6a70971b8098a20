"""CooperativeGain: the joint filter of a star whose vehicles broadcast the variance of their noise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.kernels.motion import NO_MOTION_NOISE
from coopoc.methods.egos import Estimate, follow_egos
from coopoc.methods.noise_model import NoiseModel, constant_noise
from coopoc.methods.options import check_options
from coopoc.methods.star import assumptions, measurements, relative_noise
from coopoc.methods.track import Track
from coopoc.world.inbox import Inbox
from coopoc.world.recording import Recording
from coopoc.world.sensors import Sensors
from coopoc.world.v2x import Message

from .noise_net import NoiseNet, estimate_noise
from .star_gain import follow
from .sums_stream import SumsMeasurement as SumsMeasurement
from .sums_stream import SumsStream, model_noise, net_noise

NEWEST = Message("fix, velocity and noise", 14)
"""Fix (3), velocity (3), the variance of each (6), id and time (2)."""
SUMS = Message("sums since departure", 17)
"""Motion (3), its variance (3), 1/r (3) and (fix - motion)/r (3), each summed since departure; r of now (3); id and
time (2)."""


@dataclass(frozen=True, eq=False)
class NetNoise(NoiseModel):
    """Noise of the vehicles in one recording, estimated by the net on board of each, for any filter of a star.

    Relative noise is the data sheet's: vehicles that drive alone in training show nothing of it.

    Args:
        fix: (R, T, N, 3) m^2.
        process: (R, T, N, 3) m^2.
    """

    fix: Floats | None = None
    process: Floats | None = None

    @classmethod
    def by(cls, model: NoiseNet, recording: Recording, egos: Sequence[int] | None = None) -> NetNoise:
        """By the same net on board of every vehicle, or of the egos and of whom they ever measure."""
        links, members = recording.links, None
        if egos is not None:
            members = np.union1d(egos, links.neighbour[np.isin(links.observer, egos)])
        fix, process = estimate_noise(model, recording, members)
        return cls("net", recording.sensors, fix=fix, process=process)

    def process_variance(self, recording: Recording) -> Floats:
        """(R, T, N, 3) m^2."""
        assert self.process is not None
        return self.process

    def fix_variance(self, recording: Recording) -> Floats:
        """(R, T, N, 3) m^2."""
        assert self.fix is not None
        return self.fix

    @property
    def gnss_variance(self) -> Floats:
        """There is no constant one: InputError."""
        raise InputError(
            "noise_model",
            "the noise of nets",
            "changes from fix to fix, and this method takes constants",
            "Use a filter of a star, such as JointFilter, or another noise model.",
        )


@dataclass(frozen=True, eq=False)
class CooperativeGain:
    """Ego and neighbours in one state as in JointFilter, each with the noise that its net estimates.

    The noise of GNSS and velocity is not given; that of range and angles is the data sheet's. A neighbour is used
    when its message arrives, so without any the ego is filtered exactly as by `NoiseFilter`.

    A message holds sums since departure. The receiver takes the difference to the last sums received from that vehicle,
    so that a message also holds the content of lost ones: the whole motion in between with its noise, and all fixes in
    between, averaged along that motion. With `sums=False` it holds the newest fix and velocity, as JointFilter's.

    Args:
        noise: the net; or a NoiseModel, which all vehicles then assume.
        sums: whether messages hold sums.
        name: in tables.

    >>> CooperativeGain(NoiseNet()).message.payload
    68
    """

    noise: NoiseNet | NoiseModel
    sums: bool = True
    name: str = "cooperative"
    cooperative: bool = True

    def __post_init__(self) -> None:
        check_options(self, kinds={"noise": (NoiseNet, NoiseModel)})

    @property
    def message(self) -> Message:
        """The message that each vehicle broadcasts."""
        return SUMS if self.sums else NEWEST

    def start(self, sensors: Sensors | None = None) -> SumsStream:
        """The filter as a stream: `step(gnss, velocity, dt, neighbours=[...])`, and then `message` to broadcast.

        Args:
            sensors: whose noise of range and angles is assumed; default `Sensors()`. A NoiseModel has its own.

        Raises:
            InputError: `sums=False`; sensors beside a NoiseModel.

        >>> ego, other = (CooperativeGain(NoiseNet()).start() for _ in range(2))
        >>> _ = other.step([10.0, 0.0, 0.0], [9.0, 0.0, 0.0], dt=0.1)
        >>> seen = SumsMeasurement("b", [9.0, 0.0, 1.5707963], other.message)
        >>> x, _ = ego.step([0.0, 0.0, 0.0], [9.0, 0.0, 0.0], dt=0.1, neighbours=[seen])
        >>> float(x[0].round(2)), float(ego.neighbours["b"][0].round(2))  # 10 m apart by the fixes, 9 m as measured
        (0.46, 9.54)
        """
        if not self.sums:
            raise InputError("sums", False, "must be True for a stream", "JointFilter streams newest fixes.")
        if isinstance(self.noise, NoiseNet):
            return SumsStream(net_noise(self.noise), *relative_noise(NoiseModel.nominal(sensors or Sensors())))
        if sensors is not None:
            raise InputError("sensors", sensors, "are those of the NoiseModel", "Leave them out.")
        return SumsStream(model_noise(constant_noise(self.noise)), *relative_noise(constant_noise(self.noise)))

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and their neighbours.

        Raises:
            InputError: an ego that is unknown or absent; sums over a channel that delays them.
        """
        if self.sums and recording.v2x.latency > 0:
            raise InputError(
                "latency",
                f"{recording.v2x.latency} s",
                "must be 0 s with sums",
                "Use CooperativeGain(noise, sums=False).",
            )
        model = self.noise
        if isinstance(model, NoiseNet):
            model = NetNoise.by(model, recording, recording.columns(egos, missing=True))
        process = np.ascontiguousarray(model.process_variance(recording))
        known = assumptions(recording, model)._replace(process=process, motion=NO_MOTION_NOISE)

        def drive(ego: int, box: Inbox) -> Iterator[Estimate]:
            x, cov, neighbours = follow(measurements(recording, ego, box), known, self.sums)
            yield Estimate(slice(None), x, cov, box.link, neighbours)

        return follow_egos(self, recording, egos, drive, missing=True)
