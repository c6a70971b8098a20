"""Guard: answers that the server does not let near the weights, each with a reason."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import median

import torch
from torch import Tensor

LIMIT = 100.0
"""Times the usual update that an update may be long."""


def screen(
    theta: Tensor, answers: Mapping[str, Tensor], usual: float | None = None, limit: float = LIMIT
) -> tuple[dict[str, str], float | None]:
    """Why answers are rejected: another shape, weights that are not finite, or a change that is far too large.

    With d_i = ||theta_i - theta||, client i is rejected if d_i > limit median_j d_j over the answers of the round. Two
    answers or one have no median that a liar could not make (nor have those that mostly changed nothing): then the
    median of the round before is taken, and in the first round no change may be longer than max(||theta||, 1).

    Args:
        theta: (P,) weights that the clients received. answers: what each sent. usual: median d of the round before.

    Returns:
        Reasons by name, and the median d of what is left (that of the round before if nothing is).

    >>> two = {"a": torch.tensor([1.1, 1.0]), "b": torch.tensor([1.0, 200.0])}
    >>> screen(torch.ones(2), two)[0]
    {'b': 'changes the weights by 199, at most 1.41 is let in'}
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
            reasons[name] = f"changes the weights by {length:.3g}, at most {most:.3g} is let in"
    kept = [length for name, length in far.items() if name not in reasons]
    return reasons, median(kept) if kept else usual
