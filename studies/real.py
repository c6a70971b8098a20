"""Real robots with nothing simulated: when does a neighbour replace a landmark, such as a road-side unit?"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.arrays import Floats
from coopoc.data.mrclam import MrclamLog, read_mrclam
from coopoc.data.mrclam_calibration import Calibration, calibrate
from coopoc.data.mrclam_poses import pose_recording, surveyed, thinned
from coopoc.errors import InputError
from coopoc.evaluate.ledger import of_track
from coopoc.evaluate.metrics import errors
from coopoc.evaluate.pose_metrics import heading_error, pose_nees
from coopoc.methods.pose_filter import PoseFilter
from coopoc.methods.pose_start import pose_start
from coopoc.study.environment import revision
from coopoc.study.numbers import Number, interval, mean, present, sentence
from coopoc.study.pivot import crossed, pivot
from coopoc.study.study import Params, Row, Study
from coopoc.study.style import look
from coopoc.world.recording import Recording
from coopoc.world.v2x import V2X

from .scene import CODE

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

METHODS: Mapping[str, Mapping[str, Any]] = {
    "pose-fleet": {},
    "pose-intersection": {"fusion": "intersection"},
    "pose-naive": {"fusion": "naive"},
}
LANDMARKS, NEIGHBOURS = (0, 1, 2, 4, 15), (0, 1, 2, 3, 4)
FLEET = {"method": "pose-fleet"}
NOTE = (
    "Wheel odometry, ranges and bearings of {data}; no fix, no compass. Noise is calibrated and poses are found in the "
    "first {calibrate_s:g} s, with all landmarks; then the landmarks are thinned and the rest is scored. Intervals are "
    "over robots, then blocks of {block_s:g} s."
)


@lru_cache(maxsize=2)
def log(data: str, until: float) -> tuple[MrclamLog, Calibration]:
    """A folder of MR.CLAM and its calibration."""
    found = read_mrclam(Path(data))
    return found, calibrate(found, until)


@lru_cache(maxsize=2)
def seen(data: str, until: float, v2x: V2X, gate: float) -> tuple[Recording, Floats]:
    """All that the robots measured, and their first poses."""
    recording = pose_recording(log(data, until)[0], v2x, log(data, until)[1])
    return recording, pose_start(recording, gate=gate)


def channel(p: Params) -> V2X:
    """The K nearest robots that were seen, and the losses of their messages."""
    return V2X(max_neighbours=int(p["max_neighbours"]), radius=float("inf"), loss=float(p["loss"]))


def key(p: Params) -> dict[str, str]:
    """Digests of the code and of the log.

    Raises:
        InputError: a folder or a part to calibrate on that cannot be used, an unknown method.
    """
    if p["method"] not in METHODS:
        raise InputError("method", p["method"], f"must be among {list(METHODS)}", "Name one of them.")
    found, _ = log(str(p["data"]), float(p["calibrate_s"]))
    surveyed(found), channel(p)
    sha = hashlib.sha256()
    for file in sorted(Path(str(p["data"])).glob("*.dat")):
        sha.update(file.name.encode() + file.read_bytes())
    return {"code": revision(*CODE), "log": sha.hexdigest()}


def cell(p: Params) -> list[Row]:
    """Rows of one number of neighbours and landmarks: a robot and a block of time each."""
    data, until, gate = str(p["data"]), float(p["calibrate_s"]), float(p["gate"])
    whole, begin = seen(data, until, channel(p), gate)
    fleet = log(data, until)[0].fleet
    start, block = int(until / fleet.dt), max(int(float(p["block_s"]) / fleet.dt), 1)
    unit: Any = "fleet" if p["max_neighbours"] else "solo"
    how = METHODS[p["method"]] if p["max_neighbours"] else {}
    method = PoseFilter(unit, **how, lasting=True, gate=gate, begin=begin)
    recording = thinned(whole, int(p["landmarks"]), start)
    track = method(recording, fleet.ids)
    account = of_track(track, recording, method.message)
    sent, received = (account.of("online", "on air", way) / account.seconds for way in ("broadcast", "per receiver"))
    position, heading, nees = errors(track, fleet)[0], heading_error(track, fleet)[0], pose_nees(track, fleet)[0]
    rows: list[Row] = []
    for ego, name in enumerate(fleet.ids):
        for number, first in enumerate(range(start, len(fleet.t) - block + 1, block)):
            part = slice(first, first + block), ego
            if np.isfinite(position[part]).any():
                found = {"rt_le_m": _rms(position[part]), "heading_deg": float(np.rad2deg(_rms(heading[part])))}
                found |= {"nees": float(np.nanmean(nees[part])), "bytes_per_second": float(received[0, ego])}
                found["sent_bytes_per_second"] = float(sent[0, ego])
                rows.append({"run": number, "ego": name, **found})
    return rows


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _grid() -> list[dict[str, Any]]:
    cases = [(method, k, n) for method in METHODS for k in NEIGHBOURS for n in LANDMARKS if k or method == "pose-fleet"]
    return [{"method": method, "max_neighbours": k, "landmarks": n} for method, k, n in cases]


def _caption(results: Results, text: str) -> str:
    given = {**results.settings, "data": Path(str(results.settings["data"])).name}
    return f"{text} {NOTE.format(**given)}"


def _table(results: Results, value: str, text: str, **options: Any) -> Table | None:
    if present(results, FLEET, value) is None:
        return None
    return pivot(results, "max_neighbours", "landmarks", value, FLEET, _caption(results, text), best=None, **options)


def _fusions(results: Results, value: str, text: str, **options: Any) -> Table | None:
    where = {"max_neighbours": max(NEIGHBOURS)}
    if present(results, where, value) is None:
        return None
    return pivot(results, "method", "landmarks", value, where, _caption(results, text), **options)


def _bytes(results: Results) -> Table | None:
    """What a robot sends and receives, by K and way of fusion, with all landmarks."""
    rows = [
        ((look(name).label, k), {"method": name, "max_neighbours": k, "landmarks": max(LANDMARKS)})
        for name in METHODS
        for k in NEIGHBOURS[1:]
    ]
    columns: list[tuple[str, Number]] = [
        ("Sent [B/s]", partial(mean, value="sent_bytes_per_second")),
        ("Received [B/s]", partial(mean, value="bytes_per_second")),
    ]
    text = "Bytes per robot with all landmarks; one state sends to a centre and receives its own pose."
    return crossed(results, ("Method", "K"), rows, columns, _caption(results, text), best=None, decimals=0)


def _figure(results: Results) -> Plot | None:
    """Left: a line per number of neighbours over the landmarks. Right: the ways of fusion at the largest K."""
    from matplotlib import colormaps

    from coopoc.study.plot import Plot, canvas, plain_log

    if present(results, FLEET) is None:
        return None
    at = {n: place for place, n in enumerate(LANDMARKS)}
    with canvas(1, 2, width=6.6, sharey=True) as (figure, (left, right)):
        lines = [(f"K = {k}", {**FLEET, "max_neighbours": k}, colormaps["viridis"](k / 4.6)) for k in NEIGHBOURS]
        most = {"max_neighbours": max(NEIGHBOURS)}
        others = [(look(name).label, {"method": name, **most}, look(name).color) for name in METHODS]
        for axis, shown in ((left, lines), (right, others)):
            for label, where, color in shown:
                each = {n: interval(results, {**where, "landmarks": n}) for n in LANDMARKS}
                ran = {at[n]: value for n, value in each.items() if value is not None}
                if ran:
                    axis.plot(list(ran), [one.mean for one in ran.values()], color=color, label=label, marker="o")
                    ends = [one.low for one in ran.values()], [one.high for one in ran.values()]
                    axis.fill_between(list(ran), *ends, alpha=0.12, color=color, linewidth=0)
            axis.set(xticks=list(at.values()), xticklabels=list(at), xlabel="Landmarks", yscale="log")
            plain_log(axis.yaxis)
            axis.legend()
        left.set(ylabel="RT-LE [m]", title="One state, K neighbours")
        right.set(title=f"Ways of fusion, K = {max(NEIGHBOURS)}")
    return Plot(figure, _caption(results, "RT-LE against the number of landmarks; bands: 95 % intervals."))


def _findings(results: Results) -> dict[str, str]:
    def of(k: int, n: int, value: str = "rt_le_m") -> float | None:
        return mean(results, {**FLEET, "max_neighbours": k, "landmarks": n}, value)

    found = {}
    for k in (1, 4):
        together = of(k, 0)
        alone = {n: of(0, n) for n in LANDMARKS}
        better = [n for n, value in alone.items() if together is not None and value is not None and value < together]
        worth = f"fewer than {min(better)} landmarks" if better else "more than all of them"
        template = "K = {k} without a landmark: {together:.2f} m; alone {none:.2f} m, with 4 landmarks {four:.2f} m."
        text = sentence(template, k=k, together=together, none=alone[0], four=alone[4])
        found[f"worth, K = {k}"] = text and f"{text} It replaces {worth}."
    best = {"alone": of(0, 15), "together": of(4, 15)}
    found["all landmarks"] = sentence("With 15 landmarks: alone {alone:.3f} m, K = 4 {together:.3f} m.", **best)
    nees = [of(k, n, "nees") for k in NEIGHBOURS for n in LANDMARKS]
    values = [value for value in nees if value is not None]
    if values:
        inside = sum(2 <= value <= 5 for value in values)
        text = f"Mean NEES of a pose (3 is consistent): {np.mean(values):.1f} over {len(values)} cells"
        found["nees"] = f"{text}, {inside} of them in 2..5, the largest {max(values):.1f}."
    return found


STUDY = Study(
    "real",
    "With nothing simulated and headings estimated, when does a neighbour replace a landmark?",
    cell,
    _grid(),
    settings={"data": "MRCLAM_Dataset6", "calibrate_s": 300.0, "block_s": 30.0, "gate": 5.0, "loss": 0.0},
    key=key,
    shares=("max_neighbours",),
    tables={
        "rt_le": partial(_table, value="rt_le_m", text="RT-LE [m], K neighbours against landmarks.", decimals=3),
        "heading": partial(_table, value="heading_deg", text="Rms of the heading error [°].", decimals=1),
        "nees": partial(_table, value="nees", text="NEES of a pose (3 is consistent).", decimals=1),
        "bytes": _bytes,
        "fusion": partial(_fusions, value="rt_le_m", text="RT-LE [m] of the ways of fusion, K = 4.", decimals=3),
        "fusion_nees": partial(_fusions, value="nees", text="NEES, K = 4.", best=None, decimals=1),
    },
    figures={"rt_le": _figure},
    findings=_findings,
    limitations=(
        "Noise, scales and lag of odometry are calibrated against Vicon on the first part, the only use of truth.",
        "One drive: an interval over blocks of time does not hold for other robots or rooms.",
        "With one state a centre receives all that is measured, at its step; late messages are lost.",
    ),
    minutes=1,
)
