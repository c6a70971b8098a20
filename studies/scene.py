"""The scene of a cell: which fleet drives, under which sensors and channel, and which vehicles are scored."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from coopoc import V2X, Fleet, InputError, Outliers, Recording, Sensors, observe
from coopoc.arrays import Bools, one_of, runs_in_memory, seed_of
from coopoc.data.source import split, there, while_unchanged
from coopoc.study.cell import Params
from coopoc.study.provenance import revision
from coopoc.world.channels import channel as channel_of
from coopoc.world.spoofing import Spoofing, spoofed
from coopoc.world.storage import digest

if TYPE_CHECKING:
    from coopoc import Results
    from coopoc.data.log.read import Log

Start = Literal["gnss", "true"]
CODE = tuple(f"coopoc.{part}" for part in ("world", "methods", "kernels", "optimize", "evaluate", "learned", "data"))
"""The packages whose code makes the numbers of a cell, beside the cell's own."""
DRAWN = {"data": "town10", "egos": "auto", "seed": 0}
WEIGHTS = {"clients": "town10-clients", "weights": "runs/weights"}
SOLO = {"velocity_reading": "axis", "start": "gnss"}
TOWN = {**DRAWN, "scenario": 2, "velocity_ratio": 0.15, "velocity_reading": "axis", "radius_m": 30.0}
"""Settings that studies share: draws; training; filters without neighbours; draws of scenario 2 with neighbours."""


@while_unchanged
def fleet(data: str) -> Fleet:
    """The fleet of a bundled name or a path: of a log its truth, NaN where it is unknown."""
    log = _log(data)
    if log is None:
        from coopoc.data.registry import load_fleet

        return load_fleet(data)
    measurements = log.recording
    nothing = np.full_like(measurements.gnss[0], np.nan)
    return log.truth or Fleet(
        measurements.ids, measurements.t, nothing, nothing, name=Path(data).stem, source="a log without truth"
    )


@while_unchanged
def _log(data: str) -> "Log | None":
    """The log of a name or a path that holds one; None for anything else.

    Raises:
        InputError: one in body frames.
    """
    there(split(data)[0])
    from coopoc.data.registry import LOGS, kind_of, read_log  # pandas, which a mistake need not wait for

    if kind_of(data) not in LOGS:
        return None
    log = read_log(data)
    if log.recording.body is not None:
        hint = f"Take coopoc run real --data {data!r}, whose filters estimate headings."
        raise InputError("data", repr(data), "is a log in body frames, and methods here follow positions", hint)
    return log


def is_real(data: str) -> bool:
    """True for data that holds real measurements between vehicles, which are not simulated."""
    return _log(data) is not None


@while_unchanged
def measured(data: str) -> Recording | None:
    """One run of real data with all that its vehicles measured of each other; None where that is simulated."""
    everyone = V2X(len(fleet(data).ids), radius=float("inf"))
    return _recording(data, Sensors(), everyone, 1, 0, None, False) if is_real(data) else None


def egos(p: Params) -> tuple[str, ...]:
    """Ids of the egos of a cell: a number of vehicles evenly spaced over those present throughout, or ids joined by
    "+", or by "," where none holds one.

    "auto" is five of them, or all where there are fewer. Where not enough are present throughout, they are taken from
    all that are there at two steps in a row; `presence` scores them where they are.

    >>> egos({"data": "town10", "egos": 3})
    ('town10-00', 'town10-20', 'town10-40')
    """
    wanted, drive = str(p["egos"]), fleet(p["data"])
    if wanted in drive.ids:
        return (wanted,)
    if wanted != "auto" and not wanted.isdigit():
        return tuple(drive.ids[drive.index(i.strip())] for i in wanted.split("+" if "+" in wanted else ","))
    there, ids = _there(p["data"]), np.array(drive.ids)
    chosen = ids[there.all(0)]
    if len(chosen) < (1 if wanted == "auto" else int(wanted)):
        chosen = ids[(there[1:] & there[:-1]).any(0)]
    count = min(5, len(chosen)) if wanted == "auto" else int(wanted)
    if not 1 <= count <= len(chosen):
        allowed = f"must be a number of vehicles, 1..{len(chosen)}, or their ids"
        raise InputError("egos", wanted, allowed, "Join ids by +.")
    return tuple(chosen[np.arange(count) * len(chosen) // count].tolist())


def _there(data: str) -> Bools:
    """(T, N) where vehicles may be followed: of a log where it has odometry and, if there is a truth, that, too."""
    log = _log(data)
    if log is None:
        return fleet(data).present
    there: Bools = log.recording.present & np.maximum.accumulate(np.isfinite(log.recording.gnss[0, :, :, 0]), axis=0)
    standing = (np.nan_to_num(log.recording.velocity[0]) == 0).all(axis=(0, 2))
    if not standing.all():
        there &= ~standing  # a road-side unit knows where it is
    return there if log.truth is None else there & log.truth.present


LASTING_SHARES = ("own_share", "common_share")
"""Parameters: shares of a fix's variance that are time-correlated, of each receiver and common to all."""


def sensors(p: Params) -> Sensors:
    """Noise of scenario 1 or 2 of the paper, or of its training (0), with the velocity noise of the cell."""
    presets = {0: Sensors.paper_training, 1: Sensors.paper_scenario1, 2: Sensors.paper_scenario2}
    if p["scenario"] not in presets:
        raise InputError("scenario", p["scenario"], "must be 0, 1 or 2", "0: training; see section IV of the paper.")
    get = p.get
    noise = lasting(presets[p["scenario"]](), *(get(name, 0.0) for name in LASTING_SHARES))
    return replace(
        noise,
        velocity_std_ratio=p["velocity_ratio"],
        velocity_reading=p["velocity_reading"],
        gnss_drift_time=get("drift_time_s", noise.gnss_drift_time),
        heading_std=np.deg2rad(get("heading_std_deg", 0.0)),
        heading_bias_std=np.deg2rad(get("heading_bias_deg", 0.0)),
        outliers=Outliers.named(p["outliers"]) if get("outliers") else None,
    )


def lasting(noise: Sensors, own: float, common: float) -> Sensors:
    """The same variance of a fix, alike on all axes, of which shares are time-correlated: `own` and `common`.

    >>> lasting(Sensors(), 0.36, 0.0).gnss_drift_std.__round__(3)
    0.9
    """
    if not (own >= 0 and common >= 0 and own + common < 1):
        raise InputError(
            ", ".join(LASTING_SHARES), (own, common), "must be >= 0 and below 1 together", "0.5 is half of it."
        )
    white, drift, shared = (noise.gnss_std[0] * float(np.sqrt(share)) for share in (1.0 - own - common, own, common))
    return replace(noise, gnss_std=(white,) * 3, gnss_drift_std=drift, gnss_common_std=shared)


def start(p: Params) -> Start:
    """Start of the filters of a cell: "gnss", the first fix, unless it names "true", the true position."""
    begin: Start = p.get("start", "gnss")
    one_of("start", begin, Start)
    return begin


def heading(p: Params) -> str:
    """Data, noise and start of a cell in a few words, for findings."""
    begin = "start at the " + ("first fix" if start(p) == "gnss" else "true position")
    if is_real(p["data"]):
        trained = f"trained with velocity noise per {p['velocity_reading']}, " if p.get("train_seeds") else ""
        return f"Real data, {trained}{begin}"
    noise = sensors(p)
    low, high = noise.gnss_bias
    bias = f", bias U[{low:g}, {high:g}] m per run and axis" if high else ""
    between = f"range {noise.range_std:.2g} m, angles {np.rad2deg(noise.azimuth_std):.2g}°"
    near = f", {between}, radius {channel(p).radius:g} m" if "radius_m" in p else ""
    wrong = "".join(f", {note}" for note in noise.outliers.notes) if noise.outliers else ""
    return (
        f"Scenario {p['scenario']}: GNSS {noise.fix_std[0]:.3g} m per axis{bias}, velocity "
        f"{100 * noise.velocity_std_ratio:g} % (per {p['velocity_reading']}){near}{wrong}, {begin}"
    )


def conditions(p: Params) -> str:
    """Heading and size of a cell, for captions; of real data whose they are."""
    real = measured(p["data"])
    labels = f" ({real.notes[0]})" if real is not None and real.notes else ""
    log = _log(p["data"])
    runs = log.recording.runs if log is not None and (log.messages or not channel(p).loss) else p["runs"]
    name, there = Path(split(p["data"])[0]).name, _there(p["data"]).any(0).sum()
    size = f"{counted(runs, 'run')}, {counted(len(egos(p)), 'ego')} of {name} ({counted(there, 'vehicle')})"
    trained = f", {counted(p['train_seeds'], 'training seed')}" if p["train_seeds"] else ""
    return f"{heading(p)}{labels}; {size}{trained}."


SIMULATED = (
    "scenario",
    "velocity_ratio",
    "drift_time_s",
    "heading_std_deg",
    "heading_bias_deg",
    "outliers",
    *LASTING_SHARES,
)
"""Settings of simulated noise, which a log has of its own."""
TRAINING_SETTINGS = ("clients", "weights", "train_seeds", "velocity_reading")


def idle(results: "Results") -> set[str]:
    """Settings that do nothing in these results: of noise where it was measured, of training where there was none, and
    those that are off."""
    p = results.settings
    zeros = {n for n, value in p.items() if value == 0 and type(value) in (bool, float) and n not in CHANNEL}
    off = {n for n, value in p.items() if value in ("", None)} | zeros
    trained = {"trained", "fitted"} & {*results.frame.get("noise_model", ["trained"])}
    drawn = ("seed", "runs", *SIMULATED) if is_real(p["data"]) else ()
    return off | set(drawn) | set(() if trained else TRAINING_SETTINGS)


def caption(results: "Results", *texts: str, **at: Any) -> str:
    """The texts, which may name settings in braces, and the conditions of the study, or of the selection `at` of it."""
    frame, p = results.frame, dict(results.settings)
    if not ("train_seed" in frame and frame["train_seed"].notna().any()):
        p["train_seeds"] = 0
    p |= at
    return " ".join([*(text.format(**p) for text in texts), conditions(p)])


def counted(number: int, noun: str) -> str:
    """A number of things in words.

    >>> counted(1, "run"), counted(0, "ego")
    ('1 run', '0 egos')
    """
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


CHANNEL = {
    "radius_m": "radius",
    "rate_hz": "rate",
    "cap_bytes_per_second": "bytes_per_second",
    "loss": "loss",
    "burst": "burst",
    "latency_s": "latency",
    "schedule": "schedule",
}
"""Settings of a channel -> fields of V2X; None is the channel's own, and 0 is 0."""


def channel(p: Params) -> V2X:
    """Neighbourhood and budget of the cell, ideal where it names nothing else; the radius of a log has no limit."""
    usual = channel_of(p.get("channel", "ideal"), p.get("max_neighbours", 0))
    if p.get("radius_m", 30.0) is None and is_real(p["data"]):
        usual = replace(usual, radius=float("inf"))
    return replace(usual, **{field: p[name] for name, field in CHANNEL.items() if p.get(name) is not None})


def facts(p: Params) -> Mapping[str, str]:
    """Digests that change the numbers beyond a cell's parameters: of its data and of all code.

    Raises:
        InputError: parameters that no cell can be computed with.
    """
    sensors(p), attacking(p), start(p), egos(p)
    runs_in_memory(p.get("runs", 1), 8 * fleet(p["data"]).present.size)
    seed_of(p.get("seed", 0))
    return {"code": revision(*CODE), "channel": repr(channel(p)), **_digests(p["data"])}


@while_unchanged
def _digests(data: str) -> Mapping[str, str]:
    log = _log(data)
    measurements = {} if log is None else {"recording": digest(log.recording)}
    return {"fleet": fleet(data).digest, **measurements}


def recording(p: Params, remove_outliers: bool = False) -> Recording:
    """Recording of the cell's vehicles; the real measurements where there are any.

    Args:
        p: parameters of the cell.
        remove_outliers: leave out outliers and false fixes, as an estimator that knows of them would.
    """
    from coopoc.methods.catalogue import needs_whole_fleet

    who, attack = egos(p), attacking(p)
    observers = None if needs_whole_fleet(p.get("method", "")) else who
    drawn = _recording(p["data"], sensors(p), channel(p), p["runs"], p["seed"], observers, remove_outliers)
    return spoofed(drawn, attack, seed=p["seed"], honest=who, remove_outliers=remove_outliers) if attack else drawn


def attacking(p: Params) -> Spoofing | None:
    """The attack of the cell, if there is one."""
    if not (share := p.get("spoofed_share", 0.0)):
        return None
    return Spoofing(share, start=p.get("spoofed_from_s", 0.0), collude=p.get("spoofed_collude", False))


def trial(p: Params) -> tuple[Recording, tuple[str, ...], Fleet]:
    """Recording, egos and fleet of a cell."""
    return recording(p), egos(p), fleet(p["data"])


@while_unchanged
def _recording(
    data: str, noise: Sensors, v2x: V2X, runs: int, seed: int, observers: tuple[str, ...] | None, remove_outliers: bool
) -> Recording:
    if (log := _log(data)) is not None:
        from coopoc.data.log.links import under

        return under(log.recording, v2x, runs=runs, seed=seed, logged=log.messages)
    return observe(fleet(data), noise, v2x, runs=runs, seed=seed, observers=observers, remove_outliers=remove_outliers)
