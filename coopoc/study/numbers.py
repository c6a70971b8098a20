"""numbers: one number of a selection of a study's rows, for tables, figures and findings; None where it was not run."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import reduce
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from ..arrays import Floats
from ..evaluate.statistics import Interval, mean_interval, over_seeds, paired_difference

if TYPE_CHECKING:
    from . import results

Results: TypeAlias = "results.Results"
"""For annotations: its module loads pandas, for which a mistake in --set need not wait."""
Where = Mapping[str, Any]
"""Column -> value, or a list of values."""
Number = Callable[[Results, Where], Any]
"""An entry of a table for a selection; None where it was not run."""


def present(results: Results, where: Where, value: str = "rt_le_m") -> dict[str, Any] | None:
    """`where` without the values for which nothing was run; None if that leaves no row with a number, or of a failed
    cell.

    Args:
        results: of the study.
        where: the selection.
        value: the metric that is wanted.
    """
    if not {*where, value} <= set(results.frame):
        return None
    lists = {name: wanted if isinstance(wanted, list) else [wanted] for name, wanted in where.items()}
    rows = results.frame
    rows = rows[rows[value].notna() | (rows.get("status") == "failed")][[*lists]].astype(object)
    rows = rows.where(rows.notna(), None)
    for name, wanted in lists.items():
        rows = rows[rows[name].isin(wanted)]
    return {name: [v for v in wanted if v in set(rows[name])] for name, wanted in lists.items()} if len(rows) else None


def mean(results: Results, where: Where, value: str = "rt_le_m") -> float | None:
    """Mean of a metric over egos, runs and training seeds."""
    return next((float(values.mean()) for values in _values(results, where, value)[0]), None)


def interval(results: Results, where: Where, value: str = "rt_le_m") -> Interval | None:
    """Mean of a metric over egos, runs and training seeds, with its interval over egos, then runs."""
    values, lost = _values(results, where, value)
    return replace(mean_interval(values[0]), lost=lost) if values else None


def _values(results: Results, where: Where, value: str) -> tuple[list[Floats], int]:
    """(R, E) of a metric for the egos that have it in all runs, nothing if none has, and how many values they lack."""
    kept = present(results, where, value)
    return ([], 0) if kept is None else paired(results, value, kept)


def rms(results: Results, where: Where) -> float | None:
    """sqrt(mean over runs of RT-LE^2), averaged over egos and training seeds: the quantity that the bound bounds."""
    kept = present(results, where)
    if kept is None:
        return None
    by = [name for name in ("ego", "train_seed") if name in results.frame]
    squares = results.select(kept).groupby(by, dropna=False)["rt_le_m"].agg(lambda values: (values**2).mean())
    return float(np.sqrt(squares).mean())


def paired(results: Results, value: str, *wheres: Where) -> tuple[list[Floats], int]:
    """(R, E) of a metric of each selection for the egos and runs that all of them have, nothing if there are none, and
    how many others egos have that any of them has."""
    from .results import whole

    grids = [results.grid(value, where) for where in wheres]
    union, there = sum(grids[1:], grids[0]), reduce(lambda one, other: one.combine_first(other), grids)
    kept = whole(union)
    lost = there.dropna(how="all").size - kept.size
    return [grid.loc[kept.index, kept.columns].to_numpy().T for grid in grids if kept.size], lost


def difference(results: Results, method: Where, base: Where) -> Interval | None:
    """RT-LE of `method` less that of `base` in metres, paired by ego and run; None where no pair was run."""
    return next(iter(gaps(results, method, base).values()), None)


def failures(results: Results, where: Where) -> Any:
    """Rows of the failed cells of a selection."""
    rows = results.failures
    for name in where.keys() & rows:
        wanted = where[name]
        there = rows[name].astype(object).where(rows[name].notna(), None)
        rows = rows[there.isin(wanted if isinstance(wanted, list) else [wanted])]
    return rows


def across(number: Number, selections: Mapping[str, Where]) -> dict[str, Number]:
    """Columns of `coopoc.study.tables.crossed` that show one number.

    Args:
        number: of a selection.
        selections: title -> what the column adds to the selection of a row.
    """

    def column(also: Where) -> Number:
        return lambda results, where: number(results, {**where, **also})

    return {title: column(also) for title, also in selections.items()}


def ran(numbers: Mapping[Any, float | None]) -> dict[Any, float]:
    """Those of the numbers that were run, in their order.

    >>> ran({"OKF": 0.8, "KF": None})
    {'OKF': 0.8}
    """
    return {name: value for name, value in numbers.items() if value is not None}


def three(value: float) -> str:
    """A number with three digits, zeros included.

    >>> three(1.0), three(10.14), three(121.3)
    ('1.00', '10.1', '121')
    """
    return f"{value:#.3g}".removesuffix(".")


def listed(numbers: Mapping[str, float | None]) -> str:
    """Lengths in metres as words: those that were run, in their order.

    >>> listed({"OKF": 0.8, "KF": None, "GNSS": 3.0})
    'OKF 0.800 m, GNSS 3.00 m'
    """
    return ", ".join(f"{name} {three(value)} m" for name, value in ran(numbers).items())


def by_seed(results: Results, where: Where, value: str = "rt_le_m") -> list[Where]:
    """The selection of each training seed; of a method that is not trained its own, and none if it was not run."""
    if (kept := present(results, where, value)) is None:
        return []
    rows = results.select(kept)
    seeds = sorted(rows["train_seed"].dropna().unique()) if "train_seed" in rows else []
    return [{**kept, "train_seed": seed} for seed in seeds] or [kept]


def seed_means(results: Results, where: Where) -> list[float]:
    """Mean RT-LE for each training seed over the egos and runs that all have, m; of a method that is not trained one,
    and none if it was not run."""
    wheres = by_seed(results, where)
    return [float(values.mean()) for values in paired(results, "rt_le_m", *wheres)[0]] if wheres else []


def seed_std(results: Results, where: Where) -> float | None:
    """Standard deviation over training seeds of the mean RT-LE, m; None for fewer than two seeds."""
    each = seed_means(results, where)
    return float(np.std(each, ddof=1)) if len(each) > 1 else None


def gaps(results: Results, first: Where, second: Where, value: str = "rt_le_m") -> dict[str, Interval]:
    """What the difference of two selections is over -> its mean and interval: egos and runs, and seeds of the first.

    Args:
        results: of the study.
        first: selection of one method.
        second: selection of another one, over the same egos and runs.
        value: the metric.

    >>> from pandas import DataFrame
    >>> from coopoc.study.results import Results
    >>> runs, errors = [0, 1, 2, 1, 2, 1, 2, 3], [9.0, 2.0, 3.0, 2.0, 3.0, 1.0, 2.0, 9.0]
    >>> frame = DataFrame({"method": [*"aaaaabbb"], "ego": "e", "run": runs, "rt_le_m": errors})
    >>> frame["train_seed"] = [0, 0, 0, 1, 1, None, None, None]
    >>> both = gaps(Results("s", "?", (), {}, frame, frame[:0], 0, {}), {"method": "a"}, {"method": "b"})
    >>> [f"{gap} {over}" for over, gap in both.items()]
    ['1 [1, 1] over egos and runs, but 2 pairs that lack a value', '1 [1, 1] over 2 training seeds']
    """
    seeds, base = by_seed(results, first, value), present(results, second, value)
    values, lost = paired(results, value, *seeds, base) if seeds and base is not None else ([], 0)
    if not values:
        return {}
    *each, kept = values
    left_out = f", but {lost} pairs that lack a value" if lost else ""
    intervals = {f"over egos and runs{left_out}": replace(paired_difference(np.mean(each, axis=0), kept), lost=lost)}
    if len(each) > 1:
        intervals[f"over {len(each)} training seeds"] = over_seeds(np.array(each) - kept)
    return intervals


EQUAL_SHARE = 1e-3
"""Share of a number: a smaller difference is none."""


def sign(results: Results, first: Where, second: Where, value: str = "rt_le_m") -> int:
    """Sign of the difference of two selections, which decides who is better in every table and sentence.

    0 if noise or training can explain it or it is below EQUAL_SHARE: an interval of it is not beyond, or is unknown, or
    lacks pairs.

    >>> from pandas import DataFrame
    >>> from coopoc.study.results import Results
    >>> frame = DataFrame({"method": [*"aabbccd"], "run": [0, 1] * 3 + [0], "ego": "e"})
    >>> frame["rt_le_m"] = [1.0, 2.0, 1.1, 2.1, 1.0 + 1e-7, 2.0 + 1e-7, 0.5]  # one draw, d, is no evidence
    >>> [sign(Results("s", "?", (), {}, frame, frame[:0], 0, {}), {"method": "a"}, {"method": of}) for of in "bcd"]
    [-1, 0, 0]
    """
    there, back = ([*gaps(results, *both, value).values()] for both in ((first, second), (second, first)))
    ends = np.array([(gap.low, gap.high) for gap in there] + [(-gap.high, -gap.low) for gap in back])
    least = EQUAL_SHARE * abs(mean(results, second, value) or 0.0)
    known = not any(gap.lost for gap in there)
    return known * (int((ends > least).all()) - int((ends < -least).all()))


def verdict(results: Results, trained: Where, other: Where, name: str) -> str:
    """Sentence on the RT-LE of `trained`, against `other`, which needs no training, with the evidence.

    Args:
        results: of the study.
        trained: selection of one method.
        other: selection of another method, over the same egos and runs.
        name: of the other, for the sentence.
    """
    intervals = gaps(results, trained, other)
    if not intervals:
        return f"cannot be compared with {name}: they share no ego and run"
    claim = ("cannot be distinguished from", "is worse than", "beats")[sign(results, trained, other)]
    evidence = ", ".join(
        f"{gap.mean:+.3f} m, 95 % [{gap.low:+.3f}, {gap.high:+.3f}] {over}" for over, gap in intervals.items()
    )
    single = len(intervals) == 1 and present(results, trained, "train_seed") is not None
    one = " of one training seed, whose spread is unknown" * single
    return f"{claim} {name} (paired difference {evidence}{one})"
