"""Relative measurements of a log against positions: scale, lateness, outliers, wrong partners, offsets of pairs."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from numpy import inf, nan
from numpy.linalg import norm

from coopoc.arrays import Floats, Ints, robust_std
from coopoc.world.links import wrap

from .estimates import (
    LAG_STEP,
    LEAST_COUNT,
    LONG_LAG,
    LONGEST_LAG,
    MAY,
    MOVED_STDS,
    NUDGE_STEP,
    OUTLYING,
    PERHAPS,
    SURE_ERRORS,
    factors,
    median,
    pairs,
    share,
)
from .frames import UNSTATED
from .motion import MOVING
from .residuals import Check, plane, residual_of, without

UNITS = {"range": "m", "azimuth": "rad", "inclination": "rad"}
WIDE_RATIO, NARROW_RATIO = 2.0, 0.4
"""Ratios of a measured to a stated standard deviation at which something is wrong."""
MAX_ANGLE_STD, MIN_STD_SHARE = 0.5, 1e-3
"""rad, largest standard deviation of angles that is offered; least share of a stated one that is offered instead: of
numbers without noise it would be 0."""
HINTS = {
    "range": "Do fixes drift, or are clocks, tags or positions off?",
    "azimuth": "Check their zero (+x, or the heading for a bearing), their sense (anticlockwise), their unit (rad), "
    "whose heading they count from, and that no axis is mirrored.",
    "inclination": "Inclinations count from +z, elevations from the horizon.",
}
"""What to look for where measurements of a kind miss the positions."""
OUTLIER_SHARE, LEAST_OUTLIERS = 0.01, 3
"""Share of measurements beyond 5 standard deviations that is reported, if these are more than several."""
LASTS_STDS = 0.6
"""Standard deviations of two fixes by which receivers may be off for long, over OUTLYING."""
MEDIAN_WINDOW, WANDER = 9, 3.0
"""Measurements of a pair whose median is taken off to count outliers; variance about it of a random walk from one to
the next, over the share of its variance that the drive keeps."""
PLACE_ERRORS, GAUSS_NEWTON = 6.0, 4
"""Standard errors from which a member stands elsewhere; steps that find where."""
WRONG_SHARE, NAMED_CASES, MISFITS = 0.8, 4, 500
"""Share of a part of a drive in which something is wrong, and of the drive that such a part may be; cases that a
sentence names; measurements that show what they are of."""


def measurements(c: Check) -> list[dict[str, Any]]:
    """Rows of a table: each kind of relative measurement, and how it scatters about the positions."""
    rows = []
    for k, (name, unit) in enumerate(UNITS.items()):
        pair, stated = pairs(c, k, k > 0), float(c.world.sensors.relative_std[k])
        residual, expected = (pd.Series(values[pair.index, k], pair.index) for values in (c.relative, c.expected))
        if not len(pair) or np.ptp(c.log.recording.relative[0, pair.index, k]) == 0:
            continue
        known = pair.map({name: offset for name, offset, _ in _named(c, k, stated)}).fillna(0.0)
        usual = residual.groupby(pair).transform(lambda each: each.rolling(MEDIAN_WINDOW, 1, center=True).median())
        off = (residual - usual).to_numpy()  # errors of the filters last longer than that window
        noise = robust_std(off)
        least = np.maximum(max(noise, 0.2 * stated), expected / 2)  # a direction of what is near hardly counts
        rows.append(
            {
                "measurement": name,
                "unit": unit,
                "number": len(residual),
                "median": float(np.median(residual)),
                "robust_std": robust_std((residual - known).to_numpy()),
                "stated_std": stated,
                "expected_std": float(np.sqrt(np.mean(expected**2))),
                "noise": noise,
                "beyond_5_std": float(np.mean(abs(off) > OUTLYING * least)),
            }
        )
    return rows


def of_places(c: Check) -> Iterator[str]:
    """Members that stand elsewhere than their fix says."""
    ids, at = c.world.ids, plane(np.nan_to_num(c.x)[-1])
    for name, (away, error) in c.places.items():
        off = abs(at[ids.index(name)] + away - at)
        like = f": there is {ids[off.argmin()]}. Are names exchanged?"
        yield (
            f"{name}: it stands {away.real:+.2f} m east and {away.imag:+.2f} m north of its fix, +- {error:.2f} m, by "
            f"what measures it{like if off.min() < max(3 * error, 0.1 * abs(away)) else '. Correct its place.'}"
        )


def of_ranges(c: Check) -> Iterator[str]:
    """What all ranges share that positions contradict."""
    (scale, unsure), (late, error) = c.ranges
    if scale:
        yield (
            f"ranges are too {'long' if scale > 0 else 'short'} by {100 * abs(scale):.2f} +- {100 * unsure:.2f} %: "
            f"scale=range:{1 / (1 + scale):.5g} mends it."
        )
    if late:
        yield (
            f"ranges are {abs(late):.3f} +- {error:.3f} s {'late' if late > 0 else 'early'} beside fixes and odometry: "
            "stamp them when they are measured."
        )


def misplaced(c: Check) -> Check:
    """The same with members that stand elsewhere than their fix says, m east + i north and its standard error, and
    without what measures these. The surest is taken first: beside it, others seem to be off."""
    left, ids = {*np.flatnonzero(c.still).tolist()}, c.world.ids
    while left:
        found = {column: _elsewhere(c, column) for column in left}
        column = max(left, key=lambda one: abs(found[one][0]) / found[one][1])
        away, error = found[column]
        if abs(away) < max(PLACE_ERRORS * error, c.world.sensors.range_std):
            break
        left.remove(column)
        c = replace(without(c, [column]), places={**c.places, ids[column]: (away, error)})
    return c


def _elsewhere(c: Check, column: int) -> tuple[complex, float]:
    """How far a member is from where its fix is, m east + i north, by ranges and directions, and its standard error."""
    links = c.world.links
    of_it = (links.observer == column) | (links.neighbour == column)
    there = np.isfinite(c.relative[:, :2]) & of_it[:, None]
    group = (2 * (links.observer + links.neighbour)[:, None] + [0, 1])[there]
    if len(group) < LEAST_COUNT or np.median(abs((c.relative / c.expected)[:, :2][there])) <= 1.0:
        return 0j, inf
    computed = residual_of(c.world, c.x)[1]

    def misses(away: complex) -> Floats:
        """(K,) standard deviations by which it is measured otherwise, were it that far away."""
        x = c.x.copy()
        x[:, column, :2] += [away.real, away.imag]
        miss = c.relative + residual_of(c.world, x)[1] - computed
        miss[:, 1] = wrap(miss[:, 1])
        return np.asarray((miss / c.expected)[:, :2][there])

    away, error = 0j, inf
    for _ in range(GAUSS_NEWTON):
        y = misses(away)
        x = np.column_stack([y - misses(away + step) for step in (NUDGE_STEP, NUDGE_STEP * 1j)]) / NUDGE_STEP
        value, unsure = factors(y, x, 1.0, group)
        away, error = away + complex(*value), float(norm(unsure))
    known = np.nan_to_num(c.expected[of_it, 0] ** 2 - c.world.sensors.range_std**2).clip(1e-12)
    return away, float(np.hypot(error, (known.mean() * share(c) / len(np.unique(group // 2))) ** 0.5))


def of_measurements(c: Check) -> Iterator[str]:
    """Residuals of relative measurements that no stated noise explains: scale, outliers, offsets of pairs."""
    links = c.world.links
    for row in c.measurements:
        name, unit, number, median, std, least, should, noise, outliers = row.values()
        if number < LEAST_COUNT:
            continue
        word = "bearing" if name == "azimuth" and c.in_body else name
        hint = HINTS[name]
        position = max(should**2 - least**2, 0.0) ** 0.5
        wrong = std > WIDE_RATIO * max(should, noise) or (name == "azimuth" and std > MAX_ANGLE_STD > 3 * position)
        scaled = False
        if name != "range":
            wrong |= abs(median) > 3 * should
            hint = (_other_angle(c) if name == "azimuth" else "") or hint
        else:
            measured = c.world.relative[0, :, 0]
            true = measured - c.relative[:, 0]
            far = measured + true > 2 * MOVED_STDS * position
            ratios = measured[far] / np.maximum(true[far], 1e-3)
            ratio = np.median(ratios) if len(ratios) >= LEAST_COUNT else 1.0
            wrong |= (other := not 0.8 <= ratio <= 1.25)
            varied = robust_std(measured[far] - ratio * true[far]) < std if len(ratios) else False  # else an offset is
            varied = varied and robust_std(true[far]) > 0.2 * np.median(true[far])
            powers = np.log10([ratio, 0.3048 * ratio])
            usual = abs(powers - np.round(powers)).min() < 0.02
            if scaled := other and (varied or usual) and robust_std(ratios) < 0.2 * ratio:
                power = round(np.log10(ratio))
                unit_of = 10.0**-power if power and abs(np.log10(ratio) - power) < 0.1 else 1 / ratio
                hint = (
                    f"They are {ratio:.3g} times as long: scale=range:{unit_of:.3g} (of mm 0.001, of feet 0.3048); "
                    "then check again."
                )
        k = list(UNITS).index(name)
        misfits = _misfits(c, k)
        apart = {one.join(ends) for pair in misfits for ends in (pair, pair[::-1]) for one in (" to ", " and ")}
        named = [one for one in _named(c, k, least) if one[0] not in apart]
        if outliers > max(OUTLIER_SHARE, LEAST_OUTLIERS / number) and not scaled and not misfits:
            yield (
                f"{outliers:.1%} of the {word}s lie beyond 5 standard deviations of those before and after: outliers, "
                "as of reflections. Drop them, or take a method with a gate or a robust loss."
            )
        of_pairs = misfits and (not wrong or hint == HINTS[name])
        if wrong and not of_pairs:
            yield (
                f"{word}s miss the positions by {median:.3g} +- {std:.3g} {unit}, {should:.3g} {unit} expected. {hint}"
            )
        if of_pairs:
            ends = set.intersection(*map(set, misfits))
            one = "".join(ends) if len(ends) == 1 else ""
            worst_of = sorted(misfits, key=lambda pair: -misfits[pair][0])[:NAMED_CASES]
            clocks = np.array([-ahead if pair[0] != one else ahead for pair, (_, _, ahead) in misfits.items()])
            yield (
                f"{one}: its clock is {abs(np.median(clocks)):.1f} s {'ahead of' if clocks[0] > 0 else 'behind'} the "
                f"others' by all {word}s that are off: clock={one}:{np.median(clocks):.1f}, and check again."
                if one and np.ptp(clocks) < LONG_LAG
                else f"{word}s of {len(misfits)} of {len({*zip(links.observer, links.neighbour, strict=True)})} "
                "that measure another are off for long, by no offset: "
                f"{', '.join(' to '.join(pair) + misfits[pair][1] for pair in worst_of)}"
                f"{', ...' * (len(misfits) > NAMED_CASES)}. {f'All are with {one}: a' if one else 'A'} wrong partner, "
                "position or clock, or a value that is held."
            )
        for verb in ["are"] * (not wrong or hint == HINTS["range"]) + [MAY] * (not wrong):
            some = [one for one in named if (abs(one[1]) > SURE_ERRORS * one[2]) == (verb != MAY)]
            if not some:
                continue
            yield (
                f"{word}s of {', '.join(f'{pair} by {off:+.3g} +- {error:.2g} {unit}' for pair, off, error in some)} "
                f"{verb} off in the median, with {least:.3g} {unit} stated: an "
                "offset of the sensors, of antennas, or of fixes or heights of one of the two; "
                + (
                    f"offset={','.join(f'{i}:{by:.3g}' for i, by, _ in some if ' and ' in i).replace(' and ', '-')} "
                    "takes it off."
                    if " to " not in some[0][0]
                    else f"if of all that one measures, offset={some[0][0].split(' to ')[0]}.{word}:{some[0][1]:.3g} "
                    "takes it off (named and in the unit as logged)."
                )
            )
        position *= min(WANDER * pairs(c, k, False).nunique() / (number * max(share(c), MIN_STD_SHARE)), 1.0) ** 0.5
        if not wrong and not NARROW_RATIO * least < noise < WIDE_RATIO * np.hypot(least, position):  # which lasts
            known = "assumed" if name in "".join(c.log.summary.assumed.get(UNSTATED, ())) else "stated"
            yield (
                f"{word}s scatter {'less' if noise < least else 'more'} than {known}, by {noise:.2g} {unit} from one "
                f"to the next, {least:.2g} {unit} {known}: std={word}:{max(noise, MIN_STD_SHARE * least):.2g}."
                f"{' Were variances given as deviations, or another unit?' * (known == 'stated')}"
            )


def _misfits(c: Check, k: int) -> dict[tuple[str, str], tuple[float, str, float]]:
    """Who measures whom -> by what that is off where it is for long, though an offset is taken off; in words, with whom
    else it fits; and s by which the observer's clock is ahead if that explains it, else NaN."""
    world = c.world
    links, ids, measured = world.links, world.ids, world.relative[0, :, 0]
    misfit_of = {}
    t, names = world.t - world.t[0], pairs(c, k, True)
    for rows in names.groupby(names).groups.values():
        one, other = links.observer[rows[0]], links.neighbour[rows[0]]
        off, expected = c.relative[rows, k], c.expected[rows, k]
        less = off - np.median(off)
        less = wrap(less) if k else less
        lasts = LASTS_STDS * c.fix_noise / (np.maximum(measured[rows], 1.0) if k else 1.0)
        lasts = np.where(expected > world.sensors.relative_std[k], lasts, robust_std(np.diff(less)))  # of a truth, none
        errors = pd.Series(abs(less) / np.maximum(expected, lasts))
        bad = np.flatnonzero(errors.rolling(MEDIAN_WINDOW, 1, center=True).median() > OUTLYING)  # most are too large
        if len(bad) < LEAST_COUNT:
            continue
        size, text = float(np.median(abs(off[bad]))), when(t[links.step[rows]], bad)
        some = rows[bad[:: len(bad) // MISFITS + 1]]
        steps, lags = links.step[some][:, None], np.arange(-LONGEST_LAG, LONGEST_LAG, LAG_STEP)
        then = (steps - np.round(lags / world.dt).astype(int)).clip(0, len(c.x) - 1)
        places = np.hstack([c.x[steps[:, 0]], c.x[then, other]])  # of all, and of its own before and later
        miss = pd.DataFrame(abs(norm(places - c.x[steps, one], axis=2) - measured[some, None])).median().fillna(inf)
        best, ahead = int(miss.argmin()), nan
        if k == 0 and miss[best] < WIDE_RATIO * np.median(expected) < 0.2 * size:
            ahead = nan if best < len(ids) else float(lags[best - len(ids)])
            text += f", as if {f'to {ids[best]}' if best < len(ids) else f'its clock was {ahead:+.1f} s ahead'}"
        misfit_of[ids[one], ids[other]] = size, f" by {size:.3g} {list(UNITS.values())[k]}{text}", ahead
    return misfit_of


def _named(c: Check, k: int, stated: float) -> list[tuple[str, float, float]]:
    """Pairs whose measurements of one kind are off by more than PERHAPS errors and a quarter of their noise, with
    medians and their standard errors, largest first: by parts of the drive, and by errors of the filters, which
    last. Ranges of a pair whose two ends differ by more than `stated` m are those of one of them."""
    named, lasts, names = [], share(c), pairs(c, k, True)
    if k == 0:
        both, usual = pairs(c, 0, False), pd.Series(c.relative[names.index, 0]).groupby(names.to_numpy()).median()
        least, most = (names.map(usual).groupby(both).transform(each) for each in ("min", "max"))
        names = names.where(most - least > stated, both)
    for pair, rows in names.groupby(names).groups.items():
        offset, error = median(c.relative[rows, k])
        position = max(float(np.mean(c.expected[rows, k] ** 2)) - stated**2, 0.0)
        error = float(np.sqrt(error**2 + stated**2 / len(rows) + position * lasts))
        # of so many pairs one is beyond it in twenty logs, as by Bonferroni
        if abs(offset) > max(PERHAPS * names.nunique() ** 0.15 * error, 0.25 * stated):
            named.append((str(pair), offset, error))
    return sorted(named, key=lambda row: -abs(row[1]))


def _other_angle(c: Check) -> str:
    """What azimuths look like that miss the positions by the course of their observers."""
    links = c.world.links
    moves = plane(c.world.velocity[0, links.step, links.observer])
    there, heading = np.isfinite(c.relative[:, 1]), np.where(abs(moves) > MOVING, np.angle(moves), nan)
    residual, course, measured = c.relative[there, 1], heading[there], c.world.relative[0, there, 1]
    off = np.angle(np.exp(1j * residual).sum())
    off += np.median(wrap(residual - off))
    causes = {
        "bearings: name them bearing": course,
        "azimuths: name them azimuth": -course,
        "bearings clockwise from the heading: change their sign": 2 * (course - measured),
        "azimuths clockwise from north: take each from pi / 2": np.pi / 2 - 2 * measured,
        "azimuths clockwise: change their sign": -2 * measured,
        f"angles from an axis that is turned by {-off:.3g} rad: add {-off:.3g}": -off,
    }
    rests = {like: abs(wrap(residual + turn)) for like, turn in causes.items()}
    left = {like: np.nanmedian(rest) for like, rest in rests.items() if np.isfinite(rest).sum() >= LEAST_COUNT}
    if 3 * (least := min(left.values(), default=inf)) > np.median(abs(residual)):
        return ""
    return f"They look like {next(like for like, rest in left.items() if rest <= 1.5 * least)}."


def when(t: Floats, bad: Ints) -> str:
    """The part of a drive with samples at t (M,) s that holds those which are bad, if it is one, in words."""
    if not WRONG_SHARE * (bad[-1] - bad[0]) <= len(bad) <= WRONG_SHARE * len(t):
        return ""
    return f" from {t[bad[0]]:.3g} to {t[bad[-1]]:.3g} s"
