"""Differential privacy: clipped and noised updates, and their (epsilon, delta)."""

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

from coopoc.arrays import number
from coopoc.errors import InputError, MissingLibraryError
from coopoc.methods.options import check_options
from coopoc.world.sensors import stream

from ..federation.aggregate import rule
from ..federation.rule import Combine, Rule, within
from .masks import secure_normal


@dataclass(frozen=True)
class Privacy:
    """Clients' updates clipped to an L2 norm and noised: u_i <- u_i min(1, S / ||u_i||) + N(0, (z S)^2 / C).

    The sum of C such updates carries noise of standard deviation z S, and no client's data moves it by more than S:
    one Gaussian mechanism per round. Neighbouring data sets differ in one client, whose update is replaced by zero
    (client level, "zero-out"); if it is replaced by another client's, the sensitivity is 2 S and z halves. The
    guarantee is for observers of sums. An observer of single updates, such as a server without secure aggregation,
    faces z / sqrt(C). The noise of clients that drop out is missing: see `spent`.

    Args:
        clip: S, in units of the weights.
        noise_multiplier: z; 0 clips only.
        delta: far below one over the number of clients.
        clients: C whose noise adds up to z S; None: all that train in the round. With the smallest expected number of
            arrivals, less colluding clients, the guarantee survives drop-outs.
        keyed: True: noise keyed by seed, round and name, for reproducible simulation only, as it can be recomputed and
            subtracted; epsilon then holds for observers without the seed. False: noise from a cryptographic generator
            with a fresh key of the operating system, which deployments require.

    Raises:
        InputError: clip, noise, delta or clients outside their range.

    References:
        McMahan et al., ICLR 2018 (client level); Kairouz, Liu, Steinke, ICML 2021 (distributed noise); arXiv
        2103.00039, definition 1.1 (zero-out).

    >>> Privacy(1.0, 0.0).protect(torch.tensor([[3.0, 4.0]]), ["a"], 0, 1).norm().item()
    1.0
    """

    clip: float
    noise_multiplier: float
    delta: float = 1e-5
    clients: int | None = None
    keyed: bool = True

    def __post_init__(self) -> None:
        check_options(self)
        clip = number("clip", self.clip)
        within("clip", self.clip, 0 < clip < math.inf, "> 0 and finite", "Try the median norm of an update.")
        finite = 0 <= number("noise_multiplier", self.noise_multiplier) < math.inf
        within("noise_multiplier", self.noise_multiplier, finite, ">= 0 and finite", "0 clips only.")
        within("delta", self.delta, 0 < number("delta", self.delta) < 1, "in (0, 1)", "1e-5 is far below 1 / clients.")
        if self.clients is not None:
            hint = "Give those whose noise adds up, or None."
            number("clients", self.clients, 1, 2**31, kind=int, allowed=">= 1", hint=hint)

    def protect(self, updates: Tensor, names: Sequence[str], seed: int, number: int) -> Tensor:
        """Updates (C, P) of the named clients in round `number` as they leave: clipped, plus noise of each client."""
        norms = torch.linalg.vector_norm(updates, dim=1, keepdim=True)
        shrunk = updates * torch.clamp(self.clip / norms, max=1.0)
        std = self.noise_multiplier * self.clip / math.sqrt(self.clients or len(updates))
        size = updates.shape[1]
        noise = std * np.stack(
            [
                stream(seed, "privacy", number, name).standard_normal(size) if self.keyed else secure_normal(size)
                for name in names
            ]
        )
        return shrunk + torch.from_numpy(noise).to(updates.dtype)

    def check(self, aggregate: str | Rule | Combine) -> None:
        """InputError for a rule other than a function of the uniform mean, for which alone epsilon is computed.

        Post-processing of that mean is free: `SecureAggregation("fedavgm", equal=True)`.
        """
        if rule(aggregate).mean_by != "uniform":
            allowed = 'must be "uniform" or SecureAggregation(..., equal=True) with privacy'
            hint = "Other weights change the sensitivity of the sum to one client."
            raise InputError("aggregate", repr(aggregate), allowed, hint)

    def epsilon(self, rounds: int, share: float = 1.0) -> float:
        """`epsilon` of so many rounds with this noise and delta."""
        return epsilon(self.noise_multiplier, rounds, share, self.delta)

    def spent(self, arrived: Sequence[int], asked: Sequence[int] | None = None) -> float:
        """Epsilon of rounds whose sums contain `arrived` updates: n of them carry noise of z S sqrt(n / C) only.

        Args:
            arrived: n of each round.
            asked: C of each round where `clients` is None; default the largest n.

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

    With full participation the rounds are one Gaussian mechanism of z / sqrt(rounds), whose epsilon is exact. With
    share < 1 every client takes part by a secret coin of its own (Poisson sampling, of a sum that is divided by the
    expected number of clients); privacy loss distributions are composed and rounded up. Sampling by the server does not
    amplify privacy: count each client's own rounds with share 1.

    Args:
        noise_multiplier: z.
        rounds: T.
        share: probability to take part in a round.
        delta: of the guarantee.

    Raises:
        InputError: a number outside its range.
        MissingLibraryError: no dp-accounting.

    References:
        Balle, Wang, ICML 2018, theorem 8; Doroshenko et al., PoPETs 2022.

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
    within("epsilon", wanted, wanted > 0, "> 0", "Use math.inf for no noise.")
    if wanted == math.inf:
        return 0.0
    if share == 1:
        return float(_library().get_sigma_gaussian(wanted, delta)) * math.sqrt(rounds)
    found = _library().calibrate_dp_mechanism(_accountant, lambda z: _event(z, rounds, share), wanted, delta, tol=1e-4)
    return float(found)


def auc_bound(noise_multiplier: float, rounds: int) -> float:
    """Largest area under the ROC curve of any attack on a client's presence: Phi(mu / sqrt 2), mu = sqrt(rounds) / z.

    References:
        Dong, Roth, Su, Gaussian differential privacy, JRSS B 84, 2022, section 2.

    >>> round(auc_bound(noise_for(1.0, 20), 20), 3)
    0.575
    """
    _checked(rounds, 1.0, 0.5)
    return 0.5 * (1.0 + math.erf(math.sqrt(rounds) / (2 * noise_multiplier))) if noise_multiplier > 0 else 1.0


def _checked(rounds: int, share: float, delta: float) -> None:
    within("rounds", rounds, rounds >= 1, ">= 1", "Give the rounds in which updates are sent.")
    within("share", share, 0 < share <= 1, "in (0, 1]", "1: all clients in every round.")
    within("delta", delta, 0 < delta < 1, "in (0, 1)", "1e-5 is far below one over the clients.")


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
