"""Guard: answers that are rejected before aggregation, each with a reason."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import median

import torch
from torch import Tensor

LIMIT = 100.0
"""Longest accepted update, in multiples of the usual one."""


def screen(
    theta: Tensor, answers: Mapping[str, Tensor], usual: float | None = None, limit: float = LIMIT
) -> tuple[dict[str, str], float | None]:
    """Reject answers of another shape, with weights that are not finite, or with a change that is far too large.

    With d_i = ||theta_i - theta||, client i is rejected if d_i > limit median_j d_j over the answers of the round. The
    median of one or two answers is in the hands of one client, and where most answers change nothing it is 0: then the
    median of the previous round takes its place, and in the first round max(||theta||, 1) is the longest change.

    Args:
        theta: (P,) weights that the clients received.
        answers: weights that each client sent, by name.
        usual: median d of the previous round, None in the first.
        limit: longest accepted update, in multiples of the usual one.

    Returns:
        Reasons by name, and the median d of the accepted answers (`usual` if there are none).

    >>> two = {"a": torch.tensor([1.1, 1.0]), "b": torch.tensor([1.0, 200.0])}
    >>> screen(torch.ones(2), two)[0]
    {'b': 'changes the weights by 199, at most 1.41 is accepted'}
    """
    reasons, far = dict[str, str](), dict[str, float]()
    for name in sorted(answers):
        sent = answers[name]
        if sent.shape != theta.shape:
            reasons[name] = f"weights of shape {tuple(sent.shape)}, the net has {tuple(theta.shape)}"
        elif not sent.isfinite().all():
            reasons[name] = f"{int((~sent.isfinite()).sum())} of {sent.numel()} weights are not finite"
        else:
            far[name] = float(torch.linalg.vector_norm(sent.double() - theta.double()))
    if len(far) >= 3 and median(far.values()) > 0:
        most = limit * median(far.values())
    elif usual:
        most = limit * usual
    else:
        most = max(float(torch.linalg.vector_norm(theta)), 1.0)
    for name, length in far.items():
        if length > most:
            reasons[name] = f"changes the weights by {length:.3g}, at most {most:.3g} is accepted"
    accepted = [length for name, length in far.items() if name not in reasons]
    return reasons, median(accepted) if accepted else usual
