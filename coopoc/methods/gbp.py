"""Gaussian belief propagation over the whole fleet: each vehicle keeps its own belief and talks to those in contact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

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

LOOPS = "GBP's covariance of a step leaves out the loops of the network, which makes it over-confident"


@dataclass(frozen=True, eq=False)
class GaussianBeliefPropagation:
    """Per step a prediction and the own fix, then `rounds` of messages between the vehicles in contact.

    With W the information of the pair's sightings, w its pull, and (eta, Lambda) the sender's belief without what the
    receiver told it, the message about the receiver is

        Lambda_m = W (W + Lambda)^-1 Lambda,   eta_m = W (W + Lambda)^-1 eta + Lambda (W + Lambda)^-1 w,

    and a belief is the prior and the sum of the messages (methods.md section 6.8; Murai et al., T-RO 40, 2024). A
    pair's two sightings are one factor, so that a tree of vehicles stays a tree: there a step's beliefs are exact after
    as many rounds as the tree is wide. On loops the means are exact once converged, and the covariances too small.

    Sent per pair, way and round: (eta, Lambda) of the sender, 9 numbers, 36 B; the first round also brings its sighting
    of the receiver (3), id and time (2). The receiver computes Lambda_m, because it knows both sightings. A pair takes
    part in a step if messages get through both ways: moving one end alone is worse than not moving (town10, K = 10,
    10 % loss: 0.55 m against 0.49 m).

    Args:
        knowledge: "identity", "nominal" or a Knowledge. rounds: of messages a step.
        damping: share of the old message that stays in the new one, in [0, 1); the fixed point is the same.
        carry: covariance that goes on to the next step: "own" is that of the vehicle's own filter, without neighbours.
            "belief" takes what neighbours say at every step as independent news; it is not, and soon the fixes weigh
            nothing: 1.17 m on the first 300 steps of town10 at K = 10, against 0.46 m, and 0.95 m without neighbours.
    """

    knowledge: Knowledge | str = "nominal"
    rounds: int = 3
    damping: float = 0.0
    carry: Literal["own", "belief"] = "own"
    name: str = "gbp"
    cooperative: bool = True

    def __post_init__(self) -> None:
        if self.rounds != int(self.rounds) or self.rounds < 1:
            raise InputError("rounds", self.rounds, "must be a whole number >= 1", "Use 1 for one exchange a step.")
        if not 0 <= self.damping < 1:
            raise InputError("damping", self.damping, "must be in [0, 1)", "Use 0 for none, 0.4 to 0.6 for hard loops.")
        if self.carry not in ("own", "belief"):
            raise InputError("carry", repr(self.carry), "must be 'own' or 'belief'", "Pick one.")

    @property
    def message(self) -> Message:
        """The sender's belief, to each vehicle in contact and in every round; its sighting, id and time once."""
        return Message("belief", 9, rounds=self.rounds, opening=5, unicast=True)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or if not all vehicles observed."""
        known = resolve(self.knowledge, recording)

        def solve(contacts: Exchange) -> tuple[Floats, Floats]:
            if self.carry == "own" and use_kernels():
                x, cov = follow_compiled(recording, contacts, known, self.rounds, damping=self.damping)
            else:
                x, cov = follow_fleet(self, recording, contacts, known, self.cooperate, carry_own=self.carry == "own")
            return brought_forward(x, cov, recording, known, contacts.delay)

        return fleet_track(self, recording, egos, lambda: exchange(recording, self.message), solve, (LOOPS,))

    def cooperate(self, graph: Network) -> tuple[Floats, Floats]:
        """Positions (R, n, 3) and covariances (R, n, 3, 3) after the rounds of one step."""
        prior, n, pairs = np.linalg.inv(graph.cov), len(graph.here), len(graph.first)
        to, sender = np.concatenate([[graph.first, graph.second], [graph.second, graph.first]], axis=1)
        answer = (np.arange(2 * pairs) + pairs) % (2 * pairs)
        heard = np.tile(graph.to_first & graph.to_second, 2)[..., None]
        weight = np.tile(graph.weight, (1, 2, 1, 1))
        pull = np.concatenate([-graph.pull, graph.pull], axis=1)
        eta, told = np.zeros_like(pull), np.zeros_like(weight)
        for _ in range(self.rounds):
            cavity = (prior + collect(told, to, n))[:, sender] - told[:, answer]
            cavity_eta = collect(eta, to, n)[:, sender] - eta[:, answer]
            gain = weight @ np.linalg.inv(weight + cavity)
            new = gain @ cavity * heard[..., None]
            new_eta = (apply(gain, cavity_eta - pull) + pull) * heard
            told = self.damping * told + (1 - self.damping) * (new + np.swapaxes(new, -1, -2)) / 2
            eta = self.damping * eta + (1 - self.damping) * new_eta
        cov = np.linalg.inv(prior + collect(told, to, n))
        return graph.x + apply(cov, collect(eta, to, n)), cov
