"""CovarianceIntersection: each neighbour's solo estimate, seen from the ego, fused without assuming independence."""

from dataclasses import dataclass

from ..kernels.stars.messages import ESTIMATE_GROWTH
from ..kernels.stars.pseudo_fixes import run_intersection
from ..world.recording import Recording, Vehicles, check_recording
from ..world.v2x import ESTIMATE_AND_COV
from .baselines import solo_estimates
from .egos import filter_stars
from .gaps import in_stretches
from .noise_model import NoiseModel, resolve
from .odometry_fault import with_odometry
from .track import Checked, Track


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
