"""Real vehicles with nothing simulated: when does a neighbour replace a landmark, such as a road-side unit?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.arrays import Floats
from coopoc.data.source import split
from coopoc.errors import InputError
from coopoc.evaluate.ledger import of_track
from coopoc.evaluate.metrics import errors, fix_innovations, heading_error, pose_nees
from coopoc.learned.pose_noise import PoseTask, fit_pose_noise
from coopoc.methods.poses.pose_filter import PoseFilter
from coopoc.methods.track import Track
from coopoc.study.numbers import Where, across, difference, interval, mean, present, ran, sentence
from coopoc.study.provenance import revision
from coopoc.study.study import Params, Row, Study
from coopoc.study.style import Panel, look, words
from coopoc.study.tables import Table, crossed, pivot
from coopoc.world.sensors import Sensors
from coopoc.world.v2x import V2X

from . import pose_drives as drives
from .pose_drives import Drive, thinned
from .scene import CODE

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results

LEARNED = "pose-learned"
"""One state with the noise that is learned on the first part."""
METHODS: Mapping[str, Mapping[str, Any]] = {
    "pose-fleet": {},
    "pose-intersection": {"fusion": "intersection"},
    "pose-naive": {"fusion": "naive"},
    LEARNED: {},
}
LANDMARKS, NEIGHBOURS = (0, 1, 2, 4, 15), (0, 1, 2, 3, 4)
TRAINING, SETTLED = (1, 4, 15), 30.0
"""Landmarks of the drives that noise is learned on, and s until they are thinned, a tenth of that part at most."""


@lru_cache(maxsize=1)
def learned(data: str, until: float, gate: float, evaluations: int) -> Sensors:
    """Noise learned on the part that calibrates, alone and together, with few landmarks and with all."""
    vehicles, marks = drives.counts(data)
    tasks = []
    for k in dict.fromkeys((0, min(max(NEIGHBOURS), vehicles - 1))):
        drive = drives.drive(data, until, V2X(max_neighbours=k, radius=float("inf")), gate)
        assert drive.truth is not None
        steps, settled = (int(s / drive.recording.dt) for s in (until, min(SETTLED, until / 10)))
        method = _filter({}, k, gate, drive)
        for landmarks in dict.fromkeys(min(n, marks) for n in TRAINING):
            part = thinned(drive.recording, landmarks, settled).between(0, steps)
            tasks.append(PoseTask(part, drive.truth.between(0, steps), drive.ids, method, settled))
    return fit_pose_noise(tasks, drive.recording.sensors, evaluations)


def channel(p: Params) -> V2X:
    """The K nearest vehicles that were seen, and the losses of their messages."""
    return V2X(max_neighbours=int(p["max_neighbours"]), radius=float("inf"), loss=float(p["loss"]))


def key(p: Params) -> dict[str, str]:
    """Digests of the code and of the measurements.

    Raises:
        InputError: data or a part to calibrate on that cannot be used, an unknown method.
    """
    if p["method"] not in METHODS:
        raise InputError("method", p["method"], f"must be among {list(METHODS)}", "Name one of them.")
    drives.check(str(p["data"]), drives.calibrated(p), float(p["gate"]))
    channel(p)
    return {"code": revision(*CODE), **drives.digests(str(p["data"]))}


def applies(p: Params) -> bool:
    """Whether the data has so many vehicles and landmarks, and the method needs what there is."""
    k, n, method, data = int(p["max_neighbours"]), int(p["landmarks"]), p["method"], str(p["data"])
    if not Path(split(data)[0]).exists():
        return True  # the key names what is wrong
    vehicles, marks = drives.counts(data)
    if k == 0 and method not in ("pose-fleet", LEARNED):
        return False
    ends = (0, min(max(NEIGHBOURS), vehicles - 1))
    if method == LEARNED and not (k in ends and drives.has_true_poses(data) and drives.calibrated(p)):
        return False
    return _distinct(k, NEIGHBOURS, vehicles - 1) and _distinct(n, LANDMARKS, marks)


def cell(p: Params) -> list[Row]:
    """Rows of one number of neighbours and landmarks: a vehicle and a block of time each."""
    data, until, gate, drive = str(p["data"]), drives.calibrated(p), float(p["gate"]), _drive(p)
    dt = drive.recording.dt
    start, block = int(until / dt), max(int(drives.block(p) / dt), 1)
    method = _filter(METHODS[p["method"]], int(p["max_neighbours"]), gate, drive)
    if p["method"] == LEARNED:
        method = replace(method, assumed=learned(data, until, gate, int(p["evaluations"])))
    recording = thinned(drive.recording, int(p["landmarks"]), start)
    track = method(recording, drive.ids)
    account = of_track(track, recording, method.message)
    sent, received = (account.of("online", "on air", way) / account.seconds for way in ("broadcast", "per receiver"))
    scores = _scores(track, drive)
    rows: list[Row] = []
    for ego, name in enumerate(drive.ids):
        for number, first in enumerate(range(start, len(recording.t) - block + 1, block)):
            values = {what: _reduced(what, score[first : first + block, ego]) for what, score in scores.items()}
            if any(np.isfinite(value) for value in values.values()):
                values["bytes_per_second"] = float(received[0, ego])
                values["sent_bytes_per_second"] = float(sent[0, ego])
                rows.append({"run": number, "ego": name, **values})
    return rows


def _drive(p: Params) -> Drive:
    return drives.drive(str(p["data"]), drives.calibrated(p), channel(p), float(p["gate"]))


def _filter(fusion: Mapping[str, Any], k: int, gate: float, drive: Drive) -> PoseFilter:
    unit: Any = "fleet" if k else "solo"
    return PoseFilter(
        unit, **(fusion if k else {}), lasting=drive.lasting, gate=gate, begin=drive.begin, spread=drive.spread
    )


def _scores(track: Track, drive: Drive) -> dict[str, Floats]:
    """Column -> (T, E) against the truth, as far as it is known, and innovations of the fixes, if there are any."""
    scores = {}
    if drive.truth is not None:
        scores["rt_le_m"] = errors(track, drive.truth)[0]
        if drive.truth.heading is not None:
            scores["heading_deg"] = np.rad2deg(heading_error(track, drive.truth)[0])
            scores["nees"] = pose_nees(track, drive.truth)[0]
    innovation = np.linalg.norm(fix_innovations(track, drive.recording)[0], axis=-1)
    return scores | ({"innovation_m": innovation} if np.isfinite(innovation).any() else {})


def _reduced(what: str, values: Floats) -> float:
    """Root mean square of errors, mean of a NEES; NaN of none."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return float("nan")
    return float(finite.mean()) if what == "nees" else float(np.sqrt((finite**2).mean()))


def _distinct(number: int, axis: tuple[int, ...], most: int) -> bool:
    """Whether a number is not above all that there are, or is the first of the usual ones that is."""
    return number <= most or (number in axis and all(other < most for other in axis if other < number))


FLEET = {"method": "pose-fleet"}
FEW = 4
"""Landmarks whose number a finding compares with, at most."""
UNFIT = 100.0
"""Mean NEES of a pose that no drift explains: units, axes or noise are other ones."""


def _caption(results: Results, text: str) -> str:
    p = results.settings
    data = str(p["data"])
    marks = drives.counts(data)[1]
    parts = [text, drives.described(data).format(Path(split(data)[0]).name, drives.calibrated(p))]
    thinned = "Poses are found with all landmarks; then they are thinned and the rest is scored."
    parts.append(thinned if marks else "There are no landmarks.")
    parts.append(f"Intervals are over vehicles, then blocks of {drives.block(p):.3g} s.")
    if 0 < marks < max(LANDMARKS):
        parts.append(f"A number of landmarks above {marks} is all that there are.")
    return " ".join(parts)


def _numbers(results: Results) -> tuple[list[int], list[int]]:
    """The numbers of neighbours and of landmarks that were run with one state; none without."""
    rows = results.frame[results.frame["method"] == "pose-fleet"] if "method" in results.frame else results.frame
    axes = ("max_neighbours", "landmarks")
    ks, marks = (sorted(rows[axis].unique().tolist()) if axis in rows else [] for axis in axes)
    return ks, marks


def _table(results: Results, value: str, text: str, **options: Any) -> Table | None:
    """A metric of one state, by K and landmarks."""
    if present(results, FLEET, value) is None:
        return None
    return pivot(results, "max_neighbours", "landmarks", value, FLEET, _caption(results, text), best=None, **options)


def _fusions(results: Results, value: str, text: str, **options: Any) -> Table | None:
    """A metric of the ways of fusion at the largest K, by landmarks."""
    where = {"max_neighbours": max(_numbers(results)[0], default=0)}
    if not where["max_neighbours"] or present(results, where, value) is None:
        return None
    text = f"{text}, K = {where['max_neighbours']}."
    return pivot(results, "method", "landmarks", value, where, _caption(results, text), **options)


def _gap(results: Results, where: Where) -> Any:
    return difference(results, {**where, "method": LEARNED}, where)


def _learned(results: Results) -> Table | None:
    """RT-LE with the calibrated and the learned noise, their paired difference, and both NEES."""
    ks, marks = _numbers(results)
    rows = [((k, n), {**FLEET, "max_neighbours": k, "landmarks": n}) for k in ks for n in marks]
    rows = [row for row in rows if present(results, {**row[1], "method": LEARNED})]
    columns = {
        **across(mean, {"As assumed": FLEET, "Learned": {"method": LEARNED}}),
        "Difference": _gap,
        **across(partial(mean, value="nees"), {"NEES": FLEET, "NEES, learned": {"method": LEARNED}}),
    }
    text = "RT-LE [m] with the noise above, and with noise learned by the log score of the poses on the first part."
    return crossed(results, ("K", "Landmarks"), rows, columns, _caption(results, text), decimals=3) if rows else None


def _bytes(results: Results) -> Table | None:
    """What a robot sends and receives, by K and way of fusion, with all landmarks."""
    ks, marks = _numbers(results)
    rows = [
        ((look(name).label, k), {"method": name, "max_neighbours": k, "landmarks": marks[-1]})
        for name in METHODS
        for k in ks
        if k and name != LEARNED
    ]
    received = partial(mean, value="bytes_per_second")
    columns = {"Sent [B/s]": partial(mean, value="sent_bytes_per_second"), "Received [B/s]": received}
    text = "Bytes per robot with all landmarks; one state sends to a centre and receives its own pose."
    return crossed(results, ("Method", "K"), rows, columns, _caption(results, text), decimals=0) if rows else None


def _figure(results: Results) -> Plot | None:
    """Over the landmarks, a line per K and, at the largest, per way of fusion; where their number is one, over K."""
    from matplotlib import colormaps

    from coopoc.study import figures

    ks, marks = _numbers(results)
    if len(ks) < 2 and len(marks) < 2:
        return None
    x, values = ("landmarks", marks) if len(marks) > 1 else ("max_neighbours", ks)
    places = {float(np.log1p(value)): {x: value} for value in values}
    ticks = {place: str(also[x]) for place, also in places.items()}
    fusion: list[Where] = [{"method": name, "label": look(name).label} for name in METHODS if name != LEARNED]
    lines: list[Where] = []
    if x == "landmarks":
        colors = {k: colormaps["viridis"](k / 4.6) for k in ks}
        lines = [{**FLEET, "max_neighbours": k, "label": f"One state, K = {k}", "color": colors[k]} for k in ks]
        fusion = [{**line, "max_neighbours": ks[-1]} for line in fusion[1:]] if ks[-1] else []
    panel = Panel(places, xlabel=words(x), ticks=ticks)
    text = f"RT-LE against {words(x)}; the ways of fusion at K = {ks[-1]}; bands: 95 % intervals."
    caption = _caption(results, text)
    return figures.curves(results, [panel], [*lines, *fusion], caption, number=interval, width=6.6, log=True)


def _findings(results: Results) -> dict[str, str]:
    """Key and sentence of what the cells show; a finding whose cells are missing is left out."""

    def of(k: int, n: int, value: str = "rt_le_m") -> float | None:
        return mean(results, {**FLEET, "max_neighbours": k, "landmarks": n}, value)

    ks, marks = _numbers(results)
    if not ks:
        return {}
    texts = {}
    alone = ran({n: of(0, n) for n in marks})
    for k in dict.fromkeys((*ks[1:2], ks[-1])):
        together = of(k, 0)
        if not k or together is None or 0 not in alone:
            continue
        few = max((n for n in alone if 0 < n <= FEW), default=0)
        text = f"K = {k} without a landmark: {together:.2f} m; alone {alone[0]:.2f} m"
        text += f", with {_landmarks(few)} {alone[few]:.2f} m." if few else "."
        better = [n for n, value in alone.items() if value < together]
        worth = f"It replaces fewer than {_landmarks(min(better))}." if better else "It replaces more than all of them."
        texts[f"worth, K = {k}"] = text if len(alone) == 1 else f"{text} {worth}"
    if len(marks) > 1 and ks[-1]:
        template = f"With {_landmarks(marks[-1])}: alone {{alone:.3f}} m, K = {ks[-1]} {{together:.3f}} m."
        texts["all landmarks"] = sentence(template, alone=of(0, marks[-1]), together=of(ks[-1], marks[-1]))
    if len(alone) == len(ks) == 1:
        texts["alone"] = f"One vehicle alone: {next(iter(alone.values())):.3g} m."
    nees = list(ran({(k, n): of(k, n, "nees") for k in ks for n in marks}).values())
    if nees:
        inside = sum(2 <= value <= 5 for value in nees)
        text = f"Mean NEES of a pose (3 is consistent): {np.mean(nees):.1f}"
        more = f" over {len(nees)} cells, {inside} of them in 2..5, the largest {max(nees):.1f}"
        texts["nees"] = text + (more if len(nees) > 1 else "") + "."
        if min(nees) > UNFIT:
            doubt = "Units, axes or stated noise do not fit the drive"
            texts["nees"] += f" {doubt}: coopoc data check shows the residuals of each kind."
    return texts


def _landmarks(number: int) -> str:
    return "1 landmark" if number == 1 else f"{number} landmarks"


STUDY = Study(
    "real",
    "With nothing simulated and headings estimated, when does a neighbour replace a landmark?",
    cell,
    {"method": tuple(METHODS), "max_neighbours": NEIGHBOURS, "landmarks": LANDMARKS},
    settings={
        "data": "MRCLAM_Dataset6",
        "calibrate_s": None,
        "block_s": None,
        "gate": 5.0,
        "loss": 0.0,
        "evaluations": 150,
    },
    key=key,
    where=applies,
    shares=("max_neighbours",),
    tables={
        "rt_le": partial(_table, value="rt_le_m", text="RT-LE [m], K neighbours against landmarks.", decimals=3),
        "heading": partial(_table, value="heading_deg", text="Rms of the heading error [°].", decimals=1),
        "innovation": partial(
            _table,
            value="innovation_m",
            text="RMS innovation of the fixes [m]: how well the pose before predicts a fix.",
        ),
        "nees": partial(_table, value="nees", text="NEES of a pose (3 is consistent).", decimals=1),
        "bytes": _bytes,
        "learned": _learned,
        "fusion": partial(_fusions, value="rt_le_m", text="RT-LE [m] of the ways of fusion", decimals=3),
    },
    figures={"rt_le": _figure},
    findings=_findings,
    limitations=(
        "The truth is used on the first part alone: noise, scales and lag of MR.CLAM's odometry are calibrated "
        "against Vicon, and noise is learned there.",
        "One drive: intervals over blocks of time do not extend to other vehicles or places.",
        "With one joint state a centre receives every measurement at its step; late messages are lost.",
    ),
    minutes=3,
)
