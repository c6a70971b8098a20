"""Optimization-based cooperative localization with learned-gain comparisons.

A Fleet drives. `observe` turns it into a Recording under Sensors and a V2X budget. A Method turns a Recording into a
Track. `rt_le` compares Track and Fleet. A Study does this over a grid and yields Results.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .errors import InputError as InputError
    from .errors import MissingLibraryError as MissingLibraryError
    from .evaluate.bounds import bound_rt_le as bound_rt_le
    from .evaluate.bounds import fleet_bound as fleet_bound
    from .evaluate.bounds import posterior_bound as posterior_bound
    from .evaluate.ledger import Ledger as Ledger
    from .evaluate.ledger import break_even as break_even
    from .evaluate.metrics import max_error as max_error
    from .evaluate.metrics import nees as nees
    from .evaluate.metrics import rt_le as rt_le
    from .evaluate.statistics import paired_difference as paired_difference
    from .fleets import load as load
    from .methods.adaptive import AdaptiveKalman as AdaptiveKalman
    from .methods.admm import ConsensusADMM as ConsensusADMM
    from .methods.batch_smoother import BatchSmoother as BatchSmoother
    from .methods.central_filter import CentralFilter as CentralFilter
    from .methods.cooperative_map import CooperativeMAP as CooperativeMAP
    from .methods.covariance_intersection import CovarianceIntersection as CovarianceIntersection
    from .methods.diffusion import Diffusion as Diffusion
    from .methods.fixed_lag import FixedLagSmoother as FixedLagSmoother
    from .methods.gbp import GaussianBeliefPropagation as GaussianBeliefPropagation
    from .methods.gnss import Gnss as Gnss
    from .methods.joint_filter import JointFilter as JointFilter
    from .methods.kalman import Kalman as Kalman
    from .methods.knowledge import Knowledge as Knowledge
    from .methods.lkf_sa import LaplacianKalman as LaplacianKalman
    from .methods.mds import Mds as Mds
    from .methods.moving_horizon import MovingHorizon as MovingHorizon
    from .methods.msmv import Msmv as Msmv
    from .methods.qcqp_sdr import QcqpSdr as QcqpSdr
    from .methods.star_stream import Sighting as Sighting
    from .methods.track import Method as Method
    from .methods.track import Track as Track
    from .methods.variational import VariationalKalman as VariationalKalman
    from .optimize.constraint import Constraint as Constraint
    from .optimize.factor import Factor as Factor
    from .optimize.graphs import read as read
    from .optimize.losses import Loss as Loss
    from .optimize.problem import Problem as Problem
    from .optimize.solution import Solution as Solution
    from .optimize.solve import Backend as Backend
    from .optimize.solve import backends as backends
    from .optimize.solve import solve as solve
    from .optimize.space import pose as pose
    from .study.results import Results as Results
    from .study.run import run as run
    from .study.study import Study as Study
    from .world.channel_load import channel_load as channel_load
    from .world.fleet import Fleet as Fleet
    from .world.recording import Links as Links
    from .world.recording import Recording as Recording
    from .world.sensing import observe as observe
    from .world.sensors import Sensors as Sensors
    from .world.v2x import V2X as V2X
    from .world.v2x import Message as Message

_HOME = {
    "InputError": "errors", "MissingLibraryError": "errors",
    "Fleet": "world.fleet", "Links": "world.recording", "Recording": "world.recording", "observe": "world.sensing",
    "Sensors": "world.sensors", "V2X": "world.v2x", "Message": "world.v2x",
    "Gnss": "methods.gnss", "Kalman": "methods.kalman", "Knowledge": "methods.knowledge",
    "AdaptiveKalman": "methods.adaptive", "VariationalKalman": "methods.variational",
    "Sighting": "methods.star_stream",
    "JointFilter": "methods.joint_filter", "LaplacianKalman": "methods.lkf_sa", "Msmv": "methods.msmv",
    "paired_difference": "evaluate.statistics",
    "max_error": "evaluate.metrics", "nees": "evaluate.metrics", "rt_le": "evaluate.metrics",
    "CovarianceIntersection": "methods.covariance_intersection", "Mds": "methods.mds", "QcqpSdr": "methods.qcqp_sdr",
    "FixedLagSmoother": "methods.fixed_lag", "MovingHorizon": "methods.moving_horizon",
    "GaussianBeliefPropagation": "methods.gbp", "ConsensusADMM": "methods.admm", "Diffusion": "methods.diffusion",
    "CentralFilter": "methods.central_filter", "BatchSmoother": "methods.batch_smoother",
    "posterior_bound": "evaluate.bounds", "bound_rt_le": "evaluate.bounds", "fleet_bound": "evaluate.bounds",
    "Ledger": "evaluate.ledger", "break_even": "evaluate.ledger", "channel_load": "world.channel_load",
    "CooperativeMAP": "methods.cooperative_map", "Factor": "optimize.factor", "Problem": "optimize.problem",
    "Solution": "optimize.solution",
    "Backend": "optimize.solve", "backends": "optimize.solve", "solve": "optimize.solve",
    "Constraint": "optimize.constraint", "Loss": "optimize.losses", "pose": "optimize.space", "read": "optimize.graphs",
    "Results": "study.results", "Study": "study.study", "run": "study.run",
    "load": "fleets", "Method": "methods.track", "Track": "methods.track",
}  # fmt: skip

__version__ = "0.1.0"
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    """Import a public name from its home when it is first used: `import coopoc` stays quick."""
    if name not in _HOME:
        raise AttributeError(f"module 'coopoc' has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
