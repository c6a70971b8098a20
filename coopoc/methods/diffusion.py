"""Diffusion: adapt-then-combine least mean squares on the fleet's graph Laplacian."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..errors import InputError
from ..world.exchange import exchange
from ..world.recording import Recording
from ..world.v2x import Message
from .noise_model import NoiseModel
from .options import check_options
from .track import Track
from .whole_fleet import Answer, fleet_track

if TYPE_CHECKING:
    from ..kernels.fleets.fleet_graph import Assumed, Measured, Pairs

DRIFT = "diffusion on L alone: positions come from the fixes of first meetings only and drift with the velocity noise"


@dataclass(frozen=True, eq=False)
class Diffusion:
    """ATC-LMS: adapt w_i on the vehicle's own row of the Laplacian, then combine.

        psi_i = w_i + mu L_i^T (delta_i - L_i w_i),   mu = min(2 / |L_i|^2, 0.1),
        w_i = c_ii psi_i + sum_j c_ij psi_j,          c_ij = 1 / max(deg_i + 1, deg_j + 1)  (Metropolis),

    with L_i = deg_i at i and -1 at those that i measures, and delta_i = -sum_j of its measured vectors x_j - x_i. As
    published the position comes only from the initialisation, because L is singular: it does not determine where the
    fleet is. Between steps estimates move with the measured velocities, so that they drift. `anchored` adds the row of
    the own fix, [L; I]. No weight here knows how good an estimate is: this is no filter, and it claims no covariance.

    Published are estimates of all vehicles in each, 150 rounds a step, a warm start for some neighbours and fixes for
    the others. Here a vehicle keeps estimates of itself and of those that it is in contact with, which is what its row
    needs and what a growing fleet does not lengthen; all are warm-started, a new one starts at its fix, or with
    `anchored` at its own estimate, which bears losses better.

    Broadcast per round: position and id of each vehicle kept (4 numbers) and of the sender (4), and time; the first
    round adds where to start the sender and its velocity (6). Two vehicles combine if the messages of the step get
    through both ways.

    Args:
        noise_model: "identity": rows of unit weight, as published. Otherwise delta_i has variance deg_i times the mean
            per-axis variance of its vectors, which weighs it against the own fix; without `anchored` nothing changes.
        rounds: of adaptation and combination a step.
        anchored: use the own fix at every step.

    References:
        Cattivelli and Sayed, "Diffusion LMS Strategies for Distributed Estimation", IEEE TSP 58, 2010.
    """

    noise_model: NoiseModel | str = "identity"
    rounds: int = 3
    anchored: bool = False
    name: str = "diffusion"
    cooperative: bool = True

    def __post_init__(self) -> None:
        check_options(self)
        if self.rounds < 1:
            raise InputError("rounds", self.rounds, "must be a whole number >= 1", "150 is as published.")

    @property
    def message(self) -> Message:
        """All estimates that the sender keeps, in every round; where to start it and its velocity once."""
        return Message("estimates", 5, rounds=self.rounds, opening=6, per_neighbour=4)

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos; InputError if one is unknown or absent, or if not all vehicles observed."""

        def solve(measured: Measured, pairs: Pairs, assumed: Assumed) -> Answer:
            from ..kernels.fleets.diffusion import follow

            x = follow(measured, pairs, assumed, int(self.rounds), self.anchored)
            return Answer(x, None, self.rounds, () if self.anchored else (DRIFT,))

        return fleet_track(self, self.noise_model, recording, egos, lambda: exchange(recording, self.message), solve)
