"""Score card of a method on worlds: how often and by how much it is worse than being alone or a textbook filter."""

import json
from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from scipy import special

from coopoc import InputError, Method, nees, rt_le
from coopoc.arrays import whole
from coopoc.evaluate.statistics import WORSE_RATIO, mean_interval
from coopoc.methods.catalogue import needs_whole_fleet
from coopoc.paths import made_folder, write
from coopoc.plugins import file_digest, in_file
from coopoc.study.cell import Cell, Params, Row
from coopoc.study.numbers import three
from coopoc.study.provenance import environment
from coopoc.study.run import compute
from coopoc.workers import progress_bar, say

from .lineup import named_method
from .tasks import VERSION
from .worlds import Split, world

if TYPE_CHECKING:
    import pandas as pd


JOINT, ALONE = "joint", "kalman"
"""What a method is compared with on the same draws: the textbook filter, and being alone."""
BAND = special.chdtri(3, [0.975, 0.025])
"""In which 95 % of the NEES of a consistent filter are, of three degrees of freedom."""
MIN_RATIO = 1e-9
"""Least ratio that counts in a geometric mean."""
NUMBERS = ("noted", "rt_le_m", "joint_m", "alone_m", "nees_inside", "nees_median", "microseconds_per_step")
"""Columns of a world, which are NaN but for the first where a method failed."""
NONE = "nothing wrong"


@lru_cache
def _compiled(name: str) -> Method:
    one, first = named_method(name), world(0, everyone=needs_whole_fleet(name))
    one(first.recording.between(0, 3), list(first.egos))
    return one


def world_row(name: str, split: Split, params: Params) -> list[Row]:
    """RT-LE m of a method in one world, of the textbook filter and alone, on the same draws; its NEES and time.

    Args:
        name: of the method.
        split: of the worlds.
        params: with the seed.

    Raises:
        InputError: estimates that are not finite.
    """
    drawn = world(params["seed"], split, everyone=needs_whole_fleet(name))
    egos = list(drawn.egos)
    tracks = {each: _compiled(each)(drawn.recording, egos) for each in {name: "", JOINT: "", ALONE: ""}}
    level = {each: float(rt_le(track, drawn.fleet).mean()) for each, track in tracks.items()}
    if not np.isfinite(level[name]):
        raise InputError("estimates", level[name], "must be finite", "Estimate every ego at every step.")
    track = tracks[name]
    row = {"kinds": "; ".join(drawn.kinds), "noted": float(bool(track.notes)), "rt_le_m": level[name]}
    row |= {"joint_m": level[JOINT], "alone_m": level[ALONE]}
    if track.covariance is not None:
        each = nees(track, drawn.fleet, method=name)
        each = each[np.isfinite(each)]
        row["nees_inside"] = float(np.mean((each >= BAND[0]) & (each <= BAND[1])))
        row["nees_median"] = float(np.median(each))
    row["microseconds_per_step"] = 1e6 * track.seconds / track.x[..., 0].size
    return [row]


def run_worlds(methods: Sequence[str], out: Path, count: int, seed: int | None, validation: bool, jobs: int) -> int:
    """Write and print the cards of methods; 1 if a world failed.

    Args:
        methods: names of cooperative or solo methods.
        out: folder of the cards.
        count: number of worlds.
        seed: of the first; None for 0 and a card that can be submitted.
        validation: whether worlds are those on which parameters are chosen.
        jobs: processes.

    Raises:
        InputError: an unknown method, less than one world or process.
    """
    whole("worlds", count, 1, 2**20, "Cards that are submitted have 1000.")
    whole("jobs", jobs, 1, 10**4, "Give the number of worker processes.")
    first = whole("seed", seed or 0, 0, 2**29, "Count worlds from 0.")
    for name in methods:
        named_method(name)
    cards = []
    for name in methods:
        began, file = perf_counter(), card_file(name, out, seed, validation, count)
        cards.append(worlds_card(name, count, first, "validation" if validation else "test", jobs))
        lines = (f" {json.dumps(key)}: {json.dumps(value)}" for key, value in cards[-1].items())
        write(file, "{\n" + ",\n".join(lines) + "\n}\n")  # a card is read by people and kept in a repository
        print(details(cards[-1]), end="\n\n")
        say(f"{file}, {perf_counter() - began:.1f} s")
    print(overview(cards))
    return int(any(card["failed"] for card in cards))


def card_file(name: str, out: Path, seed: int | None, validation: bool, count: int) -> Path:
    """File of a method's card; in folders of their own those of other draws and of validation, which cannot be
    submitted.

    Raises:
        InputError: it is there, of more worlds or tasks than the `count` to come.
    """
    folder = made_folder(out / ("validation" if validation else "") / ("" if seed is None else f"seed-{seed}"))
    file = folder / f"{quote(name, safe='')}.json"
    held: Params = json.loads(file.read_bytes()) if file.is_file() else {"tasks": ()}
    if (had := len(held["tasks"] if "tasks" in held else held["worlds"]["seed"])) > count:
        hint = "Name another --out, or remove the card."
        raise InputError("out", str(file), f"holds {had} results already, and {count} would replace them", hint)
    return file


def card_head(name: str) -> Row:
    """What a method of a card is, and with which versions it was run."""
    used = environment()
    versions = {library: used[library] for library in ("coopoc", "numpy", "numba", "torch") if library in used}
    source = file_digest(name, "method") if in_file(name) else ""
    return {"benchmark": VERSION, "method": name, "source": source, "versions": versions}


def worlds_card(name: str, count: int, seed: int = 0, split: Split = "test", jobs: int = 1) -> Row:
    """The card of a method on worlds seed..seed+count-1: columns of all worlds, and what they amount to.

    Args:
        name: of a method, or "mine.py:NAME".
        count: number of worlds.
        seed: of the first.
        split: of the worlds.
        jobs: processes.
    """
    cells = [Cell({"seed": k}, {"seed": k}, str(k)) for k in range(seed, seed + count)]
    rows, failed = [], {}
    done = progress_bar(compute(partial(world_row, name, split), cells, jobs), name, count, unit="world", delay=2.0)
    for outcome in done:
        at = outcome.cell.settings["seed"]
        if outcome.rows is not None:
            rows += [{"seed": at, **row} for row in outcome.rows.to_pylist()]
            continue
        failed[at] = outcome.reason.partition("\n")[0][:200]
        say(f"failed: world {at}: {failed[at]}")
        rows.append({"seed": at, "kinds": "; ".join(world(at, split).kinds), "noted": 1.0})
    frame = _frame(rows)
    each_kind = frame.assign(kind=frame["kinds"].replace("", NONE).str.split("; ")).explode("kind")
    return {
        **card_head(name),
        "split": split,
        "summary": summary(frame),
        "by_kind": {str(kind): summary(part) for kind, part in each_kind.groupby("kind")},
        "worst": _worst(name, split, frame),
        "failed": {str(at): failed[at] for at in sorted(failed)},
        "worlds": {key: [*map(_short, frame[key].tolist())] for key in ("seed", "rt_le_m", "joint_m", "alone_m")},
    }


def _short(value: Any) -> Any:
    """Five digits, so that cards stay small; None for what is not finite, which JSON has no number for."""
    if not isinstance(value, float):
        return value
    return float(f"{value:.5g}") if np.isfinite(value) else None


def _frame(rows: Sequence[Row]) -> "pd.DataFrame":
    """Worlds by seed, to five digits, with the ratios to the textbook filter, to being alone and to the better of both;
    infinite where the method failed."""
    import pandas as pd

    frame = pd.DataFrame(rows, columns=["seed", "kinds", *NUMBERS]).sort_values("seed", ignore_index=True)
    for key in NUMBERS:
        frame[key] = frame[key].map(_short).astype(float)
    better = frame[["joint_m", "alone_m"]].min(axis=1)
    for key, other in (("over_joint", frame["joint_m"]), ("over_alone", frame["alone_m"]), ("over_better", better)):
        frame[key] = (frame["rt_le_m"] / other).fillna(np.inf)
    return frame


def summary(scored: "pd.DataFrame") -> Row:
    """Shares in % with Wilson's and means with bootstrap 95 % intervals over worlds, percentile, NEES and time.

    Args:
        scored: worlds and their ratios.
    """
    from scipy import stats

    sound, worse = scored[np.isfinite(scored["over_better"])], scored["over_better"] > WORSE_RATIO
    made: Row = {"worlds": len(scored), "failed": len(scored) - len(sound)}
    shares = {
        "worse_than_alone": scored["over_alone"] > WORSE_RATIO,
        "worse_than_better": worse,
        "worse_unnoted": worse & (scored["noted"] == 0.0),
    }
    for key, flags in shares.items():
        ends = stats.binomtest(int(flags.sum()), len(flags)).proportion_ci(method="wilson")
        made[key] = [_short(100.0 * float(share)) for share in (flags.mean(), *ends)]
    if len(sound):
        for key in ("over_joint", "over_better"):
            made[key] = [_short(float(np.exp(value))) for value in _interval(np.log(sound[key].clip(MIN_RATIO)))]
    made["percentile_95"] = _short(float(np.quantile(scored["over_better"], 0.95, method="higher")))
    if len(inside := scored["nees_inside"].dropna()):
        made |= {"nees_inside": _interval(inside), "nees_median": _short(float(scored["nees_median"].median()))}
    if len(sound):
        made["microseconds_per_step"] = _short(float(scored["microseconds_per_step"].median()))
    return made


def _interval(values: "pd.Series[float]") -> list[float]:
    """Mean and ends of its interval; of one world without ends."""
    level = mean_interval(values.to_numpy())
    return [_short(end) for end in (level.mean, level.low, level.high) if np.isfinite(end)]


def _worst(name: str, split: Split, scored: "pd.DataFrame") -> list[Row]:
    """Worlds with the largest ratios, what is in them, and the command that runs each again."""
    more = " --validation" * (split == "validation")
    return [
        {
            "ratio": _short(one["over_better"]),
            **{key: _short(one[key]) for key in ("rt_le_m", "joint_m", "alone_m")},
            "text": world(one["seed"], split).text,
            "command": f"coopoc benchmark {name} --worlds 1 --seed {one['seed']}{more}",
        }
        for one in scored.sort_values("over_better", ascending=False, kind="stable").head(10).to_dict("records")
    ]


def overview(cards: Sequence[Params]) -> str:
    """Markdown table of cards, least share of worlds that are worse than the better of both first."""
    every = [(card["method"], card["summary"]) for card in cards]
    every.sort(key=lambda card: (card[1]["worse_than_better"][0], card[1].get("over_joint", [np.inf])[0]))
    return _table("method", every, "over the better")


def details(card: Params) -> str:
    """Markdown table of a card by kind of fault, and its worst worlds with the commands that run them."""
    kinds = sorted(card["by_kind"].items(), key=lambda item: -item[1]["worse_than_better"][0])
    table = _table("kind of fault", kinds, "95th percentile")
    lines = [
        f"failed: {row['text']}\n    {row['command']}"
        if row["ratio"] is None
        else f"{_of(row['ratio'])} ({_of(row['rt_le_m'])} m; {JOINT} {_of(row['joint_m'])} m, {ALONE} "
        f"{_of(row['alone_m'])} m): {row['text']}\n    {row['command']}"
        for row in card["worst"]
    ]
    return f"{table}\n\nLargest ratios to the better of {JOINT} and {ALONE}:\n\n" + "\n".join(lines)


def _of(value: float | None) -> str:
    return "failed" if value is None else three(value)


def _table(head: str, summaries: Sequence[tuple[str, Params]], left_out: str) -> str:
    """Markdown table of summaries by name, but for one of its columns."""
    rows = []
    for name, scored in summaries:
        columns = {
            head: name,
            "worlds": f"{scored['worlds']}" + f" ({scored['failed']} failed)" * (scored["failed"] > 0),
            "worse than alone [%]": _level(scored["worse_than_alone"]),
            "worse than the better [%]": _level(scored["worse_than_better"]),
            "without a note [%]": _level(scored["worse_unnoted"]),
            "over joint": _level(scored.get("over_joint")),
            "over the better": _level(scored.get("over_better")),
            "95th percentile": _of(scored["percentile_95"]),
            "NEES inside": _level(scored.get("nees_inside")),
            "median NEES": _of(scored["nees_median"]) if "nees_median" in scored else "",
        }
        del columns[left_out]
        rows.append(columns)
    return markdown(rows)


def _level(values: Sequence[float] | None) -> str:
    if not values:
        return ""
    ends = ", ".join(f"{value:.3g}" for value in values[1:])
    return f"{values[0]:.3g}" + f" [{ends}]" * bool(ends)


def markdown(rows: Sequence[Row]) -> str:
    """Rows as a Markdown table."""
    from tabulate import tabulate

    return tabulate(rows, headers="keys", tablefmt="github", disable_numparse=True)
