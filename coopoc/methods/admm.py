"""Consensus ADMM over the whole fleet: the most probable positions of each step, by exchange of positions only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Floats
from ..errors import InputError
from ..kernels.compile import use_kernels
from ..world.exchange import Exchange, exchange
from ..world.recording import Recording
from ..world.v2x import Message
from .knowledge import Knowledge, resolve
from .network import Network, apply, collect
from .track import Track
from .whole_fleet import brought_forward, fleet_track, follow_compiled, follow_fleet

OWN = "ADMM exchanges positions only: its covariance is that of each vehicle's own filter, without the neighbours' gain"


@dataclass(frozen=True, eq=False)
class ConsensusADMM:
    """Per step a prediction and the own fix, then `rounds` iterations towards the most probable positions of the fleet.

    Vehicle i holds copies y of itself and of those in contact. Its cost f_i is its own belief and half of what each of
    its pairs measured; with a_k = z_k - u_k and scaled duals u (methods.md section 6.7; Boyd et al., Foundations and
    Trends in Machine Learning 3, 2011, section 7):

        y = argmin f_i(y) + rho/2 sum_k |y_k - a_k|^2,   z_k = mean over holders of y_k + u_k,   u += y - z.

    The limit is the fleet's weighted least-squares solution of the step. z starts at the beliefs (warm), u at zero: the
    duals of the last step are its measurement noise.

    Sent per pair, way and round: the copy of the receiver, and then the sender's z, 3 numbers each (nobody waits for
    the last z); the first also brings belief (9), sighting (3), id and time (2). A pair takes part in a step if
    messages get through both ways.

    The covariance it claims is that of each vehicle's own filter: nobody learns how much the exchange has gained, and
    it is no less certain than that as long as neighbours help. So it is cautious: NEES is 1 to 2 on town10, not 3.

    Args:
        knowledge: "identity", "nominal" or a Knowledge. rounds: iterations a step.
        rho: 1/m^2, the penalty; any positive one converges.
    """

    knowledge: Knowledge | str = "nominal"
    rounds: int = 3
    rho: float = 3.0
    name: str = "admm"
    cooperative: bool = True

    def __post_init__(self) -> None:
        if self.rounds != int(self.rounds) or self.rounds < 1:
            raise InputError("rounds", self.rounds, "must be a whole number >= 1", "Use 1 for one exchange a step.")
        if not (np.isfinite(self.rho) and self.rho > 0):
            raise InputError("rho", self.rho, "must be positive and finite", "About the information of a fix, 1/m^2.")

    @property
    def message(self) -> Message:
        """A copy, then a mean, to each vehicle in contact and in every round; belief, sighting, id and time once."""
        return Message("copy or mean", 3, rounds=2 * self.rounds - 1, opening=14, unicast=True)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or if not all vehicles observed."""
        known = resolve(self.knowledge, recording)

        def solve(contacts: Exchange) -> tuple[Floats, Floats]:
            if use_kernels():
                x, cov = follow_compiled(recording, contacts, known, self.rounds, rho=self.rho)
            else:
                x, cov = follow_fleet(self, recording, contacts, known, self.cooperate)
            return brought_forward(x, cov, recording, known, contacts.delay)

        return fleet_track(self, recording, egos, lambda: exchange(recording, self.message), solve, (OWN,))

    def cooperate(self, graph: Network) -> tuple[Floats, Floats]:
        """Positions (R, n, 3) after the iterations of one step, and the beliefs' covariances as they were."""
        n, eye = len(graph.here), np.eye(3)
        alive = (graph.to_first & graph.to_second)[..., None]
        holder, of = np.concatenate([[graph.first, graph.second], [graph.second, graph.first]], axis=1)
        held = np.tile(alive, (1, 2, 1)).astype(float)
        half = np.tile(graph.weight / 2 * alive[..., None], (1, 2, 1, 1))
        pull = np.concatenate([graph.pull, -graph.pull], axis=1) / 2 * held
        inner = np.linalg.inv(half + self.rho * eye)
        outer = np.linalg.inv(np.linalg.inv(graph.cov) + self.rho * (eye + collect(inner @ half, holder, n)))
        holders = 1.0 + collect(held, of, n)
        z, dual, dual_own = np.zeros_like(graph.x), np.zeros_like(pull), np.zeros_like(graph.x)
        for _ in range(self.rounds):
            a, a_own = z[:, of] - dual, z - dual_own
            own = self.rho * apply(outer, a_own + collect(apply(inner, apply(half, a) - pull), holder, n))
            copy = apply(inner, apply(half, own[:, holder]) + pull + self.rho * a)
            z = (own + dual_own + collect(held * (copy + dual), of, n)) / holders
            dual, dual_own = dual + copy - z[:, of], dual_own + own - z
        return graph.x + z, graph.cov
