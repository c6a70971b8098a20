"""The methods that need no training, by the names of tables, figures and the command line."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from ..one_file import in_file
from ..plugins import find, names
from .adaptive import AdaptiveKalman
from .admm import ConsensusADMM
from .batch_smoother import BatchSmoother
from .central_filter import CentralFilter
from .cooperative_map import CooperativeMAP
from .covariance_intersection import CovarianceIntersection
from .diffusion import Diffusion
from .drift_filter import DriftFilter
from .fixed_lag import FixedLagSmoother
from .gbp import GaussianBeliefPropagation
from .gnss import Gnss
from .joint_filter import JointFilter
from .kalman import Kalman
from .knowledge import Knowledge
from .lkf_sa import LaplacianKalman
from .mds import Mds
from .moving_horizon import MovingHorizon
from .msmv import Msmv
from .qcqp_sdr import QcqpSdr
from .track import Method
from .variational import VariationalKalman

Factory = Callable[[Knowledge | str], Method]
"""What a method assumes about noise -> the method. A third party's entry point in `coopoc.methods` is one, too."""

METHODS: Mapping[str, Factory] = {
    "gnss": lambda knowledge: Gnss(),
    "kalman": lambda knowledge: Kalman(knowledge),
    "kalman-adaptive": lambda knowledge: AdaptiveKalman(),
    "kalman-variational": lambda knowledge: VariationalKalman(),
    "lkf-sa": lambda knowledge: LaplacianKalman(knowledge),
    "lkf-sa-edge": lambda knowledge: JointFilter(knowledge, exact=False, name="lkf-sa-edge"),
    "msmv-r": lambda knowledge: Msmv(knowledge),
    "drift": lambda knowledge: DriftFilter(knowledge),
    "joint": lambda knowledge: JointFilter(knowledge),
    "cooperative-map": lambda knowledge: CooperativeMAP(knowledge=knowledge),
    "cooperative-map-5": lambda knowledge: CooperativeMAP(knowledge=knowledge, window=5, name="cooperative-map-5"),
    "cooperative-map-gnc": lambda knowledge: CooperativeMAP(
        knowledge=knowledge, window=5, robust="truncated", name="cooperative-map-gnc"
    ),
    "ci": lambda knowledge: CovarianceIntersection(knowledge),
    "split-ci": lambda knowledge: CovarianceIntersection(knowledge, split=True, name="split-ci"),
    "mds": lambda knowledge: Mds(knowledge),
    "qcqp-sdr": lambda knowledge: QcqpSdr(knowledge),
    "gbp": lambda knowledge: GaussianBeliefPropagation(knowledge),
    "admm": lambda knowledge: ConsensusADMM(knowledge),
    "diffusion": lambda knowledge: Diffusion(knowledge),
    "diffusion-anchored": lambda knowledge: Diffusion(knowledge, anchored=True, name="diffusion-anchored"),
    "central-filter": lambda knowledge: CentralFilter(knowledge),
    "batch-smoother": lambda knowledge: BatchSmoother(knowledge),
    "fixed-lag": lambda knowledge: FixedLagSmoother(knowledge=knowledge),
    "mhe": lambda knowledge: MovingHorizon(knowledge=knowledge),
}

WHOLE_FLEET = frozenset({"gbp", "admm", "diffusion", "diffusion-anchored", "central-filter", "batch-smoother"})
"""Methods that need what every vehicle measured, not only the egos."""


def needs_whole_fleet(name: str) -> bool:
    """Whether a method needs what every vehicle measured; one from elsewhere says so by `whole_fleet = True`.

    >>> needs_whole_fleet("gbp"), needs_whole_fleet("joint")
    (True, False)
    """
    if name in METHODS:
        return name in WHOLE_FLEET
    registered = in_file(name) or name in names("coopoc.methods")
    return registered and bool(getattr(find("coopoc.methods", name), "whole_fleet", False))
