"""The methods that need no training, by the names of tables, figures and the command line."""

from collections.abc import Callable, Mapping
from functools import partial

from ..plugins import find, in_file, names
from .batch_smoother import BatchSmoother
from .cooperative_filter import CooperativeFilter
from .kalman import GNSS, Kalman
from .star_filters import LKFSA, MSMV, CovarianceIntersection, JointFilter
from .track import Method

Factory = Callable[..., Method]
"""Noise model -> the method. A third party's entry point in `coopoc.methods` is one, too."""

METHODS: Mapping[str, Factory] = {
    "gnss": lambda noise_model: GNSS(),
    "kalman": Kalman,
    "lkf-sa": LKFSA,
    "lkf-sa-edge": partial(JointFilter, exact=False, robust=False, name="lkf-sa-edge"),
    "msmv-r": MSMV,
    "joint": JointFilter,
    "cooperative-filter": CooperativeFilter,
    "ci": CovarianceIntersection,
    "split-ci": partial(CovarianceIntersection, split=True, name="split-ci"),
    "batch-smoother": BatchSmoother,
}
"""Name -> a function of the noise model, and of options of the method by name."""


def needs_whole_fleet(name: str) -> bool:
    """Whether a method needs what every vehicle measured, not only the egos: it declares `whole_fleet = True`.

    >>> needs_whole_fleet("batch-smoother"), needs_whole_fleet("joint")
    (True, False)
    """
    made = METHODS.get(name) or ((in_file(name) or name in names("coopoc.methods")) and find("coopoc.methods", name))
    return bool(getattr(made, "whole_fleet", False))
