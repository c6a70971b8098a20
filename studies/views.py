"""What the views of the studies share: the part of a selection that was run, seeds, and what may be claimed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.arrays import Floats
from coopoc.evaluate.statistics import Interval, over_seeds, paired_difference

if TYPE_CHECKING:
    from coopoc.study.results import Results
    from coopoc.study.tables import Table


def reference(name: str) -> Path:
    """The file with a study's reference numbers."""
    return Path(__file__).parent / "reference" / f"{name}.json"


def present(results: Results, where: Mapping[str, Any], value: str = "rt_le_m") -> dict[str, Any] | None:
    """`where` without the values for which nothing was run; None if that leaves no row with a number.

    Args:
        where: column -> value, or a list of values. value: the metric that is wanted.
    """
    rows = results.frame
    if not {*where, value} <= set(rows):
        return None
    lists = {name: wanted if isinstance(wanted, list) else [wanted] for name, wanted in where.items()}
    kept = rows[value].notna().to_numpy()
    for name, wanted in lists.items():
        kept = kept & rows[name].isin(wanted).to_numpy()
    if not kept.any():
        return None
    ran = {name: set(rows[name][kept].unique()) for name in lists}
    return {name: [v for v in wanted if v in ran[name]] for name, wanted in lists.items()}


def mean(results: Results, where: Mapping[str, Any], value: str = "rt_le_m") -> float | None:
    """Mean of a metric over egos, runs and training seeds; None where it was not run."""
    kept = present(results, where, value)
    return None if kept is None else float(results.values(value, kept).mean())


def rms(results: Results, where: Mapping[str, Any]) -> float | None:
    """sqrt(mean over runs of RT-LE^2), averaged over egos and training seeds, m: what the bound bounds; None where it
    was not run."""
    kept = present(results, where)
    if kept is None:
        return None
    frame = results.select(kept).assign(square=lambda rows: rows["rt_le_m"] ** 2)
    seeded = "train_seed" in frame and frame["train_seed"].notna().any()
    return float(np.sqrt(frame.groupby(["ego", *(["train_seed"] if seeded else [])])["square"].mean()).mean())


Number = Callable[["Results", dict[str, Any]], float | None]
"""A number of a selection; None where it was not run."""


def crossed(
    results: Results,
    head: Sequence[str],
    rows: Sequence[tuple[Sequence[Any], Mapping[str, Any]]],
    columns: Sequence[tuple[str, Mapping[str, Any]]],
    number: Number,
    caption: str,
    decimals: int = 2,
) -> Table | None:
    """Table of a number: selections down, selections across; rows that were not run are left out, None if all were.

    Args:
        head: over the labels of a row. rows: labels and selection of each. columns: the same, one label.
    """
    from coopoc.study.tables import Table

    body = []
    for labels, where in rows:
        found = [number(results, {**where, **also}) for _, also in columns]
        if any(value is not None for value in found):
            body.append((*labels, *found))
    return Table((*head, *(label for label, _ in columns)), tuple(body), caption, decimals=decimals) if body else None


def listed(found: Mapping[str, float | None]) -> str:
    """{"OKF": 0.8, "KF": None} as "OKF 0.8 m": what was run, in its order."""
    return ", ".join(f"{name} {value:.3g} m" for name, value in found.items() if value is not None)


def seed_std(results: Results, where: Mapping[str, Any]) -> float | None:
    """Standard deviation over training seeds of the mean RT-LE; None for one seed and for what is not trained."""
    each = _per_seed(results, where)
    return float(over_seeds(each).means.std(ddof=1)) if len(each) > 1 else None


def verdict(results: Results, one: Mapping[str, Any], other: Mapping[str, Any], name: str) -> str:
    """What may be said of the RT-LE of `one`, which is trained, against `other`, which is not, with the evidence.

    A difference is claimed if its 95 % intervals over egos and runs, and over training seeds, all exclude zero.

    Args:
        one, other: selections of one method each, over the same egos and runs. name: of the other, for the sentence.
    """
    base, each = results.values("rt_le_m", other), _per_seed(results, one)
    gaps = [paired_difference(each.mean(axis=0), base)]
    text = f"paired difference {gaps[0].mean:+.3f} m; 95 % {_ends(gaps[0])} over egos and runs, "
    if len(each) > 1:
        gaps.append(over_seeds(each - base).interval)
        text += f"{_ends(gaps[1])} over {len(each)} training seeds"
    else:
        text += "of one training seed, whose spread is unknown"
    return f"{_claim(gaps, name)} ({text})"


def _claim(gaps: list[Interval], name: str) -> str:
    if not all(np.isfinite([gap.low, gap.high]).all() for gap in gaps):
        return f"cannot be judged against {name}: too few seeds, egos or runs"
    if all(gap.high < 0 for gap in gaps):
        return f"beats {name}"
    return f"is worse than {name}" if all(gap.low > 0 for gap in gaps) else f"cannot be told from {name}"


def _ends(gap: Interval) -> str:
    return f"[{gap.low:+.3f}, {gap.high:+.3f}]"


def _per_seed(results: Results, where: Mapping[str, Any]) -> Floats:
    """(S, E, R) RT-LE for each training seed; S = 0 for what is not trained."""
    frame = results.select(where)
    seeds = sorted(frame["train_seed"].dropna().unique()) if "train_seed" in frame else []
    return np.array([results.values("rt_le_m", {**where, "train_seed": seed}) for seed in seeds])
