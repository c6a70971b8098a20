"""CooperativeGain: the joint filter of a star whose vehicles broadcast the noise that a net on board estimates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.methods.joint_filter import JointFilter
from coopoc.methods.noise_model import NoiseModel
from coopoc.methods.track import Track, check_options
from coopoc.world.recording import Recording
from coopoc.world.v2x import Message

from .noise_net import NoiseNet, estimate_noise

NEWEST = Message("fix, velocity and noise", 14)
"""Fix (3), velocity (3), the variance of each (6), id and time (2)."""


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
        """By the same net on board of every vehicle, or of the egos and of all vehicles they ever measure."""
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
    """`JointFilter` of ego and neighbours, each with the noise that its own net estimates and broadcasts.

    The noise of GNSS and velocity is not given; that of range and angles is the data sheet's.

    Args:
        model: trained net.
        name: in tables.

    >>> CooperativeGain(NoiseNet()).message.payload
    56
    """

    model: NoiseNet
    name: str = "cooperative"
    cooperative: bool = True
    message: Message = NEWEST

    def __post_init__(self) -> None:
        check_options(self, kinds={"model": NoiseNet})

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and their neighbours; InputError if an ego is unknown or absent."""
        noise_model = NetNoise.by(self.model, recording, recording.columns(egos, missing=True))
        return JointFilter(noise_model, name=self.name, message=self.message)(recording, egos)
