"""observe: a Fleet seen through Sensors and a V2X channel becomes a Recording. Outliers are added to clean draws of the
same seed: recordings with and without are pairs.
"""

from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy import inf, nan
from numpy.linalg import norm

from ..arrays import Bools, Floats, Ints, instance, last_true, one_of, runs_in_memory, seed_of
from ..errors import InputError, shown
from .body_frames import body_measurements, body_motion, gauss_markov, in_body
from .channels import lost
from .fleet import Fleet, columns, interval
from .links import Links, spherical, wrap
from .recording import Recording, Vehicles
from .sensors import Fault, Outliers, Sensors, stream
from .v2x import V2X

Frame = Literal["world", "body"]
Pairs = Sequence[tuple[str, str, Ints, Ints]]
"""Observer id, neighbour id, indices of its links, and their steps."""
SECONDS, PAIRS_AT_ONCE = 5.0, 2_000_000
"""s over which positions are held against velocities; pairs of vehicles looked at in one go, to bound the memory."""


def observe(
    fleet: Fleet,
    sensors: Sensors,
    v2x: V2X | None = None,
    *,
    runs: int = 1,
    seed: int = 0,
    observers: Vehicles | None = None,
    assumed: Sensors | None = None,
    frame: Frame = "world",
    landmarks: Vehicles = (),
    remove_outliers: bool = False,
) -> Recording:
    """Measurements of a drive in `runs` noise realisations.

    GNSS z = x + n + b + drift, velocity u + e, relative (d, az, inc) + n of the K nearest within the radius. Noise is
    keyed by (seed, sensor, run, vehicle, partner) and step: 30 runs are a prefix of 100, K = 2 is a subset of K = 10.
    A noisy range that would be negative is reflected, as in the authors' public code. `Sensors.outliers` are added to
    these draws; the notes of the recording name them.

    Args:
        fleet: the truth.
        sensors: the noise that acts.
        v2x: neighbourhood and channel, default V2X().
        runs: R.
        seed: of all draws.
        observers: vehicles whose links are recorded (default all); fewer is faster and changes no other draws.
        assumed: what methods may know, default `sensors` without its bias.
        frame: "world" for velocities and azimuths in the world; "body" for forward, left and up, azimuths from the
            observer's heading, yaw rates, and headings by a compass if `sensors.compass`.
        landmarks: vehicles that stand at known positions: all within the radius are measured, and none sends.
        remove_outliers: as for an estimator which knows them: a wrong fix, range or angle is missing (NaN), and
            odometry has no slip.

    Raises:
        InputError: runs < 1 or more than fit into memory, seed < 0, a rate above 1/dt, an unknown observer, an assumed
            std of zero, another frame, or a landmark that moves.

    >>> fleet = Fleet(("a", "b"), [0, 0.1], np.zeros((2, 2, 3)) + [[[0, 0, 0], [9, 0, 0]]], np.zeros((2, 2, 3)))
    >>> observe(fleet, Sensors(), V2X(max_neighbours=1), runs=3)
    Recording(3 runs x 2 steps x 2 vehicles, 4 links, K <= 1)
    """
    fleet, sensors = instance("fleet", fleet, Fleet), instance("sensors", sensors, Sensors)
    v2x = V2X() if v2x is None else instance("v2x", v2x, V2X)
    seed = seed_of(seed)
    watching = range(len(fleet.ids)) if observers is None else sorted({*columns("observers", observers, fleet.ids)})
    one_of("frame", frame, Frame)
    assumed = sensors.assumable() if assumed is None else instance("assumed", assumed, Sensors)
    standing = columns("landmarks", landmarks, fleet.ids)
    links = find_links(fleet, watching, v2x, sensors.min_range, standing)
    runs = runs_in_memory(runs, 8 * fleet.present.size + 4 * len(links))
    broadcasts, arrival = schedule(fleet.ids, fleet.t, links, v2x, runs, seed)
    arrival[:, np.isin(links.neighbour, standing)] = -1
    broadcasts[:, standing] = False
    instance("remove_outliers", remove_outliers, bool, "Give True to remove outliers.")
    gnss = _gnss(fleet, sensors, runs, seed, remove_outliers)
    gnss[:, :, standing] = fleet.position[:, standing]
    relative = _relative_measurements(fleet, links, sensors, v2x, runs, seed, remove_outliers)
    body, moved = None, fleet.velocity
    notes = [f"{note}{', removed' * remove_outliers}" for note in (sensors.outliers.notes if sensors.outliers else ())]
    if strange := _contradictory(fleet):
        notes.append(f"velocities of {shown(strange)} contradict positions: they are in m/s, of the same instants")
    if frame == "world":
        velocity = _noisy(fleet, "velocity", runs, seed, moved, sensors.velocity_std(moved))
    else:
        (velocity, body), (moved, _) = body_measurements(fleet, sensors, runs, seed), body_motion(fleet)
        relative = in_body(relative, fleet, links, _own_errors(fleet, links, sensors, runs, seed, *HEADING))
    if sensors.outliers:
        wrong_odometry(velocity, moved, fleet, sensors.outliers, seed, remove_outliers)
    for array in (gnss, velocity, relative):
        array.flags.writeable = False  # so that the Recording need not copy them
    return Recording(
        ids=fleet.ids,
        t=fleet.t,
        gnss=gnss,
        velocity=velocity,
        links=links,
        relative=relative,
        broadcasts=broadcasts,
        arrival=arrival,
        sensors=assumed,
        v2x=v2x,
        observers=tuple(watching),
        notes=tuple(notes),
        body=body,
        landmarks=tuple(standing),
    )


def find_links(
    fleet: Fleet, observers: Sequence[int], v2x: V2X, min_range: float, landmarks: Sequence[int] = ()
) -> Links:
    """Links of each observer to its K nearest vehicles in [min_range, radius], by step, observer, distance.

    Vehicles at one distance come by column, at one place there is none. Near vehicles are looked up in a k-d tree.

    Args:
        fleet: the truth.
        observers: columns.
        v2x: K and radius m.
        min_range: m.
        landmarks: columns of members that are linked beside the K, and observe nothing.
    """
    links = [np.empty((0, 3), int)]
    vehicles, columns = len(fleet.ids), np.array(list(observers), int)
    columns, marks = np.setdiff1d(columns, landmarks), np.isin(np.arange(vehicles), landmarks)
    at_once = max(1, PAIRS_AT_ONCE // (vehicles * max(1, len(columns))))
    for first in range(0, len(fleet.t), at_once) if (v2x.max_neighbours or marks.any()) and len(columns) else ():
        position = fleet.position[first : first + at_once]
        observer, other = _near(position, columns, v2x.radius)
        gap = norm(position.reshape(-1, 3)[other] - position.reshape(-1, 3)[observer], axis=1)
        fits = (gap <= v2x.radius) & (gap >= min_range) & (gap > 0.0)
        observer, other, gap = observer[fits], other[fits], gap[fits]
        order = np.lexsort((other, gap, observer))
        observer, other = observer[order], other[order]
        passed = np.append(0, np.cumsum(~marks[other % vehicles]))  # vehicles before each
        rank = passed[:-1] - passed[np.searchsorted(observer, observer)]
        kept = (rank < v2x.max_neighbours) | marks[other % vehicles]
        observer, other = observer[kept], other[kept]
        links.append(np.column_stack([observer // vehicles + first, observer % vehicles, other % vehicles]))
    rows = np.concatenate(links)
    return Links(rows[:, 0], rows[:, 1], rows[:, 2])


def _near(position: Floats, columns: Ints, radius: float) -> tuple[Ints, Ints]:
    """Indices (step x vehicles + column) of observers and of all vehicles about within the radius.

    Args:
        position: (T, N, 3) m, NaN where absent.
        columns: of the observers.
        radius: m.
    """
    from scipy.spatial import KDTree

    vehicles = position.shape[1]
    here = np.flatnonzero(np.isfinite(position[..., 0]))
    positions = position.reshape(-1, 3)[here]
    span = float(np.ptp(positions, axis=0).max()) if len(positions) else 0.0
    reach = 1.001 * min(radius, 2.0 * span) + 1e-9
    tagged = np.column_stack([positions, 4.0 * reach * (here // vehicles)])  # those of other steps are far away
    looks = np.isin(here % vehicles, columns)
    observers, everyone = (KDTree(each, 32, False, balanced_tree=False) for each in (tagged[looks], tagged))
    pairs = observers.sparse_distance_matrix(everyone, reach, output_type="ndarray")
    return here[looks][pairs["i"]], here[pairs["j"]]


def _contradictory(fleet: Fleet) -> list[str]:
    """Vehicles whose ways over SECONDS differ from the integrals of their velocities by more than a tenth, of turns and
    stops within steps, too, and 0.1 m/s on average."""
    if len(fleet.t) < 2:
        return []
    ways, u, dt = np.diff(fleet.position, axis=0), fleet.velocity, fleet.dt
    gaps = np.nan_to_num(ways - 0.5 * dt * (u[1:] + u[:-1]))
    gaps = np.add.reduceat(gaps, np.arange(0, len(gaps), int(SECONDS / dt) + 1))
    allowed = 0.1 * np.nansum(abs(ways) + dt + dt * abs(u[1:] - u[:-1]), (0, 2))
    return [fleet.ids[k] for k in np.flatnonzero(abs(gaps).sum((0, 2)) > allowed)]


def _noisy(fleet: Fleet, sensor: str, runs: int, seed: int, mean: Floats, std: Floats) -> Floats:
    """(R, T, N, 3): mean (T, N, 3) and std, broadcastable to it, times standard normals, one stream per vehicle."""
    centre, scale = (np.ascontiguousarray(np.broadcast_to(a, mean.shape).swapaxes(0, 1)) for a in (mean, std))
    noisy, drawn = np.empty((runs, *mean.shape)), np.empty_like(centre)
    for r in range(runs):  # one after the other stays in the cache
        for name, normals in zip(fleet.ids, drawn, strict=True):
            stream(seed, sensor, r, name).standard_normal(out=normals)
        drawn *= scale
        drawn += centre
        noisy[r] = drawn.swapaxes(0, 1)
    return noisy


def _gnss(fleet: Fleet, sensors: Sensors, runs: int, seed: int, remove_outliers: bool) -> Floats:
    fixes = _noisy(fleet, "gnss", runs, seed, fleet.position, np.array(sensors.gnss_std))
    low, high = sensors.gnss_bias
    steps = len(fleet.t) if sensors.gnss_bias_mode == "sample" else 1
    for r in range(runs):
        if high > 0:
            bias = [stream(seed, "gnss_bias", r, name).uniform(low, high, (steps, 3)) for name in fleet.ids]
            fixes[r] += np.stack(bias, 1)
        for std, names in ((sensors.gnss_drift_std, fleet.ids), (sensors.gnss_common_std, ("",))):
            if std > 0:  # the common error belongs to no vehicle
                draws = [stream(seed, "gnss_drift", r, name).standard_normal((len(fleet.t), 3)) for name in names]
                fixes[r] += std * gauss_markov(np.stack(draws, 1), fleet.dt / sensors.gnss_drift_time)
    if sensors.outliers:
        wrong_fixes(fixes, fleet, sensors.outliers, seed, remove_outliers)
    return fixes


def _pairs(ids: Sequence[str], links: Links) -> Pairs:
    """Every pair that is ever linked, its links in time order."""
    key = links.observer * len(ids) + links.neighbour
    order = np.argsort(key, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(key[order])) + 1) if len(order) else []
    return [(ids[links.observer[g[0]]], ids[links.neighbour[g[0]]], g, links.step[g]) for g in groups]


def _relative_measurements(
    fleet: Fleet, links: Links, sensors: Sensors, v2x: V2X, runs: int, seed: int, remove_outliers: bool
) -> Floats:
    """(R, L, 3): the step's own draw of the pair's stream, so a link that comes and goes keeps its draws."""
    vector = fleet.position[links.step, links.neighbour] - fleet.position[links.step, links.observer]
    exact = np.stack(spherical(*vector.T), -1) if len(links) else np.empty((0, 3))
    pairs, relative = _pairs(fleet.ids, links), np.empty((runs, *exact.shape))
    turned = _own_errors(fleet, links, sensors, runs, seed, *HEADING)
    longer = _own_errors(fleet, links, sensors, runs, seed, "range_offset")
    scratch = np.empty((len(fleet.t), 3))
    for r in range(runs):  # one after the other stays in the cache
        for observer, neighbour, index, step in pairs:
            draws = scratch[: step[-1] + 1]
            stream(seed, "relative", r, observer, neighbour).standard_normal(out=draws)
            relative[r, index] = draws[step]
        relative[r] *= sensors.relative_std
        relative[r] += exact
        relative[r, :, 0] = abs(relative[r, :, 0] + longer[r])
        relative[r, :, 1] = wrap(relative[r, :, 1] + turned[r])
    if sensors.outliers:
        reach = sensors.min_range, v2x.radius
        wrong_relative(relative, pairs, fleet, links, sensors.outliers, reach, seed, remove_outliers)
    return relative


HEADING = ("heading", "heading_bias")
"""Errors of an observer that rotate what it measures; the first is new at every step, all others last."""


def _own_errors(fleet: Fleet, links: Links, sensors: Sensors, runs: int, seed: int, *kinds: str) -> Floats:
    """(R, L) sum of such errors of its observer in each measurement."""
    turned = np.zeros((runs, len(links)))
    for kind in kinds:
        std = getattr(sensors, f"{kind}_std")
        for column in np.unique(links.observer) if std > 0 else ():
            own_links = links.of(column)
            for r in range(runs):
                normals = stream(seed, kind, r, fleet.ids[column]).standard_normal(len(fleet.t))
                turned[r, own_links] += std * normals[links.step[own_links] * (kind == "heading")]
    return turned


def schedule(ids: Sequence[str], t: Floats, links: Links, v2x: V2X, runs: int, seed: int) -> tuple[Bools, Ints]:
    """Steps at which each vehicle broadcasts (T, N), and the arrival step (R, L) of the neighbour's broadcast over each
    link."""
    dt = interval(t)
    per_step = 1.0 if v2x.rate is None else v2x.rate * dt
    if per_step > 1 + 1e-9:
        limit = f"must be <= 1/dt = {1 / dt:g} Hz"
        raise InputError("rate", f"{v2x.rate} Hz", limit, "Broadcast at most once a step.")
    phase = np.array([stream(seed, "phase", 0, name).uniform() for name in ids])
    sends = np.diff(np.floor((np.arange(-1, len(t))[:, None] + 1e-9) * per_step + phase), axis=0) > 0
    sent = sends[links.step, links.neighbour]
    arrival = np.where(sent, links.step + int(np.ceil(v2x.latency / dt - 1e-9)), -1)[None].repeat(runs, axis=0)
    if v2x.loss > 0:
        number = (np.cumsum(sends, 0) - 1)[links.step, links.neighbour]
        for observer, neighbour, pair, _ in _pairs(ids, links):
            index = pair[sent[pair]]
            size = int(number[index].max(initial=-1)) + 1
            draws = np.stack([stream(seed, "loss", r, observer, neighbour).uniform(size=size) for r in range(runs)])
            arrival[:, index] = np.where(lost(draws, v2x.loss, v2x.burst)[:, number[index]], -1, arrival[:, index])
    return sends, arrival


class Episodes(NamedTuple):
    """A fault of one sensor at every step.

    Attributes:
        wrong: (T,) whether it acts.
        size: (T,) of its error, in the unit of `Fault.size`.
        turn: (T, 2) uniform draws in [0, 1) for its direction.
    """

    wrong: Bools
    size: Floats
    turn: Floats


def episodes(fault: Fault, key: tuple[int, str, int, str, str], steps: int, dt: float) -> Episodes:
    """Draws of a fault; fewer steps are a prefix.

    Args:
        fault: its law.
        key: seed, kind, run, vehicle and partner.
        steps: T.
        dt: s.

    >>> float(episodes(Fault(0.25), (0, "outages", 0, "a", ""), 10_000, 0.1).wrong.mean().round(2))
    0.25
    """
    draws = stream(*key).random((steps, 5))
    fresh = draws[:, 0] >= (np.exp(-dt / fault.lasts) if fault.lasts else 0.0)
    fresh[:1] = True
    held = draws[last_true(fresh)]
    low, high = fault.size
    share = -np.log1p(-held[:, 2]) if fault.law == "exponential" else held[:, 2]
    return Episodes(held[:, 1] < fault.rate, low + (high - low) * share, held[:, 3:])


def wrong_fixes(gnss: Floats, fleet: Fleet, outliers: Outliers, seed: int, remove_outliers: bool) -> None:
    """Displace and remove fixes (R, T, N, 3) in place; `remove_outliers` removes the displaced ones, too."""
    for r, column, jump in _of_vehicles("fixes", outliers.fixes, fleet, len(gnss), seed):
        up, around = 2.0 * jump.turn[:, 0] - 1.0, 2.0 * np.pi * jump.turn[:, 1]
        flat = np.sqrt(1.0 - up**2)
        error = jump.size[:, None] * np.column_stack([flat * np.cos(around), flat * np.sin(around), up])
        gnss[r, jump.wrong, column] += nan if remove_outliers else error[jump.wrong]
    for r, column, gap in _of_vehicles("outages", outliers.outages, fleet, len(gnss), seed):
        gnss[r, gap.wrong, column] = nan


def wrong_odometry(
    velocity: Floats, motion: Floats, fleet: Fleet, outliers: Outliers, seed: int, remove_outliers: bool
) -> None:
    """Add slip to velocities (R, T, N, 3) in place, a share of the true motion (T, N, 3), unless `remove_outliers`."""
    for r, column, slip in _of_vehicles("odometry", outliers.odometry, fleet, len(velocity), seed):
        if not remove_outliers:
            share = np.where(slip.turn[:, 0] < 0.5, slip.size, -np.minimum(slip.size, 1.0))
            velocity[r, :, column] += np.where(slip.wrong, share, 0.0)[:, None] * motion[:, column]


def _of_vehicles(kind: str, fault: Fault, fleet: Fleet, runs: int, seed: int) -> Iterator[tuple[int, int, Episodes]]:
    """Run, column and episodes of each vehicle, which never begin before its second step."""
    for r in range(runs if fault.rate else 0):
        for column, name in enumerate(fleet.ids):
            faulty = episodes(fault, (seed, f"outlier {kind}", r, name, ""), len(fleet.t), fleet.dt)
            faulty.wrong[: int(np.argmax(fleet.present[:, column])) + 1] = False
            yield r, column, faulty


def wrong_relative(
    relative: Floats,
    pairs: Pairs,
    fleet: Fleet,
    links: Links,
    outliers: Outliers,
    reach: tuple[float, float],
    seed: int,
    remove_outliers: bool,
) -> None:
    """Lengthen ranges and mistake angles of measurements (R, L, 3) in place; `remove_outliers` removes these
    components.

    Args:
        relative: m, rad, rad.
        pairs: that measure one another.
        fleet: the truth.
        links: L of them.
        outliers: what goes wrong.
        reach: (min_range, radius) m, within which a vehicle may be mistaken for another.
        seed: of all draws.
        remove_outliers: whether NaN takes the place of what is wrong.
    """
    steps, dt = len(fleet.t), fleet.dt
    for r in range(len(relative) if outliers.ranges.rate else 0):
        for observer, neighbour, index, step in pairs:
            one, other = sorted((observer, neighbour))
            late = episodes(outliers.ranges, (seed, "outlier ranges", r, one, other), steps, dt)
            hit = late.wrong[step]
            relative[r, index[hit], 0] += nan if remove_outliers else late.size[step[hit]]
    if not outliers.angles.rate:
        return
    mistaken = np.zeros(relative.shape[:2], bool)
    for r in range(len(relative)):
        for observer, neighbour, index, step in pairs:
            faulty = episodes(outliers.angles, (seed, "outlier angles", r, observer, neighbour), steps, dt)
            mistaken[r, index] = faulty.wrong[step]
    (at,) = np.nonzero(mistaken.any(axis=0))
    error, mistakable = mistaken_angles(fleet, links, at, reach)
    run, row = np.nonzero(mistaken[:, at] & mistakable)
    wrong = run, at[row]
    relative[(*wrong, 1)] = wrap(relative[(*wrong, 1)] + (nan if remove_outliers else error[row, 0]))
    relative[(*wrong, 2)] += nan if remove_outliers else error[row, 1]


def mistaken_angles(fleet: Fleet, links: Links, at: Ints, reach: tuple[float, float]) -> tuple[Floats, Bools]:
    """Error (M, 2) rad of azimuth and inclination if the vehicle nearest to the neighbour is taken for it, and whether
    (M,) the observer sees another at all.

    Args:
        fleet: the truth.
        links: L of them.
        at: M indices of links.
        reach: (min_range, radius) m.
    """
    error, done = np.zeros((len(at), 2)), np.zeros(len(at), bool)
    at_once = max(1, PAIRS_AT_ONCE // len(fleet.ids))
    for first in range(0, len(at), at_once):
        part = slice(first, first + at_once)
        step, observer, neighbour = (side[at[part]] for side in (links.step, links.observer, links.neighbour))
        everyone, rows = fleet.position[step], np.arange(len(step))
        own, right = everyone[rows, observer], everyone[rows, neighbour]
        away = norm(everyone - own[:, None], axis=-1)
        gap = norm(everyone - right[:, None], axis=-1)
        gap[~((away >= reach[0]) & (away <= reach[1]))] = inf  # of absent vehicles, too
        gap[rows, neighbour] = gap[rows, observer] = inf
        other = np.argmin(gap, 1)
        done[part] = np.isfinite(gap[rows, other])
        angles = (np.stack(spherical(*(to - own).T)[1:], axis=-1) for to in (everyone[rows, other], right))
        error[part] = np.where(done[part, None], next(angles) - next(angles), 0.0)
    return error, done
