"""Paired intervals: bootstrap over egos, then runs; training seeds apart."""

from dataclasses import dataclass
from functools import lru_cache
from math import hypot, isfinite, nan

import numpy as np

from ..arrays import AnyArray, Floats, checked, refuse
from ..errors import InputError

RESAMPLES = 2000
"""Of the bootstrap."""
LEAST_BOOTSTRAP = 5
"""Egos, or runs of one, from which a bootstrap is wide enough."""
WORSE_RATIO = 1.1
"""Ratio of mean errors from which the first is called worse."""
_CHUNK = 4_000_000


@dataclass(frozen=True)
class Interval:
    """A mean with its interval; `n` are the values it stands on, `lost` those that it lacks.

    >>> print(Interval(1.423, 1.391, 1.46, 100))
    1.42 [1.39, 1.46]
    >>> print(Interval(1.423, nan, nan, 1))
    1.42
    """

    mean: float
    low: float
    high: float
    n: int
    lost: int = 0

    def __str__(self) -> str:
        return f"{self.mean:.3g}" + (f" [{self.low:.3g}, {self.high:.3g}]" if isfinite(self.low) else "")


def mean_interval(values: AnyArray) -> Interval:
    """Mean over E egos and R runs with the 95 % interval of a bootstrap over egos, then over the runs of each.

    The percentiles are widened to Phi(sqrt(n/(n-1)) t_{n-1}), n = E (or R for one ego): the plain percentile interval
    is too narrow for few egos (Hesterberg, The American Statistician 69, 2015, section 4.3.2).
    They hold the mean of values by normal or gamma laws in 92 to 100 % of trials.
    Below LEAST_BOOTSTRAP no resample goes beyond the values: there Student's t of the n means counts where it is wider.
    Where runs differ by more than chance (F test, 5 %), as if egos shared errors, Student's t of their means is added.

    Args:
        values: (R, E) or (R,) of one metric, runs first, as `rt_le` and `nees` give them.

    Raises:
        InputError: a value that is not finite, another shape, or no value.

    >>> mean_interval(np.ones((3, 5)))
    Interval(mean=1.0, low=1.0, high=1.0, n=15, lost=0)
    >>> print(mean_interval(np.array([1.0, 2.0])))  # 1.5 +- 12.7 / 2
    1.5 [-4.85, 7.85]
    """
    values = _checked("values", values)
    mean, (egos, runs) = float(values.mean()), values.shape
    n = egos if egos > 1 else runs
    if n < 2:
        return Interval(mean, nan, nan, values.size)
    from scipy import special  # a fifth of a second, which a mistake on the command line need not wait for

    counts, step = _counts(egos, runs), max(1, _CHUNK // values.size)
    means = [counts[k : k + step].astype(float) @ values.ravel() / values.size for k in range(0, RESAMPLES, step)]
    share = special.ndtr((n / (n - 1)) ** 0.5 * special.stdtrit(n - 1, 0.025))
    low, high = np.quantile(np.hstack(means), [share, 1 - share])
    if n < LEAST_BOOTSTRAP:
        wide = over_seeds(values if egos > 1 else values[0])
        low, high = min(low, wide.low), max(high, wide.high)
    shared = values.mean(0) - mean
    own = hypot(*(values - values.mean(1)[:, None] - shared).flat)
    chance = special.fdtri(runs - 1, (egos - 1) * (runs - 1), 0.95)  # NaN of one ego or run
    if hypot(*shared) > own * (chance / (egos * (egos - 1))) ** 0.5:
        half = over_seeds(values.T).high - mean
        low, high = mean - hypot(mean - low, half), mean + hypot(high - mean, half)
    return Interval(mean, float(low), float(high), values.size)


def paired_difference(a: AnyArray, b: AnyArray) -> Interval:
    """Mean of a - b on the same egos and runs, with its interval: common noise cancels.

    Args:
        a: (R, E) or (R,) of one metric, runs first, the same draws in the same places.
        b: as `a`.

    Raises:
        InputError: shapes that differ, or as in `mean_interval`.

    >>> paired_difference(np.array([2.0, 3.0]), np.array([1.0, 2.0])).high
    1.0
    """
    first, second = _checked("a", a), _checked("b", b)
    if first.shape != second.shape:
        raise InputError("b", np.shape(b), f"must have the shape of a, {np.shape(a)}", "Pair the same runs and egos.")
    return mean_interval((first - second).T)


def over_seeds(values: AnyArray) -> Interval:
    """Mean over training seeds with its 95 % interval, apart from noise: of S means mean +- t_{S-1} s / sqrt(S).

    Args:
        values: (S, R, E) or (S, R) or (S,) of one metric, seeds first.

    Raises:
        InputError: fewer than two seeds, or a value that is not finite.

    >>> print(over_seeds(np.array([1.0, 1.2, 1.1])))
    1.1 [0.852, 1.35]
    """
    from scipy import special

    values = checked("values", values)
    if not values.ndim or len(values) < 2 or not np.isfinite(values).all():
        raise InputError("values", values.shape, "need at least two seeds of finite values", "Train more seeds.")
    means = values.reshape(len(values), -1).mean(1)
    mean = float(means.mean())
    n = len(means)
    half = special.stdtrit(n - 1, 0.975) * hypot(*(means - mean)) / (n * (n - 1)) ** 0.5
    return Interval(mean, mean - half, mean + half, n)


@lru_cache(maxsize=2)
def _counts(egos: int, runs: int) -> AnyArray:
    """(RESAMPLES, egos x runs) how often each value is drawn: egos, then the runs of each; the same draws for any
    values of one shape, so pairs stay pairs."""
    size, rng = egos * runs, np.random.default_rng(0)
    counts = np.empty((RESAMPLES, size), np.uint16)
    step = max(1, _CHUNK // size)
    for start in range(0, RESAMPLES, step):
        count = min(step, RESAMPLES - start)
        ego = rng.integers(egos, size=(count, egos, 1))
        run = rng.integers(runs, size=(count, egos, runs))
        index = (np.arange(count)[:, None, None] * egos + ego) * runs + run
        counts[start : start + count] = np.bincount(index.ravel(), minlength=count * size).reshape(count, size)
    return counts


def _checked(name: str, values: AnyArray) -> Floats:
    """(E, R), egos first."""
    array = np.atleast_2d(checked(name, values).T)
    if array.ndim != 2 or not array.size:
        raise InputError(name, array.T.shape, "must have shape (R, E) or (R,)", "Runs first, then egos.")
    refuse(name, array.T, ~np.isfinite(array.T), "must be finite", "Leave out failed cells before you average.")
    return array
