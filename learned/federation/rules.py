"""Aggregation rules: mean, median, trimmed mean and Krum; the server's half of a round, which screens the clients'
answers and aggregates them by a rule.
"""

import math
import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from coopoc.arrays import check_fields, instance
from coopoc.errors import InputError, shown
from coopoc.plugins import find

Combine = Callable[[Tensor, Tensor], Tensor]
"""New weights (P,) from the clients' weights (C, P) and numbers of training pieces (C,)."""


class Rule:
    """theta <- rule(theta, weights, sizes), which remembers nothing: servers with memory are Flower's.

    A rule that needs the clients' weights alone overrides `combine`, one that needs their changes `__call__`.
    """

    @property
    def name(self) -> str:
        """Name in messages."""
        return repr(self)

    @property
    def least(self) -> int:
        """Smallest number of clients that it can combine."""
        return 1

    def tolerated(self, clients: int) -> int:
        """Number of Byzantine clients among so many that cannot move the result as far as they like (the breakdown
        point); 0 unless a rule knows better."""
        return 0

    def combine(self, weights: Tensor, sizes: Tensor) -> Tensor:
        """New weights (P,) from those of the clients (C, P) and their pieces (C,)."""
        raise NotImplementedError(f"{type(self).__name__} defines neither combine nor __call__")

    def __call__(self, theta: Tensor, weights: Tensor, sizes: Tensor) -> Tensor:
        """New weights (P,); theta (P,) is what the clients received."""
        return self.combine(weights, sizes)


@dataclass(frozen=True)
class Function(Rule):
    """A plain function (weights, sizes) -> (P,) as a rule."""

    function: Combine

    @property
    def name(self) -> str:
        """Name of the function."""
        return getattr(self.function, "__name__", repr(self.function))

    def tolerated(self, clients: int) -> int:
        """Any minority for the median."""
        return (clients - 1) // 2 if self.function is median else 0

    def combine(self, weights: Tensor, sizes: Tensor) -> Tensor:
        """The value of the function."""
        return self.function(weights, sizes)


def mean(weights: Tensor, sizes: Tensor) -> Tensor:
    """FedAvg: sum_i a_i theta_i with a_i = n_i / sum n, of weights (C, P) and pieces (C,).

    References:
        McMahan et al., AISTATS 2017, algorithm 1; arXiv 2411.05847, equation 8.

    >>> mean(torch.tensor([[1.0], [3.0]]), torch.tensor([3.0, 1.0])).tolist()
    [1.5]
    """
    return ((sizes.double() / sizes.double().sum()).to(weights.dtype)[:, None] * weights).sum(0)


def median(weights: Tensor, sizes: Tensor | None = None) -> Tensor:
    """Median of each weight over the clients (C, P), the mean of the middle two where C is even; sizes are not read.

    References:
        Yin et al., ICML 2018, algorithm 1, option I.

    >>> median(torch.tensor([[1.0], [2.0], [90.0]])).tolist()
    [2.0]
    """
    ordered, count = weights.sort(0).values, len(weights)
    return (ordered[(count - 1) // 2] + ordered[count // 2]) / 2


@dataclass(frozen=True)
class TrimmedMean(Rule):
    """Mean of each weight over the clients without its int(share C) least and greatest values.

    Args:
        share: of the clients, left out at either end.

    References:
        Yin et al., ICML 2018, algorithm 1, option II.

    >>> TrimmedMean(0.25).combine(torch.tensor([[1.0], [2.0], [4.0], [90.0]]), torch.ones(4)).tolist()
    [3.0]
    """

    share: float = 0.25

    def __post_init__(self) -> None:
        check_fields(self, {"share": (0, math.nextafter(0.5, 0), "in [0, 0.5)")})

    @property
    def least(self) -> int:
        """The first number of clients of which one is left out at either end."""
        return math.ceil(1 / self.share) if self.share else 1

    def tolerated(self, clients: int) -> int:
        """As many as are left out at either end."""
        return int(self.share * clients)

    def combine(self, weights: Tensor, sizes: Tensor) -> Tensor:
        """Unweighted."""
        cut = self.tolerated(len(weights))
        return weights.sort(0).values[cut : len(weights) - cut].mean(0)


@dataclass(frozen=True)
class Krum(Rule):
    """Mean of the m clients with the lowest scores: Krum with m = 1, multi-Krum with more.

    A score is the sum of the squared distances of a client to its C - f - 2 nearest others, in float64.

    Args:
        byzantine: f, number of Byzantine clients that is tolerated; needs C > 2 f + 2.
        keep: m; None for C - f, as in the paper's experiments.

    References:
        Blanchard et al., NeurIPS 2017, sections 4 and 5.

    >>> Krum(byzantine=2).least
    7
    """

    byzantine: int = 1
    keep: int | None = 1

    def __post_init__(self) -> None:
        check_fields(self, {"byzantine": (0, 1e9, ">= 0"), "keep": (1, 1e9, ">= 1 or None")})

    @property
    def least(self) -> int:
        """2 f + 3, or m if that is more."""
        return max(2 * self.byzantine + 3, self.keep or 0)

    def tolerated(self, clients: int) -> int:
        """f."""
        return self.byzantine if clients >= self.least else 0

    def combine(self, weights: Tensor, sizes: Tensor) -> Tensor:
        """Plain mean of the clients with the lowest scores; the first of equals.

        >>> Krum().combine(torch.tensor([[0.0], [1.0], [2.0], [3.0], [90.0]]), torch.ones(5)).tolist()
        [1.0]
        """
        exact, near = weights.double(), len(weights) - self.byzantine - 2
        square = torch.stack([(exact - one).square().sum(1) for one in exact])
        scores = square.fill_diagonal_(torch.inf).sort(1).values[:, :near].sum(1)
        return weights[scores.argsort(stable=True)[: self.keep or len(weights) - self.byzantine].sort().values].mean(0)


RULES = {
    "mean": Function(mean),
    "median": Function(median),
    "trimmed_mean": TrimmedMean(),
    "krum": Krum(),
    "multi_krum": Krum(keep=None),
}
"""Bundled rules with their default parameters; others come from entry points in `coopoc.rules` or from files."""


def rule(name_or_rule: str | Rule | Combine) -> Rule:
    """The rule of a name or of a path "mine.py:NAME"; a `Rule`, a class of rules or a plain function as a rule.

    Raises:
        InputError: an unknown name (lists the rules and the nearest one), or an object that is no rule.

    >>> rule("krum").least
    5
    """
    chosen = (
        (RULES.get(name_or_rule) or find("coopoc.rules", name_or_rule))
        if isinstance(name_or_rule, str)
        else name_or_rule
    )
    made = chosen() if isinstance(chosen, type) else chosen
    if isinstance(made, Rule):
        return made
    if callable(made):
        return Function(made)
    hint = "Give a function of (weights, sizes), or a Rule."
    raise InputError("aggregate", shown(name_or_rule), f"is a {type(made).__name__}, no aggregation rule", hint)


SERVER = "server"
"""The server's name in the traffic of a round."""
FLOAT32 = 4
"""Bytes of a float32."""
LONGEST_UPDATE = 100.0
"""Longest accepted update, in multiples of the usual one."""

LARGEST_LOSS = 1e12
"""m^2, the largest plausible loss: an error of 1,000 km."""


def implausible(name: str, loss: float) -> str:
    """Why a client's loss of this name is rejected, "" if it is not; that of a likelihood may be negative."""
    limits = f"must be in [-{LARGEST_LOSS:g}, {LARGEST_LOSS:g}]"
    return "" if abs(loss) <= LARGEST_LOSS else f"a {name} of {loss:g} m^2, {limits}"


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
    if len(far) >= 3 and statistics.median(far.values()) > 0:
        most = LONGEST_UPDATE * statistics.median(far.values())
    elif usual:
        most = LONGEST_UPDATE * usual
    else:
        most = max(float(torch.linalg.vector_norm(theta)), 1.0)
    for name, length in far.items():
        if length > most:
            reasons[name] = f"changes the weights by {length:.3g}, at most {most:.3g} is accepted"
    accepted = [length for name, length in far.items() if name not in reasons]
    return reasons, statistics.median(accepted) if accepted else usual


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
