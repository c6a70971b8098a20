"""The variational Bayes noise-adaptive Kalman filter: position and variance of the fixes are estimated together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..kernels.solo import FixNoise
from ..short_repr import short_repr
from .adaptive import NoiseAdaptive
from .noise_model import NoiseModel


@dataclass(frozen=True, eq=False)
class VariationalKalman(NoiseAdaptive):
    """Kalman filter with an inverse-gamma belief IG(alpha, beta) of the GNSS variance of each axis.

    Per step alpha and beta are multiplied by rho, alpha += 1/2, and `iterations` times, with r = beta / alpha,

        k = p / (p + r),  x = x_prior + k v,  beta = rho beta_before + ((1 - k)^2 v^2 + (1 - k) p) / 2,

    which climbs the evidence bound of q(x) q(r). Here weight = 2 alpha and noise = beta / alpha. Unlike in the paper p
    is reread with the noise believed now (`Belief`); without that the start decides NEES for half a minute.

    Args:
        prior_weight: 2 alpha at the start.
        rho: forgetting per fix, in (0, 1].
        iterations: of the fixed point. The others as in `NoiseAdaptive`.

    Source: Sarkka and Nummenmaa, IEEE TAC 54(3) 2009, section III. Defaults were chosen on `town10-validation`
    (docs/methods.md).

    >>> VariationalKalman().start().step([1.0, 2.0, 0.0], [9.0, 0.0, 0.0], dt=0.1)[0].tolist()
    [1.0, 2.0, 0.0]
    """

    rho: float = 0.99
    iterations: int = 3
    name: str = "kalman-variational"

    __repr__ = short_repr

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.rho <= 1:
            raise InputError("rho", self.rho, "must be in (0, 1]", "1 never forgets.")
        if self.iterations != int(self.iterations) or self.iterations < 1:
            raise InputError("iterations", self.iterations, "must be a whole number >= 1", "Two or three are enough.")

    @property
    def fixes(self) -> FixNoise:
        """Inverse-gamma belief: beta / alpha and 2 alpha of the fixed point."""
        variance = NoiseModel.nominal(self.assumed).gnss_variance
        return FixNoise(variance, float(self.prior_weight), np.inf, float(self.rho), int(self.iterations))
