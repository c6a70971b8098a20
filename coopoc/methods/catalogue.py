"""The methods that need no training, by the names of tables, figures and the command line."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from ..one_file import in_file
from ..plugins import find, names
from .baselines import LKFSA, MSMV
from .centralised import BatchSmoother, CentralFilter
from .covariance_intersection import CovarianceIntersection
from .decentralised import ConsensusADMM, GaussianBeliefPropagation
from .drift_filter import DriftFilter
from .joint_filter import JointFilter
from .kalman import GNSS, AdaptiveKalman, Kalman
from .mds import MDS
from .noise_model import NoiseModel
from .qcqp_relaxation import QCQPRelaxation
from .sliding_window import CooperativeMAP, FixedLagSmoother, MovingHorizon
from .track import Method

Factory = Callable[[NoiseModel | str], Method]
"""Noise model -> the method. A third party's entry point in `coopoc.methods` is one, too."""

METHODS: Mapping[str, Factory] = {
    "gnss": lambda noise_model: GNSS(),
    "kalman": lambda noise_model: Kalman(noise_model),
    "kalman-adaptive": lambda noise_model: AdaptiveKalman(),
    "lkf-sa": lambda noise_model: LKFSA(noise_model),
    "lkf-sa-edge": lambda noise_model: JointFilter(noise_model, exact=False, name="lkf-sa-edge"),
    "msmv-r": lambda noise_model: MSMV(noise_model),
    "drift": lambda noise_model: DriftFilter(noise_model),
    "joint": lambda noise_model: JointFilter(noise_model),
    "cooperative-map": lambda noise_model: CooperativeMAP(noise_model=noise_model),
    "cooperative-map-5": lambda noise_model: CooperativeMAP(
        noise_model=noise_model, window=5, name="cooperative-map-5"
    ),
    "cooperative-map-gnc": lambda noise_model: CooperativeMAP(
        noise_model=noise_model, window=5, robust="truncated", name="cooperative-map-gnc"
    ),
    "ci": lambda noise_model: CovarianceIntersection(noise_model),
    "split-ci": lambda noise_model: CovarianceIntersection(noise_model, split=True, name="split-ci"),
    "mds": lambda noise_model: MDS(noise_model),
    "qcqp-relaxation": lambda noise_model: QCQPRelaxation(noise_model),
    "gbp": lambda noise_model: GaussianBeliefPropagation(noise_model),
    "admm": lambda noise_model: ConsensusADMM(noise_model),
    "central-filter": lambda noise_model: CentralFilter(noise_model),
    "batch-smoother": lambda noise_model: BatchSmoother(noise_model),
    "fixed-lag": lambda noise_model: FixedLagSmoother(noise_model=noise_model),
    "mhe": lambda noise_model: MovingHorizon(noise_model=noise_model),
}

WHOLE_FLEET = frozenset({"gbp", "admm", "central-filter", "batch-smoother"})
"""Methods that need what every vehicle measured, not only the egos."""


def needs_whole_fleet(name: str) -> bool:
    """Whether a method needs what every vehicle measured; one from elsewhere declares it by `whole_fleet = True`.

    >>> needs_whole_fleet("gbp"), needs_whole_fleet("joint")
    (True, False)
    """
    if name in METHODS:
        return name in WHOLE_FLEET
    registered = in_file(name) or name in names("coopoc.methods")
    return registered and bool(getattr(find("coopoc.methods", name), "whole_fleet", False))
