"""Aggregation rules by name, as the command line, recipes and studies say them."""

from __future__ import annotations

from collections.abc import Mapping

from coopoc.errors import InputError

from .means import FedProx, Stateless, inverse_variance, mean, uniform
from .robust import median
from .robust_rules import GeometricMedian, Krum, MultiKrum, TrimmedMean
from .rule import Combine, Rule
from .server_rules import FedAdam, FedAvgM

RULES: Mapping[str, Rule] = {
    "mean": Stateless(mean), "uniform": Stateless(uniform), "fedprox": FedProx(), "fedavgm": FedAvgM(),
    "fedadam": FedAdam(), "median": Stateless(median), "trimmed_mean": TrimmedMean(), "krum": Krum(),
    "multi_krum": MultiKrum(), "geometric_median": GeometricMedian(), "uncertainty": Stateless(inverse_variance),
}  # fmt: skip
"""Rules with their default parameters, by the names of the command line and recipes."""


def rule(name: str | Rule | Combine) -> Rule:
    """The rule of that name, the rule itself, or a plain function as a rule; InputError if there is none.

    >>> rule("krum").least
    5
    """
    if isinstance(name, Rule):
        return name
    if callable(name):
        return Stateless(name)
    if name not in RULES:
        raise InputError("aggregate", repr(name), f"must be one of {sorted(RULES)}, a Rule or a function", "Pick one.")
    return RULES[name]
