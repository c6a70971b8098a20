"""Membership inference: scores from shared weights of which trajectories a client has trained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch
from torch import Tensor

from coopoc.arrays import Floats
from coopoc.errors import InputError
from coopoc.world.sensors import stream

from ..nets.gain import Gain
from ..training.clients import Batch, Segments
from ..training.machine import one_core
from ..training.schedule import generator

Updates = Sequence[tuple[Tensor, Tensor]]
"""Weights (P,) before and after each observed training: a client's, or the aggregate's, of some rounds."""
MIRRORS = tuple(product((False, True), (1.0, -1.0), (1.0, -1.0), (1.0, -1.0)))
"""Exchange of x and y, and the signs of the axes: the augmentations of training."""
NUMBERS = 10_000_000
"""Weights in memory at once while gradients are taken piece by piece."""
FALSE_POSITIVES = 0.01
"""False positive rate at which the true positive rate is given."""


@dataclass(frozen=True)
class AttackResult:
    """Separation of members from others by scores.

    Args:
        auc: area under the ROC curve; 0.5 is chance.
        low: lower end of its interval.
        high: upper end of its interval.
        found: true positive rate at a false positive rate of 1 %; coarse with fewer than a hundred others.
        members: their number.
        others: their number.
    """

    auc: float
    low: float
    high: float
    found: float
    members: int
    others: int

    def __str__(self) -> str:
        return f"{self.auc:.2f} [{self.low:.2f}, {self.high:.2f}]"


def membership_inference(
    members: Floats, others: Floats, level: float = 0.95, resamples: int = 1000, seed: int = 0
) -> AttackResult:
    """P(score of a member > score of an other), ties half, with the percentile interval of a bootstrap of both sets.

    Args:
        members: (m,) finite scores of training pieces, higher for a likelier member.
        others: (n,) scores of held-out pieces.
        level: of the interval.
        resamples: of the bootstrap.
        seed: of the bootstrap.

    Raises:
        InputError: an empty set or a score that is not finite.

    References:
        Hanley, McNeil, Radiology 143, 1982 (AUC as this probability); Carlini et al., S&P 2022 (rate at 1 %).

    >>> str(membership_inference(np.array([2.0, 3.0]), np.array([0.0, 1.0])))
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
    above = np.sort(others)[::-1][int(FALSE_POSITIVES * len(others))]
    return AttackResult(auc, min(low, auc), max(high, auc), float((members > above).mean()), *wins.shape)


def loss_scores(model: Gain, updates: Updates, pieces: Segments) -> Floats:
    """(n,) mean over the updates of log loss(before) - log loss(after) of each piece.

    The difference corrects for pieces whose loss is low before training.

    Args:
        model: shape of the weights.
        updates: weights before and after.
        pieces: n candidates.

    References:
        Yeom et al., CSF 2018 (the loss as a score); Watson et al., ICLR 2022 (the difference).
    """
    before, after = (torch.stack(weights) for weights in zip(*updates, strict=True))
    everyone = torch.arange(len(pieces)).expand(2 * len(before), -1)
    with torch.no_grad():
        losses = model.losses(torch.cat([before, after]), _batch(pieces, everyone)).double().log()
    return _means(losses[: len(before)] - losses[len(before) :])


@one_core()
def gradient_scores(model: Gain, updates: Updates, pieces: Segments, mirrors: bool = True) -> Floats:
    """(n,) cosine between each piece's descent direction at the weights before and the update, mean over the updates.

    -g_i . (after - before) / (|g_i| |after - before|), with g_i the gradient of the piece: an update is nearly a sum of
    such gradients.

    Args:
        model: shape of the weights.
        updates: weights before and after.
        pieces: n candidates.
        mirrors: average g_i over the 16 mirrored forms of a piece, for training that mirrors at random.

    References:
        Li, Li, Ribeiro, Effective passive membership inference attacks in federated learning, ICLR 2023.
    """
    forms = MIRRORS if mirrors else MIRRORS[:1]
    many = max(1, NUMBERS // (len(pieces) * len(updates[0][0])))
    scores = []
    for at in range(0, len(updates), many):
        before, after = (torch.stack(weights) for weights in zip(*updates[at : at + many], strict=True))
        theta = before.repeat_interleave(len(pieces), 0)
        batch = _batch(pieces, torch.arange(len(pieces)).repeat(len(before))[:, None])
        gradient = torch.stack([model.loss_and_gradient(theta, _rotated(batch, form))[1] for form in forms]).mean(0)
        step = (after - before).double().repeat_interleave(len(pieces), 0)
        scores.append(torch.cosine_similarity(-gradient.double(), step).view(len(before), -1))
    return _means(torch.cat(scores))


def renoised(pieces: Segments, seed: int = 0) -> Segments:
    """The same drives with new noise: the candidates of an attacker that knows the path but not the measurements."""
    shape = (2, *pieces.truth.shape)
    normals = torch.randn(shape, generator=generator(stream(seed, "probe", 0, "")))
    gnss = pieces.truth + pieces.gnss_std * normals[0]
    velocity = pieces.true_velocity + pieces.velocity_std * normals[1]
    return replace(pieces, gnss=gnss, velocity=velocity, noise="static")


def _batch(pieces: Segments, index: Tensor) -> Batch:
    return replace(pieces, noise="static").batch(index)


def _rotated(batch: Batch, form: tuple[bool, float, float, float]) -> Batch:
    """The batch with x and y exchanged, if so, and its axes signed."""
    order, signs = [1, 0, 2] if form[0] else [0, 1, 2], torch.tensor(form[1:])
    gnss, velocity, truth, x0 = (array[..., order] * signs for array in batch[:4])
    return batch._replace(gnss=gnss, velocity=velocity, truth=truth, x0=x0)


def _means(scores: Tensor) -> Floats:
    """Mean over rows, with 0 for scores that are not finite: diverged weights carry no information."""
    found: Floats = scores.nan_to_num(0.0, 0.0, 0.0).mean(0).numpy()
    return found
