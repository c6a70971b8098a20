"""The joint cooperative filter: ego and neighbours in one state, with one exact Gauss-Newton step."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy.typing as npt

from ..kernels.stars.cooperative_state import NO_GUARDS
from ..kernels.stars.joint_filter import run_filter
from ..world.inbox import Inbox
from ..world.recording import Recording
from ..world.v2x import FIX_AND_VELOCITY, Message
from .egos import Estimate, follow_egos
from .noise_model import NoiseModel, constant_noise, resolve
from .options import check_options
from .star import assumptions, measurements, model_of
from .track import Track

if TYPE_CHECKING:
    from .star_stream import StarStream


@dataclass(frozen=True, eq=False)
class JointFilter:
    r"""Kalman filter of the star {ego} + neighbours in information form; axes couple through the relative covariances.

    $$
    \Lambda = P^{-1} + \mathrm{blkdiag}(R_i^{-1}) + B \, \mathrm{blkdiag}(C_e^{-1}) \, B^\top, \qquad \hat x =
    \Lambda^{-1} \eta
    $$

    $R_i$ is the covariance of a fix, $B$ the star's incidence matrix, $C_e$ the rotated covariance of the converted
    vector at the predicted geometry: at the measured one the weight would depend on the noise. Then, if `exact`, one
    Gauss-Newton step on range, azimuth and inclination themselves. The states of the other members stay when one joins
    or leaves.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        exact: False stops at the linear update, which is LKF-SA with the edges' covariance ("edge form").

    References:
        Lerro, Bar-Shalom, Tracking with debiased consistent converted measurements versus EKF, IEEE TAES 29(3), 1993.
        Bell, Cathey, The iterated Kalman filter update as a Gauss-Newton method, IEEE TAC 38(2), 1993.
    """

    noise_model: NoiseModel | str = "nominal"
    exact: bool = True
    name: str = "joint"
    cooperative: bool = True
    message: Message = FIX_AND_VELOCITY

    def __post_init__(self) -> None:
        check_options(self)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent."""
        known = resolve(self.noise_model, recording)
        assumed, refine = assumptions(recording, known), self.exact and known.exact_relative

        def run(ego: int, box: Inbox) -> Iterator[Estimate]:
            x, cov, neighbours = run_filter(measurements(recording, ego, box), assumed, refine)
            yield Estimate(slice(None), x, cov, box.link, neighbours)

        return follow_egos(self, recording, egos, run, known.notes, missing=True)

    def start(
        self,
        x0: npt.ArrayLike | None = None,
        *,
        interval: float | None = None,
        history: float = 10.0,
        max_age: float = 1.0,
    ) -> StarStream:
        """Start the filter for one step at a time: `step(gnss, velocity, dt, fix_age, neighbours=[...])`.

        For a recording the std of ranges that are finer than their angles bear is raised (`noise_model.resolve`); a
        stream does not know the ranges to come, and takes what the noise model says.

        Args:
            x0: (3,) m, known before the first step; None starts at the first fix.
            interval: s, the step that the assumed process noise belongs to: a motion of dt s has dt / interval times
                its variance. None: every step is one, with the error of one measured velocity, as in a recording.
            history: s, how old a delayed fix may be.
            max_age: s, older messages of neighbours are not used.

        >>> from coopoc.methods.star_stream import RelativeMeasurement
        >>> ego = JointFilter("identity").start()
        >>> seen = RelativeMeasurement("b", [9.0, 0.0, 1.5707963], gnss=[10.0, 0.0, 0.0], velocity=[9.0, 0.0, 0.0])
        >>> x, _ = ego.step([0.0, 0.0, 0.0], [9.0, 0.0, 0.0], dt=0.1, neighbours=[seen])
        >>> float(x[0].round(3)), float(ego.neighbours["b"][0].round(3))  # 10 m apart by the fixes, 9 m as measured
        (0.333, 9.667)
        """
        from .star_stream import StarStream

        known = constant_noise(self.noise_model)
        model = model_of(known, False)._replace(exact=float(self.exact and known.exact_relative))
        return StarStream(known, model, NO_GUARDS, x0, interval, history, max_age)
