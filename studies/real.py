"""Real vehicles with nothing simulated: when does a neighbour replace a landmark, such as a road-side unit?"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from coopoc import V2X, PoseFilter, Sensors, Study, heading_error, pose_nees
from coopoc.arrays import Floats, one_of, whole
from coopoc.data.log.residuals import GATE_STDS
from coopoc.data.source import split, while_unchanged
from coopoc.evaluate.metrics import errors, fix_innovations
from coopoc.evaluate.scores import online_columns
from coopoc.study.cell import Params, Row
from coopoc.study.numbers import Results, Where, across, difference, interval, mean, present, ran
from coopoc.study.provenance import revision
from coopoc.study.style import Panel, look, words
from coopoc.study.tables import Table, crossed, unused

from . import pose_drives as drives
from .pose_drives import Drive, near, thinned
from .scene import CODE, counted
from .views import Plot, ran_at

FLEET, *DECENTRALISED = FLEET_METHODS = ("pose-fleet", "pose-intersection", "pose-naive")
"""Pose filters of a fleet in body frames."""
ALONE, FEDERATED, CENTRAL = TRAINED = ("trained-alone", "trained-federated", "trained-centralised")
"""One state or a solo filter whose constants are learned on the first part: from a vehicle's own measurements, as the
mean of the logarithms of all vehicles, from all measurements at once."""
BASE = {"method": FLEET}
"""The filter that is run with neighbours and without, with the noise as it is assumed."""
EVERY = (*FLEET_METHODS, *TRAINED)
LANDMARKS, NEIGHBOURS = (0, 1, 2, 4, 15), (0, 1, 2, 3, 4)
TRAINING_LANDMARKS, UNTIL_THINNED = (1, 4, 15), 30.0
"""Landmarks of the drives that noise is learned on, and s until they are thinned, a tenth of that part at most."""


@while_unchanged
def trained(data: str, until: float, evaluations: int) -> dict[str, tuple[list[Any], float]]:
    """Noise learned on the part that calibrates, by way, one for all or one for each vehicle, and bytes that a vehicle
    sends for it: federated its constants once and as many for the answer, centralised 4 B for each number that it
    measured in the plane. The centralised one is learned alone and together."""
    from coopoc.learned.pose_noise import PoseTask, averaged, fit_pose_noise  # torch, which a mistake need not wait for

    source = drives.source(data)
    alone = source.drive(until, near(0))
    steps, settled = (int(s / alone.recording.dt) for s in (until, min(UNTIL_THINNED, until / 10)))
    first, truth = alone.recording.between(0, steps), alone.truth.between(0, steps)  # type: ignore[union-attr]

    def fitted(egos: tuple[str, ...], *ends: int) -> Sensors:
        tasks = []
        for k in dict.fromkeys(ends):
            drive = source.drive(until, near(k))
            for landmarks in dict.fromkeys(min(n, source.landmarks) for n in TRAINING_LANDMARKS):
                part = thinned(drive.recording, landmarks, settled).between(0, steps)
                tasks.append(PoseTask(part, truth, egos, _filter(FLEET, k, drive), settled))
        return fit_pose_noise(tasks, first.sensors, evaluations)

    own, whole = [fitted((name,), 0) for name in alone.ids], fitted(alone.ids, *_ends(source.vehicles))
    mean, logs = averaged(own)
    who = [first.ids.index(name) for name in alone.ids]
    counted = np.isfinite(first.gnss[:, :, who, :2]).sum() + np.isfinite(first.relative[..., :2]).sum()
    sent = 4.0 * (2 * steps + float(counted) / len(who))
    return {ALONE: (own, 0.0), FEDERATED: ([mean], 8.0 * len(logs[0])), CENTRAL: ([whole], sent)}


def channel(p: Params) -> V2X:
    """The channel of a cell."""
    return near(p["max_neighbours"], p["loss"])


def key(p: Params) -> dict[str, str]:
    """Digests of the code and of the measurements.

    Raises:
        InputError: data or a setting that cannot be used, an unknown method.
    """
    one_of("method", p["method"], EVERY)
    source = drives.source(p["data"])
    source.check(drives.calibrated(p))
    channel(p), drives.block(p), drives.driven(p)
    whole("landmarks", p["landmarks"])
    return {"code": revision(*CODE), **source.digests}


def applies(p: Params) -> bool:
    """Whether the data has so many vehicles and landmarks, and the method needs what there is."""
    k, n, method, data = p["max_neighbours"], p["landmarks"], p["method"], p["data"]
    if not Path(split(data)[0]).exists():
        return True  # the key names what is wrong
    source = drives.source(data)
    fits = _distinct(k, NEIGHBOURS, source.vehicles - 1) and _distinct(n, LANDMARKS, source.landmarks)
    if method in TRAINED:
        taught = drives.calibrated(p) > 0 and source.posed
        return fits and taught and (k == 0 or (method == CENTRAL and k in _ends(source.vehicles)))
    return fits and not (k == 0 and method in DECENTRALISED)


def _ends(vehicles: int) -> tuple[int, int]:
    """The numbers of neighbours that noise is learned with."""
    return 0, min(max(NEIGHBOURS), vehicles - 1)


def cell(p: Params) -> list[Row]:
    """Rows of one number of neighbours and landmarks: a vehicle and a block of time each."""
    until = drives.calibrated(p)
    drive = drives.source(p["data"]).drive(until, channel(p))
    dt, (filters, once) = drive.recording.dt, _filters(p, drive)
    start, block = int(until / dt), max(int(drives.block(p) / dt), 1)
    recording = thinned(drive.recording, p["landmarks"], start)
    blocks = max((len(recording.t) - start) // block, 1)
    rows = []
    for who in [(name,) for name in drive.ids] if len(filters) > 1 else [drive.ids]:
        method = filters[drive.ids.index(who[0]) % len(filters)]
        track = method(recording, who)
        online = online_columns(track, recording, method)
        scores, truth = dict[str, Floats](), drive.truth  # column -> (T, E), as far as the truth is known
        if truth is not None:
            scores["rt_le_m"] = errors(track, truth)[0]
            if track.heading is not None and truth.heading is not None:
                scores["heading_deg"] = np.rad2deg(heading_error(track, truth)[0])
                scores["nees"] = pose_nees(track, truth)[0]
        innovation = np.linalg.norm(fix_innovations(track, recording)[0], axis=-1)
        if np.isfinite(innovation).any():
            scores["innovation_m"] = innovation
        finite = np.isfinite(next(iter(scores.values()), np.empty((0, len(who)))))[start : start + blocks * block]
        for ego, name in enumerate(who):  # as many blocks for each vehicle, of the steps at which it can be scored
            for run, scored in enumerate(np.array_split(start + np.flatnonzero(finite[:, ego]), blocks)):
                columns = {what: _reduced(what, score[scored, ego]) for what, score in scores.items()}
                if any(np.isfinite(value) for value in columns.values()):
                    columns["bytes_per_second"] = online["bytes_per_second"][0, ego]
                    columns["sent_bytes"] = once + online["sent_bytes_per_second"][0, ego] * drives.driven(p)
                    rows.append({"run": run, "ego": name, **columns})
    return rows


def _filters(p: Params, drive: Drive) -> tuple[list[PoseFilter], float]:
    """One filter for all vehicles or one for each, and bytes that a vehicle sent for its training."""
    name, constants, once = p["method"], list[Any]([None]), 0.0
    if name in TRAINED:
        constants, once = trained(p["data"], drives.calibrated(p), p["evaluations"])[name]
    made = _filter(FLEET if name in TRAINED else name, p["max_neighbours"], drive)
    return [replace(made, assumed=one) for one in constants], once


def _filter(name: str, k: int, drive: Drive) -> PoseFilter:
    options = drives.POSES[name if k else "pose-solo"]
    return PoseFilter(**options, lasting=drive.lasting, gate=GATE_STDS, begin=drive.begin, spread=drive.spread)


def _reduced(what: str, values: Floats) -> float:
    """Root mean square of errors, mean of a NEES; NaN of none."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return float("nan")
    return float(finite.mean()) if what == "nees" else float(np.sqrt((finite**2).mean()))


def _distinct(number: int, axis: tuple[int, ...], most: int) -> bool:
    """Whether a number is not above all that there are, or is the first of the usual ones that is."""
    return number <= most or (number in axis and all(other < most for other in axis if other < number))


COMPARED_LANDMARKS = 4
"""Landmarks whose number a finding compares with, at most."""
UNFIT = 100.0
"""Mean NEES of a pose that no drift explains: units, axes or noise are other ones."""


def _caption(results: Results, text: str) -> str:
    p = results.settings
    source = drives.source(p["data"])
    parts = [
        text,
        source.text().format(Path(split(p["data"])[0]).name, drives.calibrated(p)),
        "Poses are found with all landmarks; then they are thinned and the rest is scored."
        if source.landmarks
        else "There are no landmarks.",
        f"Intervals are over vehicles, then blocks of {drives.block(p):.3g} s.",
    ]
    if not source.posed:
        parts.append("No row is trained: that takes a truth with headings.")
    return " ".join(parts)


def _table(results: Results, value: str, text: str, **options: Any) -> Table | None:
    """A metric of all methods, by K and landmarks, and the bytes that a vehicle sends."""
    if present(results, {}, value) is None:
        return None
    numbers = across(partial(interval, value=value), _columns(results))
    texts = f"{text} {BYTES.format(drives.driven(results.settings))}"
    columns = {"Sent [B]": _sent, **numbers}
    return crossed(
        results, HEAD, _rows(results), columns, _caption(results, texts), notes=unused(results, True), **options
    )


HEAD = ("K", "Method")
BYTES = (
    "Bytes that a vehicle sends: online those on air on a drive of {:.4g} s; federated its learned constants once, and "
    "as many back; centralised 4 B for each number of the first part."
)


def _rows(results: Results) -> list[tuple[tuple[int, str], Where]]:
    ks = ran_at(results, "max_neighbours")
    return [((k, look(name).label), {"method": name, "max_neighbours": k}) for k in ks for name in EVERY]


def _columns(results: Results) -> dict[str, Where]:
    return {f"{words('landmarks')} = {n}": {"landmarks": n} for n in ran_at(results, "landmarks")}


def _sent(results: Results, where: Where) -> int | None:
    sent = mean(results, {"landmarks": ran_at(results, "landmarks")[-1], **where}, "sent_bytes")
    return None if sent is None else round(sent)


def _gains(results: Results) -> Table | None:
    """Paired differences of RT-LE from the filter with the same K and the noise as assumed."""
    rows = [row for row in _rows(results) if row[1]["method"] != BASE["method"]]
    text = f"RT-LE [m] less that of {look(BASE['method']).label} with the same K, paired."
    gaps = across(lambda rows, where: difference(rows, where, {**where, **BASE}), _columns(results))
    return crossed(results, HEAD, rows, gaps, _caption(results, text), decimals=3)


def _trade(results: Results) -> "Plot | None":
    """RT-LE over the bytes sent, a panel per number of landmarks; no bytes stand at the left."""
    from coopoc.study import figures

    base = BASE["method"]
    each = [where for _, where in _rows(results) if where["method"] in (base, *TRAINED) and present(results, where)]
    if all(where["method"] == base for where in each):
        return None

    def error(results: Results, where: Where) -> Any:
        at = {**each[where["at"]], "landmarks": where["landmarks"]}
        kind = 0 if at["method"] == base else 2 if at["max_neighbours"] else 1
        return interval(results, at) if kind == where["kind"] else None

    places = {max(_sent(results, where) or 0.0, 1.0 + 0.3 * i): {"at": i} for i, where in enumerate(each)}
    marks, ticks = (
        [n for n in ran_at(results, "landmarks") if n <= COMPARED_LANDMARKS],
        {1.0: "0", 1e2: "100", 1e4: "10 k", 1e6: "1 M"},
    )
    panels = [Panel(places, {"landmarks": n}, counted(n, "landmark"), "Sent [B]", ticks) for n in marks]
    looks = ("Cooperating", "#0072B2", "s"), ("Training", "#D55E00", "o"), ("Both", "#009E73", "D")
    lines = [
        {"kind": k, "label": label, "color": color, "marker": mark, "linestyle": "none"}
        for k, (label, color, mark) in enumerate(looks)
    ]
    text = f"RT-LE against the bytes that a vehicle sends; what sends none is at the left. {BYTES}"
    caption = _caption(results, text.format(drives.driven(results.settings)))
    return figures.curves(results, panels, lines, caption, error, log=True, logx=True)


def _findings(results: Results) -> list[str]:
    """What the cells show; a finding whose cells are missing is left out."""

    def of(k: int, n: int, value: str = "rt_le_m") -> float | None:
        return mean(results, {**BASE, "max_neighbours": k, "landmarks": n}, value)

    ks, marks = ran_at(results, "max_neighbours"), ran_at(results, "landmarks")
    if not ks:
        return []
    texts = []
    alone = ran({n: of(0, n) for n in marks})
    for k in dict.fromkeys((*ks[1:2], ks[-1])):
        together = of(k, 0)
        if not k or together is None or 0 not in alone:
            continue
        each = (f"with {counted(n, 'landmark')} {value:.3g} m" for n, value in alone.items())
        texts.append(f"K = {k} without a landmark: {together:.3g} m; alone {', '.join(each)}.")
    nees = list(ran({(k, n): of(k, n, "nees") for k in ks for n in marks}).values())
    if nees:
        doubt = " Units, axes or stated noise do not fit the drive: coopoc data check shows the residuals of each kind."
        texts.append(
            f"Mean NEES of a pose (3 is consistent): {np.mean(nees):.1f} over {len(nees)} cells, {max(nees):.1f} at "
            f"most.{doubt * (min(nees) > UNFIT)}"
        )
    return texts


STUDY = Study(
    "real",
    "With nothing simulated and headings estimated, when does a neighbour replace a landmark?",
    cell,
    {"method": EVERY, "max_neighbours": NEIGHBOURS, "landmarks": LANDMARKS},
    settings={"data": "mrclam-set6", "calibrate_s": None, "drive_s": None, "loss": 0.0, "evaluations": 150},
    key=key,
    where=applies,
    shares=("max_neighbours",),
    tables={
        "rt_le": partial(_table, value="rt_le_m", text="RT-LE [m].", decimals=3),
        "heading": partial(_table, value="heading_deg", text="Rms of the heading error [°].", decimals=1),
        "innovation": partial(_table, value="innovation_m", text="RMS innovation of the fixes [m]."),
        "nees": partial(_table, value="nees", text="NEES of a pose (3 is consistent).", decimals=1),
        "difference": _gains,
    },
    figures={"training": _trade},
    findings=_findings,
    limitations=(
        "The truth is used on the first part alone: noise, scales and lag of MR.CLAM's odometry are calibrated "
        "against Vicon, and noise is learned there.",
        "One drive: intervals over blocks of time do not extend to other vehicles or places.",
        "With one joint state a centre receives every measurement at its step; late messages are lost.",
    ),
)
