"""Aggregation rules by name, path or object."""

from __future__ import annotations

from collections.abc import Mapping

from coopoc.errors import InputError, shown
from coopoc.plugins import find

from .means import FedProx, Function, inverse_variance, mean, uniform
from .robust import GeometricMedian, Krum, TrimmedMean, median
from .rule import Combine, Rule
from .server_rules import FedAdam, FedAvgM

RULES: Mapping[str, Rule] = {
    "mean": Function(mean),
    "uniform": Function(uniform),
    "fedprox": FedProx(),
    "fedavgm": FedAvgM(),
    "fedadam": FedAdam(),
    "median": Function(median),
    "trimmed_mean": TrimmedMean(),
    "krum": Krum(),
    "multi_krum": Krum(keep=None),
    "geometric_median": GeometricMedian(),
    "uncertainty": Function(inverse_variance),
}
"""Bundled rules with their default parameters; others come from entry points in `coopoc.rules` or from files."""


def rule(given: str | Rule | Combine) -> Rule:
    """The rule of a name or of a path "mine.py:NAME"; a `Rule`, a class of rules or a plain function as a rule.

    Raises:
        InputError: an unknown name (lists the rules and the nearest one), or an object that is no rule.

    >>> rule("krum").least
    5
    """
    found = (RULES.get(given) or find("coopoc.rules", given)) if isinstance(given, str) else given
    made = found() if isinstance(found, type) else found
    if isinstance(made, Rule):
        return made
    if callable(made):
        return Function(made)
    hint = "Give a function of (weights, sizes, uncertainty), or a Rule."
    raise InputError("aggregate", shown(given), f"is a {type(made).__name__}, no aggregation rule", hint)
