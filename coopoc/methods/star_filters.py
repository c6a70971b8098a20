"""Filters of an ego's star: the joint filter, covariance intersection, and published baselines: LKF-SA, the Laplacian
Kalman filter, and MSMV-R, pseudo-fixes of neighbours."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Floats
from ..kernels.stars.joint_filter import run_filter
from ..kernels.stars.messages import ESTIMATE_GROWTH
from ..kernels.stars.pseudo_fixes import run_intersection
from ..world.recording import Recording, Vehicles, check_recording
from ..world.v2x import ESTIMATE, ESTIMATE_AND_COV, FIX_AND_VELOCITY, Message
from .egos import filter_stars
from .kalman import fix_noise, solo_filter
from .noise_model import NoiseModel, resolve
from .odometry_fault import with_odometry
from .track import Checked, Track, in_stretches

RECONSTRUCTION = "MSMV-R is a reconstruction: the equations of MSMV are not public; the paper's curve is not matched"


@dataclass(frozen=True, eq=False)
class JointFilter(Checked):
    r"""Kalman filter of the star {ego} + neighbours in information form; axes couple through the relative covariances.

    $$
    \Lambda = P^{-1} + \mathrm{blkdiag}(R_i^{-1}) + B \, \mathrm{blkdiag}(C_e^{-1}) \, B^\top, \qquad \hat x =
    \Lambda^{-1} \eta
    $$

    $R_i$ is the covariance of a fix, $B$ the star's incidence matrix, $C_e$ the rotated covariance of the converted
    vector at the predicted geometry: at the measured one the weight would depend on the noise. Then, if `exact`, one
    Gauss-Newton step on range, azimuth and inclination themselves. The states of the other members stay when one joins
    or leaves.

    Innovations beyond their gate weigh less, far beyond it nothing (`coopoc.kernels.gate`).

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        exact: False stops at the linear update, which is LKF-SA with the edges' covariance ("edge form").
        robust: False believes every number: the textbook filter. With the identity noise model nothing is gated.

    References:
        Lerro, Bar-Shalom, Tracking with debiased consistent converted measurements versus EKF, IEEE TAES 29(3), 1993.
        Bell, Cathey, The iterated Kalman filter update as a Gauss-Newton method, IEEE TAC 38(2), 1993.
    """

    noise_model: NoiseModel | str = "nominal"
    exact: bool = True
    robust: bool = True
    name: str = "joint"
    cooperative = True
    message = FIX_AND_VELOCITY

    @in_stretches
    def __call__(self, recording: Recording, egos: Vehicles = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent."""
        noise = resolve(self.noise_model, recording)
        if self.robust:
            recording, noise = with_odometry(recording, recording.observing(egos), noise)
        refine, gates = (wish and noise.exact_relative for wish in (self.exact, self.robust))
        return filter_stars(
            self, recording, egos, noise, lambda inputs, assumed: run_filter(inputs, assumed, refine, gates, False)
        )


@dataclass(frozen=True, eq=False)
class CovarianceIntersection(Checked):
    r"""Filter of the ego that fuses pseudo-fixes $y_j = p_j - \rho(r_{ij})$, $C_j = P_j + J C_r J^\top$, by (split) CI.

    $$ P^{-1} = w \, P_1^{-1} + (1 - w) \, P_2^{-1} $$

    A neighbour sends $p_j$, $P_j$ of its *solo* filter, which is consistent by itself; a recursive scheme in which
    neighbours cooperate would need the links of all vehicles. The errors of p_j at different steps are correlated, and
    so is the ego's error with all that it has fused: CI and split CI need not know how much. Three errors are
    independent of these and enter as such: the ego's own fix in both forms and, in split CI alone, the ego's motion
    and each relative measurement, so that only P_j is discounted. Neighbours' solo errors are taken as independent of
    each other, which a GNSS error common to all would break. Because a used message may be used again, the newest one
    serves, brought forward with its velocity, until it is too old.

    The weight $w$ minimises the trace of the fused covariance. It is 1 where a neighbour knows the ego worse than the
    ego does: CI gains little there.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        split: False for plain CI.
        robust: a fix or a pseudo-fix beyond its gate weighs less, far beyond it nothing, in the senders' filters, too.

    References:
        Julier, Uhlmann, General decentralized data fusion with covariance intersection, Handbook of Multisensor Data
        Fusion, 2001. Li, Nashashibi, Yang, Split covariance intersection filter, IEEE Intelligent Vehicles, 2013.

    >>> CovarianceIntersection().message.payload
    56
    """

    noise_model: NoiseModel | str = "nominal"
    split: bool = False
    robust: bool = True
    name: str = "ci"
    cooperative = True
    message = ESTIMATE_AND_COV

    @in_stretches
    def __call__(self, recording: Recording, egos: Vehicles = (0,)) -> Track:
        """Track of the egos and of their neighbours' estimates; InputError if one is unknown or absent.

        `age` steps later the velocity's error has come in age + 1 times, once in p_j itself and fully correlated:
        age (age + 2) of its variances at most. Relative noise is rotated to the predicted geometry: at the measured one
        the weight would depend on the noise.
        """
        noise_model, columns = resolve(self.noise_model, recording), check_recording(recording).columns(egos)
        gates = self.robust and noise_model.exact_relative
        if gates:
            recording, noise_model = with_odometry(recording, columns, noise_model)
        x, p = solo_estimates(recording, noise_model, columns, gates)
        return filter_stars(
            self,
            recording,
            egos,
            noise_model,
            lambda inputs, assumed: run_intersection(inputs, assumed, self.split, gates, False),
            x,
            broadcast=p,
            growth=ESTIMATE_GROWTH,
        )


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
        noise = resolve(self.noise_model, recording)
        return filter_stars(
            self, recording, egos, noise, lambda inputs, assumed: run_filter(inputs, assumed, False, False, True)
        )


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
