"""LKF-SA: the Laplacian Kalman filter over the star, in the identity form that the paper compares with."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..kernels.stars.lkf_sa import follow
from ..plugins import one_of
from ..world.inbox import Inbox
from ..world.recording import Recording
from ..world.v2x import FIX_AND_VELOCITY, Message
from .egos import Estimate, follow_egos
from .noise_model import NoiseModel, resolve
from .options import check_options
from .star import assumptions, measurements
from .track import Track


@dataclass(frozen=True, eq=False)
class LKFSA:
    """Per axis: z = [delta; gnss], H = [L; I], L the star's graph Laplacian, delta_i = -sum_j (x_j - x_i) as measured.

    With the identity noise model this is LKF-SA as the paper compares with it. Cov(delta) is sigma^2 L and not the
    diagonal used here, so no weighting of this form is right; that of `JointFilter(exact=False)`, the edge form, is.
    With other noise models delta_i has variance deg_i times the mean per-axis variance of the converted vectors. A
    member whose measurement is incomplete has no edge.

    Args:
        noise_model: "identity" (the paper), "nominal" or a NoiseModel.
        transition: "identity"; "ones" propagates the covariance with blocks of ones as the authors' public code does.
        membership: "keep" the states of members that stay; "reset" all at every change, as the public code does.
    """

    noise_model: NoiseModel | str = "identity"
    transition: Literal["identity", "ones"] = "identity"
    membership: Literal["keep", "reset"] = "keep"
    name: str = "lkf-sa"
    cooperative: bool = True
    message: Message = FIX_AND_VELOCITY

    def __post_init__(self) -> None:
        check_options(self)
        for field, allowed in (("transition", ("identity", "ones")), ("membership", ("keep", "reset"))):
            one_of(field, getattr(self, field), allowed)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent."""
        known = resolve(self.noise_model, recording)
        assumed = assumptions(recording, known)
        ones, reset = self.transition == "ones", self.membership == "reset"

        def drive(ego: int, box: Inbox) -> Iterator[Estimate]:
            x, variance, neighbours = follow(measurements(recording, ego, box), assumed, ones, reset)
            yield Estimate(slice(None), x, variance[..., None] * np.eye(3), box.link, neighbours)

        return follow_egos(self, recording, egos, drive, known.notes, missing=True)
