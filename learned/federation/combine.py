"""The server's half of a round: screening of the clients' answers, then their aggregation by a rule."""

from collections.abc import Mapping
from statistics import median
from typing import NamedTuple

import torch
from torch import Tensor

from coopoc import InputError
from coopoc.arrays import instance

from .rules import Rule

SERVER = "server"
"""The server's name in the traffic of a round."""
FLOAT32 = 4
"""Bytes of a float32."""
LONGEST_UPDATE = 100.0
"""Longest accepted update, in multiples of the usual one."""


class Answer(NamedTuple):
    """A client's weights (P,) after local training, and the number of its training pieces."""

    weights: Tensor
    size: int


class Standing(NamedTuple):
    """What a server carries from round to round: weights (P,), and the usual change (`screen`)."""

    theta: Tensor
    usual: float | None = None


def screen(
    theta: Tensor, answers: Mapping[str, Tensor], usual: float | None = None
) -> tuple[dict[str, str], float | None]:
    """Reject answers of another shape, with weights that are not finite, or with a change that is far too large.

    With d_i = ||theta_i - theta||, client i is rejected if d_i > LONGEST_UPDATE median_j d_j over the answers of the
    round. The median of one or two answers is in the hands of one client, and where most answers change nothing it is
    0: then the median of the previous round takes its place, and in the first round max(||theta||, 1) is the longest
    change.

    Args:
        theta: (P,) weights that the clients received.
        answers: weights that each client sent, by name.
        usual: median d of the previous round, None in the first.

    Returns:
        Reasons by name, and the median d of the accepted answers (`usual` if there are none).

    >>> two = {"a": torch.tensor([1.1, 1.0]), "b": torch.tensor([1.0, 200.0])}
    >>> screen(torch.ones(2), two)[0]
    {'b': 'changes the weights by 199, at most 1.41 is accepted'}
    """
    reasons, far = {}, {}
    for name in sorted(answers):
        sent = answers[name]
        if sent.shape != theta.shape:
            reasons[name] = f"weights of shape {tuple(sent.shape)}, the net has {tuple(theta.shape)}"
        elif not sent.isfinite().all():
            reasons[name] = f"{int((~sent.isfinite()).sum())} of {sent.numel()} weights are not finite"
        else:
            far[name] = float(torch.linalg.vector_norm(sent.double() - theta.double()))
    if len(far) >= 3 and median(far.values()) > 0:
        most = LONGEST_UPDATE * median(far.values())
    elif usual:
        most = LONGEST_UPDATE * usual
    else:
        most = max(float(torch.linalg.vector_norm(theta)), 1.0)
    for name, length in far.items():
        if length > most:
            reasons[name] = f"changes the weights by {length:.3g}, at most {most:.3g} is accepted"
    accepted = [length for name, length in far.items() if name not in reasons]
    return reasons, median(accepted) if accepted else usual


def too_few(rule: Rule, accepted: int) -> str:
    """Why a rule cannot combine so many answers, "" if it can."""
    if accepted >= rule.least:
        return ""
    return f"{accepted} answers accepted, {rule.name} takes at least {rule.least}: weights unchanged"


def combine(rule: Rule, standing: Standing, answers: Mapping[str, Answer]) -> tuple[Standing, dict[str, str], str]:
    """Screen the answers, then combine the accepted ones, in the order of the clients' names.

    Weights are unchanged if too few answers are accepted, or if the result is not finite.

    Args:
        rule: aggregation rule.
        standing: before the round.
        answers: by name, in any order.

    Returns:
        Standing after the round, reasons of rejected answers, and why the weights are unchanged, if they are.

    Raises:
        InputError: a rule whose result has another shape than theta.

    >>> from coopoc.learned.federation.rules import rule
    >>> two = {"b": Answer(torch.tensor([3.0]), 1), "a": Answer(torch.tensor([torch.nan]), 3)}
    >>> after, rejected, note = combine(rule("mean"), Standing(torch.tensor([2.0])), two)
    >>> after.theta.tolist(), rejected
    ([3.0], {'a': '1 of 1 weights are not finite'})
    """
    theta = standing.theta
    rejected, usual = screen(theta, {name: answer.weights for name, answer in answers.items()}, standing.usual)
    unchanged, accepted = standing._replace(usual=usual), [answers[name] for name in sorted(answers.keys() - rejected)]
    if not answers:
        return unchanged, rejected, "no client answered: weights unchanged"
    if note := too_few(rule, len(accepted)):
        return unchanged, rejected, note
    weights, sizes = torch.stack([a.weights for a in accepted]), torch.tensor([a.size for a in accepted])
    combined = instance("aggregate", rule(theta, weights, sizes), Tensor, "Return the new weights (P,).")
    if combined.shape != theta.shape:
        allowed = f"must have the shape {tuple(theta.shape)} of the net's weights"
        shape = f"{rule.name} -> {tuple(combined.shape)}"
        raise InputError("aggregate", shape, allowed, "Combine over the clients only.")
    if not combined.isfinite().all():
        return unchanged, rejected, f"{rule.name} gives weights that are not finite: weights unchanged"
    return Standing(combined.to(theta.dtype), usual), rejected, ""
