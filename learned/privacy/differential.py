"""Privacy: updates clipped and noised on the client, and the (epsilon, delta) that this is worth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from coopoc.errors import InputError, MissingLibraryError
from coopoc.world.noise import stream

from ..federation.aggregate import rule
from ..federation.means import uniform
from ..federation.rule import Combine, Rule
from .secure import SecureMean


@dataclass(frozen=True)
class Privacy:
    """Clients' updates clipped to an L2 norm and noised: u_i <- u_i min(1, S / ||u_i||) + N(0, (z S)^2 / C).

    The sum of C such updates carries noise of standard deviation z S, and no client's data moves it by more than S:
    one Gaussian mechanism per round. Neighbours are two trainings of which one has a client's update replaced by zero
    (client level, "zero-out"); against another client in its place the distance is 2 S, which is worth z / 2. The
    promise holds for whoever sees sums only. Whoever sees single updates, as a server without secure aggregation, has
    z / sqrt(C) before it. If clients drop out their noise is missing: see `spent`.

    Args:
        clip: S, in units of the weights. noise_multiplier: z; 0 clips only. delta: far below one over the clients.
        clients: C whose noise must add up to z S; None: all that adapt in the round. Name the fewest that will arrive
            (less those that may pool what they know) and the promise survives what is missing.
        keyed: draws keyed by seed, round and name, which repeat and which whoever knows the seed can subtract; a
            deployment wants False, NumPy's generator seeded by the operating system.

    Raises:
        InputError: clip or noise that cannot be, delta outside (0, 1), fewer than one client.

    Source: McMahan et al., ICLR 2018 (client level); Kairouz, Liu, Steinke, ICML 2021 (noise shared among clients);
    arXiv 2103.00039, definition 1.1 (zero-out).

    >>> Privacy(1.0, 0.0).protect(torch.tensor([[3.0, 4.0]]), ["a"], 0, 1).norm().item()
    1.0
    """

    clip: float
    noise_multiplier: float
    delta: float = 1e-5
    clients: int | None = None
    keyed: bool = True

    def __post_init__(self) -> None:
        if not 0 < self.clip < math.inf:
            raise InputError("clip", self.clip, "must be > 0 and finite", "Try the median norm of an update.")
        if not 0 <= self.noise_multiplier < math.inf:
            raise InputError("noise_multiplier", self.noise_multiplier, "must be >= 0 and finite", "0 clips only.")
        if not 0 < self.delta < 1:
            raise InputError("delta", self.delta, "must be in (0, 1)", "1e-5 is far below one over the clients.")
        if self.clients is not None and self.clients < 1:
            raise InputError("clients", self.clients, "must be >= 1", "Give those whose noise adds up, or None.")

    def protect(self, updates: Tensor, names: Sequence[str], seed: int, number: int) -> Tensor:
        """Updates (C, P) of the named clients in round `number` as they leave: clipped, plus noise of each client."""
        norms = torch.linalg.vector_norm(updates, dim=1, keepdim=True)
        shrunk = updates * torch.clamp(self.clip / norms, max=1.0)
        std = self.noise_multiplier * self.clip / math.sqrt(self.clients or len(updates))
        draws = [stream(seed, "privacy", number, n) if self.keyed else np.random.default_rng() for n in names]
        noise = std * np.stack([draw.standard_normal(updates.shape[1]) for draw in draws])
        return shrunk + torch.from_numpy(noise).to(updates.dtype)

    def check(self, aggregate: str | Rule | Combine) -> None:
        """InputError for a rule other than a sum with equal weights: the noise of one client alone hides too little.

        What a server makes of that sum afterwards costs nothing: `SecureMean("fedavgm", equal=True)`.
        """
        found = rule(aggregate)
        if not (found.uniform if isinstance(found, SecureMean) else getattr(found, "combine", None) is uniform):
            allowed = 'must be "uniform" or SecureMean(..., equal=True) with privacy'
            mend = "Other weights change how far one client can move the sum."
            raise InputError("aggregate", repr(aggregate), allowed, mend)

    def epsilon(self, rounds: int, share: float = 1.0) -> float:
        """`epsilon` of so many rounds with this noise and delta."""
        return epsilon(self.noise_multiplier, rounds, share, self.delta)

    def spent(self, arrived: Sequence[int], asked: Sequence[int] | None = None) -> float:
        """Epsilon of rounds whose sums held `arrived` updates: n of them carry noise of z S sqrt(n / C) only.

        Args:
            arrived: n of each round. asked: C of each round where `clients` is None; default the most that arrived.

        >>> Privacy(1.0, 4.0, clients=4).spent([4, 4]) < Privacy(1.0, 4.0, clients=4).spent([4, 3])
        True
        """
        expected = asked or [self.clients or max(arrived)] * len(arrived)
        shares = [n / c for n, c in zip(arrived, expected, strict=True) if n]
        if not shares or self.noise_multiplier == 0:
            return math.inf if shares else 0.0
        return epsilon(self.noise_multiplier / math.sqrt(sum(1 / s for s in shares)), 1, 1.0, self.delta)


@lru_cache(maxsize=256)
def epsilon(noise_multiplier: float, rounds: int, share: float = 1.0, delta: float = 1e-5) -> float:
    """Epsilon of `rounds` Gaussian sums of sensitivity S and noise z S at `delta`.

    With everyone in every round the rounds are one Gaussian mechanism of z / sqrt(rounds), whose epsilon is exact. With
    share < 1 every client takes part by a coin of its own that nobody sees (Poisson sampling, of a sum that is divided
    by the expected number of clients), by composed privacy loss distributions, rounded up. A choice that the server
    makes or sees earns nothing: count each client's own rounds with share 1.

    Args:
        noise_multiplier: z. rounds: T. share: probability to take part in a round. delta: of the guarantee.

    Raises:
        InputError: a number outside its range. MissingLibraryError: no dp-accounting.

    Source: Balle, Wang, ICML 2018, theorem 8; Doroshenko et al., PoPETs 2022; the library dp-accounting.

    >>> round(epsilon(4.22, 1), 3)
    0.874
    """
    _checked(rounds, share, delta)
    if noise_multiplier <= 0:
        return math.inf
    if share == 1:
        return float(_library().get_epsilon_gaussian(noise_multiplier / math.sqrt(rounds), delta))
    accountant = _accountant()
    accountant.compose(_event(noise_multiplier, rounds, share))
    return float(accountant.get_epsilon(delta))


@lru_cache(maxsize=256)
def noise_for(wanted: float, rounds: int, share: float = 1.0, delta: float = 1e-5) -> float:
    """The least noise multiplier z whose `epsilon` is at most `wanted` (to 1e-4 with share < 1); 0 for infinity.

    >>> round(epsilon(noise_for(3.0, 20), 20), 6)
    3.0
    """
    _checked(rounds, share, delta)
    if not wanted > 0:
        raise InputError("epsilon", wanted, "must be > 0", "Use math.inf for no noise.")
    if wanted == math.inf:
        return 0.0
    if share == 1:
        return float(_library().get_sigma_gaussian(wanted, delta)) * math.sqrt(rounds)
    found = _library().calibrate_dp_mechanism(_accountant, lambda z: _event(z, rounds, share), wanted, delta, tol=1e-4)
    return float(found)


def ceiling(noise_multiplier: float, rounds: int) -> float:
    """Area under the ROC curve that no attack on a client's presence can beat: Phi(mu / sqrt 2), mu = sqrt(rounds) / z.

    Source: Dong, Roth, Su, Gaussian differential privacy, JRSS B 84, 2022, section 2 (mu and the trade-off curve).

    >>> round(ceiling(noise_for(1.0, 20), 20), 3)
    0.575
    """
    _checked(rounds, 1.0, 0.5)
    return 0.5 * (1.0 + math.erf(math.sqrt(rounds) / (2 * noise_multiplier))) if noise_multiplier > 0 else 1.0


def _checked(rounds: int, share: float, delta: float) -> None:
    if rounds < 1:
        raise InputError("rounds", rounds, "must be >= 1", "Give the rounds in which updates are sent.")
    if not 0 < share <= 1:
        raise InputError("share", share, "must be in (0, 1]", "1: everyone in every round.")
    if not 0 < delta < 1:
        raise InputError("delta", delta, "must be in (0, 1)", "1e-5 is far below one over the clients.")


def _library() -> ModuleType:
    try:
        import dp_accounting
    except ModuleNotFoundError:
        raise MissingLibraryError("dp-accounting", "the (epsilon, delta) of a training", "'coopoc[privacy]'") from None
    library: ModuleType = dp_accounting
    return library


def _accountant() -> Any:
    _library()
    from dp_accounting.pld import PLDAccountant

    return PLDAccountant(value_discretization_interval=1e-3)


def _event(noise_multiplier: float, rounds: int, share: float) -> Any:
    dp = _library()
    once = dp.PoissonSampledDpEvent(share, dp.GaussianDpEvent(noise_multiplier))
    return dp.SelfComposedDpEvent(once, rounds)
