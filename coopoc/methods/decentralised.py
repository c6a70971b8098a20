"""Decentralised whole-fleet methods: Gaussian belief propagation and consensus ADMM, in rounds of messages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..world.recording import Recording
from ..world.v2x import Message
from .noise_model import NoiseModel
from .track import Track, check_options
from .whole_fleet import Answer, fleet_track

if TYPE_CHECKING:
    from ..kernels.fleets.graph import Assumed, Measured, Pairs

LOOPS = "GBP's covariance of a step leaves out the loops of the network, which makes it over-confident"
OWN = "ADMM exchanges positions only: its covariance is that of each vehicle's own filter, without the neighbours' gain"

LEAST, PENALTY = 3.0, 6.75
"""1/m^2, and a multiple of a fix's information on its best axis: the larger of the two. With more, vehicles stay near
their own beliefs; with less, three rounds do not agree, and weigh precise fixes too little."""


@dataclass(frozen=True, eq=False)
class GaussianBeliefPropagation:
    r"""Per step a prediction and the own fix, then `rounds` of messages between the vehicles in contact.

    With $(w, W)$ the information vector and matrix of the pair's measurements, and $(\eta, \Lambda)$ the sender's
    belief less the receiver's last message, the message about the receiver is

    $$
    \Lambda_m = W (W + \Lambda)^{-1} \Lambda, \qquad \eta_m = W (W + \Lambda)^{-1} \eta + \Lambda (W +
    \Lambda)^{-1} w,
    $$

    and a belief is the prior and the sum of the messages. A pair's two measurements are one factor, so that a tree of
    vehicles stays a tree: there a step's beliefs are exact after as many rounds as the tree is wide. On loops the means
    are exact once converged, and the covariances too small.

    The covariance of the vehicle's own filter, without neighbours, goes on to the next step: beliefs carried on as if
    they were independent soon leave the fixes no weight (1.17 m against 0.46 m on town10 at K = 10).

    Sent per pair, way and round: (eta, Lambda) of the sender, 9 numbers, 36 B; the first round also brings its
    measurement of the receiver (3), id and time (2). The receiver computes Lambda_m, because it has both measurements.
    A pair takes part in a step if messages get through both ways: moving one end alone is worse than not moving
    (town10, K = 10, 10 % loss: 0.55 m against 0.49 m).

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        rounds: of messages a step.
        damping: share of the old message that stays in the new one, in [0, 1); the fixed point is the same.
        robust: an innovation beyond its gate weighs less, far beyond it nothing (`coopoc.kernels.gate`); False believes
            every number.

    References:
        Murai et al., "A Robot Web for Distributed Many-Device Localization", IEEE T-RO 40, 2024.
    """

    noise_model: NoiseModel | str = "nominal"
    rounds: int = 3
    damping: float = 0.0
    robust: bool = True
    name: str = "gbp"
    cooperative: bool = True

    def __post_init__(self) -> None:
        check_options(self)
        if self.rounds < 1:
            raise InputError("rounds", self.rounds, "must be a whole number >= 1", "Use 1 for one exchange a step.")
        if not 0 <= self.damping < 1:
            raise InputError("damping", self.damping, "must be in [0, 1)", "Use 0 for none, 0.4 to 0.6 for hard loops.")

    @property
    def message(self) -> Message:
        """The sender's belief, to each vehicle in contact and in every round; its measurement, id and time once."""
        return Message("belief", 9, rounds=self.rounds, opening=5, unicast=True)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or if not all vehicles observed."""

        def solve(measured: Measured, pairs: Pairs, assumed: Assumed) -> Answer:
            from ..kernels.fleets.belief_propagation import run_filter
            from ..kernels.fleets.graph import new_edges

            result = run_filter(measured, pairs, assumed, new_edges(pairs), int(self.rounds), float(self.damping))
            return Answer(*result, self.rounds, (LOOPS,))

        return fleet_track(self, self.noise_model, self.robust, recording, egos, solve)


@dataclass(frozen=True, eq=False)
class ConsensusADMM:
    r"""Per step a prediction and the own fix, then `rounds` iterations towards the most probable positions of the
    fleet.

    Vehicle i holds copies y of itself and of those in contact. Its cost f_i is its own belief and half of what each of
    its pairs measured; with $a_k = z_k - u_k$ and scaled duals $u$:

    $$
    y \leftarrow \arg\min_y f_i(y) + \tfrac{\rho}{2} \sum_k \lVert y_k - a_k \rVert^2, \quad z_k \leftarrow
    \mathrm{mean}(y_k + u_k), \quad u \leftarrow u + y - z
    $$

    The limit is the fleet's weighted least-squares solution of the step. z starts at the beliefs (warm), u at zero: the
    duals of the last step are its measurement noise.

    Sent per pair, way and round: the copy of the receiver, and then the sender's z, 3 numbers each (the last z
    is not sent); the first also brings belief (9), measurement (3), id and time (2). A pair takes part in a step if
    messages get through both ways.

    The covariance it claims is that of each vehicle's own filter: no vehicle can compute the gain of the
    exchange. So it is conservative: NEES is 1 to 2 on town10, not 3.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel.
        rounds: iterations a step.
        rho: 1/m^2, the penalty; any positive one converges. None: 3 1/m^2 or 6.75 times the information of a fix, the
            larger, so that few rounds suffice however certain fixes are.
        robust: an innovation beyond its gate weighs less, far beyond it nothing (`coopoc.kernels.gate`); False believes
            every number.

    References:
        Boyd et al., "Distributed Optimization and Statistical Learning via the ADMM", Foundations and Trends in Machine
        Learning 3, 2011, section 7.2.
    """

    noise_model: NoiseModel | str = "nominal"
    rounds: int = 3
    rho: float | None = None
    robust: bool = True
    name: str = "admm"
    cooperative: bool = True

    def __post_init__(self) -> None:
        check_options(self)
        if self.rounds < 1:
            raise InputError("rounds", self.rounds, "must be a whole number >= 1", "Use 1 for one exchange a step.")
        if self.rho is not None and not (np.isfinite(self.rho) and self.rho > 0):
            raise InputError(
                "rho", self.rho, "must be positive and finite", "Leave it out for one that fits the fixes."
            )

    @property
    def message(self) -> Message:
        """A copy, then a mean, to each vehicle in contact and in every round; belief, measurement, id and time once."""
        return Message("copy or mean", 3, rounds=2 * self.rounds - 1, opening=14, unicast=True)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or if not all vehicles observed."""

        def solve(measured: Measured, pairs: Pairs, assumed: Assumed) -> Answer:
            from ..kernels.fleets.admm import run_filter
            from ..kernels.fleets.graph import new_edges

            certain = PENALTY / np.median(assumed.fix.min(axis=-1))
            rho = max(LEAST, certain) if self.rho is None else self.rho
            result = run_filter(measured, pairs, assumed, new_edges(pairs), int(self.rounds), float(rho))
            return Answer(*result, self.message.rounds, (OWN,))

        return fleet_track(self, self.noise_model, self.robust, recording, egos, solve)
