"""MSMV-R: a reconstruction of multi-sensor multi-vehicle localization, whose equations are not public."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from ..kernels.stars.msmv import follow
from ..world.inbox import Inbox
from ..world.recording import Recording, check_recording
from ..world.v2x import ESTIMATE, ESTIMATE_AND_COV, Message
from .egos import Estimate, follow_egos
from .noise_model import NoiseModel, resolve
from .options import check_options
from .star import estimates, measurements
from .track import Track

RECONSTRUCTION = "MSMV-R is a reconstruction: the equations of MSMV are not public; the paper's curve is not matched"


@dataclass(frozen=True, eq=False)
class MSMV:
    """Kalman filter of the ego with one pseudo-fix per neighbour: y_j = p_j - rho(r_ij), C_j = P_j + J C_r J^T.

    p_j, P_j are the neighbour's own solo estimate; P^-1 += C_p^-1 + sum C_j^-1. The errors of p_j are correlated in
    time, so the covariance is over-confident (data incest), and NEES shows it. With the identity noise model all
    covariances are unit matrices and the message is shorter.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
    """

    noise_model: NoiseModel | str = "identity"
    name: str = "msmv-r"
    cooperative: bool = True

    def __post_init__(self) -> None:
        check_options(self)

    @property
    def message(self) -> Message:
        """Without covariance under the identity noise model, with it otherwise."""
        name = self.noise_model if isinstance(self.noise_model, str) else self.noise_model.name
        return ESTIMATE if name == "identity" else ESTIMATE_AND_COV

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent."""
        known, columns = resolve(self.noise_model, recording), check_recording(recording).columns(egos, missing=True)
        assumed, own = estimates(recording, known, columns, (0.0, 1.0), 0.0)

        def drive(ego: int, box: Inbox) -> Iterator[Estimate]:
            x, cov, theirs = follow(measurements(recording, ego, box, own), assumed)
            yield Estimate(slice(None), x, cov, box.link, theirs)

        return follow_egos(self, recording, egos, drive, (*known.notes, RECONSTRUCTION), missing=True)
