"""Probe: can whoever sees shared weights tell which trajectories a client has trained on?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch
from torch import Tensor

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.world.noise import stream

from ..nets.gain import Gain
from ..training.clients import Batch, Pieces
from ..training.machine import one_core
from ..training.schedule import generator

Seen = Sequence[tuple[Tensor, Tensor]]
"""Weights (P,) before and after each training that was observed: a client's, or the aggregate's, of some rounds."""
MIRRORS = tuple(product((False, True), (1.0, -1.0), (1.0, -1.0), (1.0, -1.0)))
"""Exchange of x and y, and the signs of the axes: every way in which training may show a piece."""
NUMBERS = 10_000_000
"""Weights that are held at once where every piece has a gradient of its own."""
FALSE_ALARMS = 0.01
"""Share of the non-members that may be taken for members where the rate of found members is given."""


@dataclass(frozen=True)
class Verdict:
    """How well scores tell members from others: area under the ROC curve with its interval, 0.5 being a coin.

    `found` is the share of members above all but 1 % of the others. Fewer than a hundred others make it coarse.
    """

    auc: float
    low: float
    high: float
    found: float
    members: int
    others: int

    def __str__(self) -> str:
        return f"{self.auc:.2f} [{self.low:.2f}, {self.high:.2f}]"


def verdict(members: Floats, others: Floats, level: float = 0.95, resamples: int = 1000, seed: int = 0) -> Verdict:
    """P(score of a member > score of an other), ties half, with the percentile interval of a bootstrap of both sets.

    Args:
        members, others: (m,), (n,) scores, finite, higher for a likelier member. level: of the interval.

    Raises:
        InputError: an empty set or a score that is not finite.

    Source: Hanley, McNeil, Radiology 143, 1982 (AUC as this probability); Carlini et al., S&P 2022 (rate at 1 %).

    >>> str(verdict(np.array([2.0, 3.0]), np.array([0.0, 1.0])))
    '1.00 [1.00, 1.00]'
    """
    for name, scores in (("members", members), ("others", others)):
        if not len(scores) or not np.isfinite(scores).all():
            raise InputError(name, scores, "must be finite scores, at least one", "Leave out weights that diverged.")
    wins = 0.5 * (np.sign(members[:, None] - others) + 1.0)
    draw = stream(seed, "bootstrap", 0, "probe")
    rows, columns = (draw.multinomial(n, np.full(n, 1 / n), resamples) / n for n in wins.shape)
    auc = float(wins.mean())
    low, high = np.quantile(((rows @ wins) * columns).sum(1), (0.5 - level / 2, 0.5 + level / 2)).tolist()
    above = np.sort(others)[::-1][int(FALSE_ALARMS * len(others))]
    return Verdict(auc, min(low, auc), max(high, auc), float((members > above).mean()), *wins.shape)


def loss_scores(model: Gain, seen: Seen, pieces: Pieces) -> Floats:
    """(n,) mean over what was seen of log loss(before) - log loss(after) of each piece.

    What was easy before training is no sign of membership, hence the difference.

    Args:
        model: shape of the weights. seen: weights before and after. pieces: the candidates.

    Source: Yeom et al., CSF 2018 (the loss as a score); Watson et al., ICLR 2022 (the difference).
    """

    before, after = (torch.stack(weights) for weights in zip(*seen, strict=True))
    everyone = torch.arange(len(pieces)).expand(2 * len(before), -1)
    with torch.no_grad():
        losses = model.losses(torch.cat([before, after]), _batch(pieces, everyone)).double().log()
    return _means(losses[: len(before)] - losses[len(before) :])


@one_core()
def gradient_scores(model: Gain, seen: Seen, pieces: Pieces, mirrors: bool = True) -> Floats:
    """(n,) cosine between each piece's descent direction at the weights before and the step, mean of what was seen.

    -g_i . (after - before) / (|g_i| |after - before|), with g_i the gradient of the piece, averaged over its 16
    mirrored forms where training mirrors at random: an update is nearly a sum of such gradients.

    Source: Li, Li, Ribeiro, Effective passive membership inference attacks in federated learning, ICLR 2023.
    """
    forms = MIRRORS if mirrors else MIRRORS[:1]
    many = max(1, NUMBERS // (len(pieces) * len(seen[0][0])))
    scores = []
    for at in range(0, len(seen), many):
        before, after = (torch.stack(weights) for weights in zip(*seen[at : at + many], strict=True))
        theta = before.repeat_interleave(len(pieces), 0)
        batch = _batch(pieces, torch.arange(len(pieces)).repeat(len(before))[:, None])
        gradient = torch.stack([model.loss_and_gradient(theta, _turned(batch, form))[1] for form in forms]).mean(0)
        step = (after - before).double().repeat_interleave(len(pieces), 0)
        scores.append(torch.cosine_similarity(-gradient.double(), step).view(len(before), -1))
    return _means(torch.cat(scores))


def renoised(pieces: Pieces, seed: int = 0) -> Pieces:
    """The same drives with new noise: what someone holds who knows the path but not what its sensors read."""
    shape = (2, *pieces.truth.shape)
    normals = torch.randn(shape, generator=generator(stream(seed, "probe", 0, "")))
    gnss = pieces.truth + pieces.gnss_std * normals[0]
    velocity = pieces.true_velocity + pieces.velocity_std * normals[1]
    return replace(pieces, gnss=gnss, velocity=velocity, noise="static")


def _batch(pieces: Pieces, index: Tensor) -> Batch:
    return replace(pieces, noise="static").batch(index)


def _turned(batch: Batch, form: tuple[bool, float, float, float]) -> Batch:
    """The batch with x and y exchanged, if so, and its axes signed."""
    order, signs = [1, 0, 2] if form[0] else [0, 1, 2], torch.tensor(form[1:])
    gnss, velocity, truth, x0 = (array[..., order] * signs for array in batch[:4])
    return batch._replace(gnss=gnss, velocity=velocity, truth=truth, x0=x0)


def _means(scores: Tensor) -> Floats:
    """Mean over rows, 0 in the place of what is not finite: weights that diverged say nothing."""
    found: Floats = scores.nan_to_num(0.0, 0.0, 0.0).mean(0).numpy()
    return found
