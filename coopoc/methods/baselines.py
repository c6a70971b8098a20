"""Published baselines: LKF-SA, the Laplacian Kalman filter over the star, and MSMV-R, pseudo-fixes of neighbours."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Floats
from ..kernels.stars.lkf_sa import run_lkf_sa
from ..kernels.stars.pseudo_fixes import run_intersection
from ..world.recording import Recording, Vehicles, check_recording
from ..world.v2x import ESTIMATE, ESTIMATE_AND_COV, FIX_AND_VELOCITY, Message
from .egos import filter_stars
from .gaps import in_stretches
from .kalman import fix_noise, solo_filter
from .noise_model import NoiseModel, resolve
from .track import Checked, Track

RECONSTRUCTION = "MSMV-R is a reconstruction: the equations of MSMV are not public; the paper's curve is not matched"


@dataclass(frozen=True, eq=False)
class LKFSA(Checked):
    r"""Kalman filter per axis with $z = [\delta; z_\mathrm{gnss}]$, $H = [L; I]$, $L$ the star's graph Laplacian.

    $$ \delta_i = -\sum_j (x_j - x_i) \text{ as measured}, \qquad \mathrm{cov}(\delta) = \sigma^2 L $$

    With the identity noise model this is LKF-SA as the paper compares with it. The covariance of $\delta$ is not the
    diagonal used here, so no weighting of this form is right; that of `JointFilter(exact=False)`, the edge form, is.
    With other noise models $\delta_i$ has variance $\deg_i$ times the mean per-axis variance of the converted vectors.
    A member whose measurement is incomplete has no edge.

    Args:
        noise_model: "identity" (the paper), "nominal" or a NoiseModel.
    """

    noise_model: NoiseModel | str = "identity"
    name: str = "lkf-sa"
    cooperative = True
    message = FIX_AND_VELOCITY

    @in_stretches
    def __call__(self, recording: Recording, egos: Vehicles = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent."""
        return filter_stars(self, recording, egos, resolve(self.noise_model, recording), run_lkf_sa)


@dataclass(frozen=True, eq=False)
class MSMV(Checked):
    r"""Kalman filter of the ego with one pseudo-fix $y_j$ per neighbour.

    $$
    y_j = p_j - \rho(r_{ij}), \qquad C_j = P_j + J C_r J^\top, \qquad P^{-1} \leftarrow P^{-1} + C_p^{-1} + \sum_j
    C_j^{-1}
    $$

    $p_j$, $P_j$ are the neighbour's own solo estimate. The errors of $p_j$ are correlated in
    time, so the covariance is over-confident (data incest), and NEES shows it. With the identity noise model all
    covariances are unit matrices and the message is shorter. The equations of MSMV are not public: this is a
    reconstruction.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
    """

    noise_model: NoiseModel | str = "identity"
    name: str = "msmv-r"
    cooperative = True

    @property
    def message(self) -> Message:
        """Without covariance under the identity noise model, with it otherwise."""
        name = self.noise_model if isinstance(self.noise_model, str) else self.noise_model.name
        return ESTIMATE if name == "identity" else ESTIMATE_AND_COV

    @in_stretches
    def __call__(self, recording: Recording, egos: Vehicles = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent."""
        noise_model, columns = resolve(self.noise_model, recording), check_recording(recording).columns(egos)
        x, p = solo_estimates(recording, noise_model, columns)
        return filter_stars(
            self,
            recording,
            egos,
            replace(noise_model, notes=(*noise_model.notes, RECONSTRUCTION)),
            lambda inputs, assumed: run_intersection(inputs, assumed, False, False, True),
            x,
            broadcast=p,
            growth=(0.0, 1.0),
            acceleration=0.0,
        )


def solo_estimates(
    recording: Recording, noise_model: NoiseModel, egos: Sequence[int], robust: bool = False
) -> tuple[Floats, Floats]:
    """Solo estimates (R, T, N, 3) m of all vehicles in the stars of some egos (columns), and their variances m^2;
    `robust` as of Kalman."""
    links = recording.links
    members = np.union1d(egos, links.neighbour[np.isin(links.observer, egos)])
    return solo_filter(recording, members, noise_model, fix_noise(noise_model, robust), in_place=True)[:2]
