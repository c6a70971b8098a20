"""MSMV-R: a reconstruction of multi-sensor multi-vehicle localization, whose equations are not public."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Floats
from ..kernels.compile import use_kernels
from ..world.inbox import Inbox
from ..world.recording import Recording
from ..world.spherical import to_vector
from ..world.v2x import ESTIMATE, ESTIMATE_AND_COV, Message
from .egos import Estimate, follow_egos
from .kalman import solo_filter
from .knowledge import Knowledge, resolve
from .star import measured_arrays, sighting_noise
from .track import Track

FLAT = 1e6
"""m^2, prior variance before the first fix."""
RECONSTRUCTION = "MSMV-R is a reconstruction: the equations of MSMV are not public; the paper's curve is not matched"


@dataclass(frozen=True, eq=False)
class Msmv:
    """Kalman filter of the ego with one pseudo-fix per neighbour: y_j = p_j - rho(r_ij), C_j = P_j + J C_r J^T.

    p_j, P_j are the neighbour's own solo estimate. P^-1 += C_p^-1 + sum C_j^-1 as in methods.md section 2.2. The errors
    of p_j are correlated in time, so the covariance is over-confident (data incest), and NEES shows it. With identity
    knowledge all covariances are unit matrices and the message is shorter.

    Args:
        knowledge: "identity", "nominal" or a Knowledge.
    """

    knowledge: Knowledge | str = "identity"
    name: str = "msmv-r"
    cooperative: bool = True

    @property
    def message(self) -> Message:
        """Without covariance under identity knowledge, with it otherwise."""
        name = self.knowledge if isinstance(self.knowledge, str) else self.knowledge.name
        return ESTIMATE if name == "identity" else ESTIMATE_AND_COV

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent."""
        known = resolve(self.knowledge, recording)
        process = known.process_variance(recording)
        solo = solo_filter(recording.gnss, recording.velocity, process, known.gnss_variance, recording.dt)

        def drive(ego: int, box: Inbox) -> Iterator[Estimate]:
            from ..kernels.pseudo_fix import follow as compiled

            x, cov, theirs = compiled(measured_arrays(recording, ego, box), assumed, solo, known.gnss_variance, FLAT)
            yield Estimate(slice(None), x, cov, box.link, theirs)

        if use_kernels():
            assumed = (np.ascontiguousarray(process), *sighting_noise(known))
            return follow_egos(self, recording, egos, drive, (RECONSTRUCTION,))
        process = np.broadcast_to(process, recording.gnss.shape)

        def follow(ego: int, box: Inbox) -> Iterator[Estimate]:
            x: Floats = recording.gnss[:, 0, ego]
            cov: Floats = np.broadcast_to(FLAT * np.eye(3), (recording.runs, 3, 3))
            for t in range(len(recording.t)):
                if t > 0:
                    x = x + recording.dt * recording.velocity[:, t, ego]
                    cov = cov + process[:, t, ego, :, None] * np.eye(3)
                theirs, pseudo, weight = _pseudo_fixes(recording, box, t, solo, process, known)
                x, cov = _fuse(x, cov, recording.gnss[:, t, ego], known.gnss_variance, pseudo, weight)
                yield Estimate(t, x, cov, box.link[box.start[t] : box.start[t + 1]], theirs)

        return follow_egos(self, recording, egos, follow, (RECONSTRUCTION,))


def _pseudo_fixes(
    recording: Recording, box: Inbox, t: int, solo: tuple[Floats, Floats], process: Floats, known: Knowledge
) -> tuple[Floats, Floats, Floats]:
    """What the neighbours say of themselves (R, k, 3), hence of the ego (R, k, 3), and its information (R, k, 3, 3).

    A late estimate is brought forward with its velocity; its variance grows by the process noise of each step. Each
    message makes one pseudo-fix, at the step at which it arrives.
    """
    span = slice(box.start[t], box.start[t + 1])
    runs = np.arange(recording.runs)[:, None]
    who, held = recording.links.neighbour[box.link[span]], box.newest[:, span] >= 0
    sent = np.where(held, box.newest[:, span], t)
    age = (t - sent)[..., None]
    theirs = solo[0][runs, sent, who] + age * recording.dt * recording.velocity[runs, sent, who]
    relative = recording.relative[:, box.link[span]]
    pseudo_cov = known.relative_cov(relative)
    if known.sensors is not None:
        spread = solo[1][runs, sent, who] + age * process[runs, sent, who]
        pseudo_cov = pseudo_cov + spread[..., None] * np.eye(3)
    weight = np.linalg.inv(pseudo_cov) * box.fresh[:, span][..., None, None]
    return np.where(held[..., None], theirs, np.nan), theirs - to_vector(relative), weight


def _fuse(
    prior: Floats, prior_cov: Floats, fix: Floats, fix_variance: Floats, pseudo: Floats, weight: Floats
) -> tuple[Floats, Floats]:
    """P^-1 + C_p^-1 + sum_j C_j^-1 and the weighted mean that belongs to it."""
    information = np.linalg.inv(prior_cov) + np.diag(1.0 / fix_variance) + weight.sum(axis=1)
    pull = (fix - prior) / fix_variance + (weight @ (pseudo - prior[:, None])[..., None])[..., 0].sum(axis=1)
    cov = np.linalg.inv(information)
    return prior + (cov @ pull[..., None])[..., 0], cov
