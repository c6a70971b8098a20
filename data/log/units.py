"""Kinds of measurements in a log and their units, the table of its rows, and the counts of what became of them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy import pi

from coopoc import InputError
from coopoc.arrays import Bools

DEGREE, MAX_ANGLE_RAD = float(pi / 180), float(2 * pi) + 1e-3


BODY, QUATERNION = ["speed", "vy_body", "vz_body"], ["qx", "qy", "qz", "qw"]
"""Velocity forward, left and up; rotation from the body to the local frame."""


class Kind(NamedTuple):
    """What a number of this kind means.

    Attributes:
        group: fix, odometry, heading, relative or message.
        name: of the same quantity in SI units.
        limit: largest plausible |value| in its own unit; beyond it the unit is another one.
        scale: in SI it is scale * value + offset.
        offset: rad.
    """

    group: str
    name: str
    limit: float = 1e8
    scale: float = 1.0
    offset: float = 0.0


KINDS = {
    **{name: Kind("fix", name) for name in ("x", "y", "z", "height")},
    "latitude": Kind("fix", "latitude", 90.0),
    "longitude": Kind("fix", "longitude", 180.0),
    "vx_body": Kind("odometry", "speed", 500.0),
    **{name: Kind("odometry", name, 500.0) for name in ("vx", "vy", "vz", *BODY)},
    "speed_kmh": Kind("odometry", "speed", 1800.0, 1 / 3.6),
    "speed_knots": Kind("odometry", "speed", 972.0, 1.852 / 3.6),
    "yaw_rate": Kind("odometry", "yaw_rate", 35.0),
    "heading": Kind("heading", "heading", MAX_ANGLE_RAD),
    **{name: Kind("heading", name, 1.01) for name in QUATERNION},
    "range": Kind("relative", "range"),
    "azimuth": Kind("relative", "azimuth", MAX_ANGLE_RAD),
    "bearing": Kind("relative", "bearing", MAX_ANGLE_RAD),
    "inclination": Kind("relative", "inclination", MAX_ANGLE_RAD / 2),
    "elevation": Kind("relative", "inclination", MAX_ANGLE_RAD / 4, -1.0, float(pi / 2)),
    "message": Kind("message", "message"),
}
"""Azimuth and heading are anticlockwise from +x (east), compass_deg clockwise from north, bearing anticlockwise from
the observer's heading, inclination from +z, elevation above the horizon. A unit that is not SI is in the name."""
for _name in ("yaw_rate", "heading", "azimuth", "bearing", "inclination", "elevation"):
    KINDS[f"{_name}_deg"] = KINDS[_name]._replace(scale=DEGREE * KINDS[_name].scale, limit=KINDS[_name].limit / DEGREE)
KINDS["compass_deg"] = KINDS["heading_deg"]._replace(scale=-DEGREE, offset=float(pi / 2))
KIND_TABLE = pd.DataFrame.from_dict(KINDS, "index", columns=Kind._fields)
LEAST_VALUES = dict.fromkeys(("range", "inclination", "inclination_deg"), 0.0)
MOST_CODES, LEAP_RATIO, LEAST_MEANT = 3, 1.4, 10
"""Codes for "not measured": most different ones of a kind, and of a common number in a row; ratio to the largest
plausible value beyond which a value is one, and, of a value that is plausible, its least rows and the ratio to a
pair's usual step that makes a leap."""
VAGUE, NONSENSE = 30.0, 50.0
"""Ratio to the usual standard deviation of a vehicle's kind from which the largest one, if it repeats, means "not
measured" (the square of it, if it does not), and the least that can, in any unit: fixes may be of 2 cm or 5 m."""
ITSELF = "must be another member: a vehicle neither measures itself nor sends to itself"
DECIMAL = " Degrees are decimal: scale=latitude:1e-7,longitude:1e-7 of integers, 48.1173 for 4807.04 of NMEA."
UNIT = (
    "Is it in another unit? Other kinds: {kinds}; or give scale=. An angle over several turns? Write it within one. "
    "Are few rows so, as where a counter begins anew? Remove them."
)
BELOW = "folders beside files are left out"
"""Beginning of a sentence."""
ANGLES = ("heading", "azimuth", "bearing", "inclination")

KEYS = ["vehicle", "t", "kind"]
"""Columns that name a measurement which has no partner."""
Rows = pd.DataFrame
"""L measurements, a row each, with the columns of BLANK, `file` and `row` (from 1, the header not counted)."""
MISSING = np.nan
BLANK = {
    "t": MISSING,
    "vehicle": "",
    "kind": "",
    "partner": "",
    "value": MISSING,
    "std": MISSING,
    "arrival": MISSING,
    "true": 0.0,
}
"""t in s, of a message when it was sent, NaN of a place without a time; vehicle measures, or sends; partner is
measured, or receives, "" for none or for a message to all; value and std in the unit of the kind, NaN where there is
none; arrival in s, infinite for a message that was lost; true is 1 for what is of the truth, not measured."""


def rows_of(frame: pd.DataFrame, file: str) -> Rows:
    """Rows of a table with some of these columns; its index numbers them."""
    blank: dict[str, Any] = {name: value for name, value in BLANK.items() if name not in frame}
    rows = frame.assign(**blank, file=file, row=frame.index)[[*BLANK, "file", "row"]]
    return rows.astype({name: object if value == "" else float for name, value in BLANK.items()}).reset_index(drop=True)


def of_kinds(frame: pd.DataFrame, file: str) -> Rows:
    """Rows of a table with a column for each kind, and perhaps KIND_std beside it; an empty cell is no measurement."""
    columns = frame[frame.columns.intersection([*BLANK])].fillna({"partner": "", "true": 0.0})
    parts = [
        columns.assign(kind=kind, value=frame[kind], std=frame.get(f"{kind}_std", MISSING))
        for kind in KINDS
        if kind in frame
    ]
    return rows_of(pd.concat(parts).dropna(subset="value"), file)


def only(rows: Rows, *kinds: str) -> Rows:
    """Those of these kinds."""
    return rows[rows["kind"].isin(kinds)]


def in_columns(rows: Rows, kinds: Sequence[str]) -> pd.DataFrame:
    """Values of these kinds, a column each, of every vehicle and time, the first of several."""
    each = only(rows, *kinds).drop_duplicates(KEYS)
    return each.pivot(index=KEYS[:2], columns="kind", values="value").reindex(columns=[*kinds])


def in_group(rows: Rows, *groups: str) -> Bools:
    """(L,) True for rows whose kinds are of these groups."""
    return rows["kind"].map(KIND_TABLE["group"]).isin(groups).to_numpy()


def stated_std(rows: Rows, *kinds: str) -> float:
    """Root mean square of the standard deviations of these kinds that were logged; NaN if none was."""
    return float(np.sqrt((only(rows, *kinds)["std"] ** 2).mean()))


def row_of(rows: Rows) -> str:
    """File and row of the first."""
    first = rows.iloc[0]
    return f"{first['file']}: row {first['row']}"


def without_codes(rows: Rows, summary: "Summary") -> Rows:
    """Rows but those whose number says that there was no measurement, as -1, 0 or 65.535 among ranges: one of few, each
    in several rows, that are far from what can be meant, or to and from which signals leap."""
    own = rows[in_group(rows, "fix", "odometry", "heading", "relative")]
    kind, value = own["kind"], own["value"]
    size, limit = value.abs(), kind.map(KIND_TABLE["limit"])
    wrong = (size > limit) | (value < kind.map(LEAST_VALUES)) | ((kind == "range") & (value == 0.0))
    usual = kind.map(size[~wrong].groupby(kind).max())
    near = (size > limit) & (size <= LEAP_RATIO * usual)  # as of an angle in degrees
    several = value[near].groupby(kind[near]).nunique()
    codes = own[wrong & ~kind.isin(several.index[several > 1])].groupby("kind")["value"].agg(["size", "nunique"])
    few = codes[(codes["nunique"] <= MOST_CODES) & (codes["size"] >= 2 * codes["nunique"])]
    lost = own[wrong & kind.isin(few.index[few["size"] < kind.value_counts().reindex(few.index)])]
    signals = own[~own.index.isin(lost.index) & ~kind.isin(["x", "y", "latitude", "longitude"])]
    for name, values in signals.sort_values(["vehicle", "partner", "t"], kind="stable").groupby("kind"):
        each = values["value"]  # a car may stand often, or go straight ahead: of what is no maximum a few in a row
        for number in {each.min(), *each.mode()[:1], each.max()}:
            most = None if name in ("range", "z", "height") or number == each.max() else MOST_CODES
            lost = pd.concat([lost, values[_leaps(values, number, KINDS[str(name)].limit, most)]])
    for (what, number), same in lost.groupby(["kind", "value"]):
        summary.refuse(f"{what} of {number:g}, which stands for none", same)
    return rows.drop(lost.index.unique())


def not_vague(rows: Rows, summary: "Summary") -> Rows:
    """Rows but those whose standard deviation says that there was no measurement: the largest of a kind, far beyond
    the usual of the vehicle."""
    std = rows["std"]
    ratio = std / std.groupby([rows["vehicle"], rows["kind"]]).transform("median")
    vague = std[(ratio > VAGUE) & (std >= NONSENSE) & std.eq(std.groupby(rows["kind"]).transform("max"))]
    vague = vague[vague.map(vague.value_counts()).gt(1) | (ratio[vague.index] > VAGUE**2)]
    summary.refuse("measurements whose standard deviation says that there is none", rows.loc[vague.index])
    return rows.drop(vague.index)


def _leaps(values: Rows, number: float, limit: float, most: int | None) -> "pd.Series[bool]":
    """(M,) values of that number to and from which those of a vehicle or pair leap, if there are many, or all of it if
    most are; none leaps of more than `most` in a row. Angles, whose `limit` is a turn, leap by half of it at most."""
    same, pair = values["value"] == number, values["vehicle"] + "-" + values["partner"]
    others = values["value"].mask(same).groupby(pair)
    before, behind = others.ffill(limit=most) - number, others.bfill(limit=most) - number
    steps = pd.concat([others.diff(), before, behind], axis=1, ignore_index=True).abs()
    steps = steps.where(steps <= limit / 2, abs(limit - steps))
    usual = steps[0][steps[0] > 0.0].quantile(0.8)
    leaps = same & (steps[[1, 2]].min(axis=1, skipna=most is None) > LEAST_MEANT * usual)
    leaps &= ~(before * behind < 0.0)  # as a signal goes through 0
    return (same if leaps.sum() > 0.5 * same.sum() else leaps) & (leaps.sum() >= LEAST_MEANT)


def check_values(rows: Rows) -> None:
    """InputError at the first value that cannot be meant in its unit, or that lacks its partner."""
    kind, value, partner = rows["kind"], rows["value"], rows["partner"]
    limit = kind.map(KIND_TABLE["limit"])
    alone = in_group(rows, "relative") & (partner == "")
    deviation = "standard deviation of {kind}"
    for wrong, column, actual, allowed, hint in (
        (value.abs() > limit, "{kind}", value, "must be within +-{limit:.4g}", UNIT),
        ((kind == "range") & (value <= 0), "{kind}", value, "must be > 0", "Remove the row."),
        (value < kind.map(LEAST_VALUES), "{kind}", value, "must be >= 0", "Remove the row."),
        (rows["std"] <= 0, deviation, rows["std"], "must be > 0", "Leave it empty where it is unknown."),
        (alone, "column partner", partner, "must be a name", "Name the vehicle or road-side unit."),
        (partner == rows["vehicle"], "column partner", partner, ITSELF, "Correct or remove the row."),
    ):
        if wrong.any():
            first, cell = kind[wrong].iloc[0], actual[wrong].iloc[0]
            others = ", ".join(name for name in KINDS if KINDS[name].name == KINDS[first].name)
            raise InputError(
                f"{row_of(rows[wrong])}, {column.format(kind=first)}",
                (repr(cell) if cell else "empty") if actual is partner else f"{cell:.10g}",
                allowed.format(limit=KINDS[first].limit),
                hint.format(kinds=others) + DECIMAL * (first in ("latitude", "longitude")),
            )


def distinct(rows: Rows, summary: "Summary") -> Rows:
    """Rows but those that repeat a kind of measurement of one vehicle, or pair, at one time; nothing is lost where a
    wide table repeats a fix beside each of several partners."""
    of_pair, key = in_group(rows, "relative", "message"), ["t", "vehicle", "kind", "partner"]
    beside = rows["partner"].ne("") & ~of_pair
    rows = rows.assign(partner=rows["partner"].where(of_pair, ""))
    again = rows.duplicated(key) & (rows["kind"] != "message")
    lost = again & ~(beside & rows.duplicated([*key, "value"]))
    summary.refuse("repeated rows (same time, vehicle, kind and partner)", rows[lost])
    return rows[~again]


def fresh(rows: Rows, summary: "Summary") -> Rows:
    """Rows but fixes and relative measurements that only repeat the values before, where a table at the rate of another
    sensor holds them: where most runs of equal values are of two or more, and not all are equal."""
    keys, some = ["vehicle", "partner", "fix"], rows[in_group(rows, "fix", "relative")].sort_values("t", kind="stable")
    some = some.assign(
        fix=in_group(some, "fix"), same=some.groupby(["vehicle", "partner", "kind"])["value"].diff().eq(0)
    )
    held = some.groupby([*keys, "t"])["same"].all()
    run = (~held).groupby(keys).cumsum()
    length = held.groupby([*keys, run.to_numpy()]).transform("size").where(~held).groupby(keys).transform("median")
    held &= (length >= 2) & (run.groupby(keys).transform("max") > 1)
    lost = some.index[held.reindex(some.set_index([*keys, "t"]).index).to_numpy(dtype=bool)]
    summary.refuse("fixes and relative measurements that hold the values before", rows.loc[lost.sort_values()])
    return rows.drop(lost)


@dataclass
class Summary:
    """What became of the rows of a log, counted while it is read.

    Args:
        name: of the log.
        grid: steps and interval in words.
        vehicles: id -> what was read of it, in words.
        read: what -> number of measurements in the Recording.
        refused: reason -> (number, place of the first) of measurements that are not in it.
        unused: what was never meant to be read -> number of cells.
        odometry: s, from one sample of it to the next, 0 where there is none.
        rows: how many numbers were logged.
        logged: vehicle -> kinds, as they are named in its files.
        reversed_pairs: observer times members, plus neighbour, of pairs that have only what the other end measured.
        assumed: sentence on what the log does not say, with {} for names -> the names, none where it is about all.

    >>> summary = Summary("drive", "3 steps of 0.1 s", {"a": "3 fixes"}, {"fixes": 3})
    >>> summary.refuse("a second fix in a step", 1, "f: row 2")
    >>> summary.assume("{} stands", "a"), summary.assume("{} stands", "b")
    (None, None)
    >>> print(summary)
    drive: 3 steps of 0.1 s, 1 vehicle
      a: 3 fixes
    read: 3 fixes
    not used: 1 a second fix in a step (first: f: row 2)
    assumed: a, b stands
    """

    name: str = ""
    grid: str = ""
    vehicles: dict[str, str] = field(default_factory=dict)
    read: dict[str, int] = field(default_factory=dict)
    refused: dict[str, tuple[int, str]] = field(default_factory=dict)
    unused: Counter[str] = field(default_factory=Counter)
    odometry: float = 0.0
    rows: int = 0
    logged: dict[Any, Any] = field(default_factory=dict)
    reversed_pairs: list[int] = field(default_factory=list)
    assumed: dict[str, list[str]] = field(default_factory=dict)

    def count(self, what: str, number: int) -> None:
        """Add to what was read."""
        if number:
            self.read[what] = self.read.get(what, 0) + number

    def refuse(self, reason: str, rows: Rows | int, where: str = "") -> None:
        """Add rows, or a number of things, to what is not in the Recording."""
        number = rows if isinstance(rows, int) else len(rows)
        if number:
            before, first = self.refused.get(reason, (0, where if isinstance(rows, int) else row_of(rows)))
            self.refused[reason] = before + number, first

    def scale(self, name: str, factor: float, *quantities: str) -> str:
        """The option that scales what a vehicle has logged of some quantities, under the names in its files."""
        kinds = (kind for kind in self.logged.get(name, quantities) if KINDS[kind].name in quantities)
        return f"scale={','.join(f'{name}.{kind}:{factor:.4g}' for kind in kinds)}"

    def assume(self, sentence: str, name: str = "") -> None:
        """Add a sentence, once, and a name that takes the place of its {}."""
        names = self.assumed.setdefault(sentence, [])
        if name and name not in names:
            names.append(name)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What is assumed, with the names."""
        return tuple(sentence.replace("{}", ", ".join(names)) for sentence, names in self.assumed.items())

    @property
    def unread(self) -> str:
        """Sentences on columns that are of no kind, and on folders that are left out."""
        hint = "Name what is meant with columns= or kinds=. A truth is another table: truth=FILE."
        columns = [f"columns not read: {self.columns}. {hint}"] * bool(self.columns)
        return " ".join(columns + [f"{each}." for each in self.sentences if each.startswith(BELOW)])

    @property
    def columns(self) -> str:
        """Those of no kind, with their files."""
        return "; ".join(what for what in self.unused if ": column " in what)

    def __str__(self) -> str:
        count = len(self.vehicles)
        lines = [f"{self.name}: {self.grid}, {count} vehicle{'s' * (count != 1)}"]
        lines += [f"  {name}: {text}" for name, text in self.vehicles.items()]
        lines += [f"read: {', '.join(f'{number} {what}' for what, number in self.read.items())}"]
        for why, (number, first) in self.refused.items():
            lines.append(f"not used: {number} {why}" + (f" (first: {first})" if first else ""))
        lines += [f"not read: {what} ({number} cells)" for what, number in self.unused.items()]
        lines += [f"assumed: {sentence}" for sentence in self.sentences]
        return "\n".join(lines)
