"""The joint cooperative filter: ego and neighbours in one state, with one exact Gauss-Newton step."""

from dataclasses import dataclass

from ..kernels.stars.joint_filter import run_filter
from ..world.recording import Recording, Vehicles
from ..world.v2x import FIX_AND_VELOCITY
from .egos import filter_stars
from .gaps import in_stretches
from .noise_model import NoiseModel, resolve
from .odometry_fault import with_odometry
from .track import Checked, Track


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
            self, recording, egos, noise, lambda inputs, assumed: run_filter(inputs, assumed, refine, gates)
        )
