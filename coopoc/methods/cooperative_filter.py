"""CooperativeFilter: the filter of a star where receivers, compasses, channels, odometers and senders may be wrong."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy import inf
from numpy.typing import ArrayLike

from ..arrays import Floats, check_fields, number
from ..kernels.gate import GATE
from ..kernels.stars.cooperative_filter import run_filter
from ..kernels.stars.cooperative_messages import fading_memory
from ..kernels.stars.cooperative_state import Model
from ..kernels.stars.messages import FORGOTTEN
from ..world.inbox import Inbox
from ..world.recording import Recording, Vehicles, check_recording
from ..world.v2x import Message
from .egos import Estimate, assumptions, follow_egos, measurements, relative_noise
from .noise_model import NoiseModel, resolve
from .odometry_fault import with_odometry
from .track import Checked, Track, in_stretches

FOUND_UNITS = {
    "heading error": "rad",
    "scale error": "",
    "compass error": "rad",
    "range offset": "m",
    "range scale": "",
    "slips": "of the steps",
    "alone": "of the steps, as what is measured of its neighbours contradicts its fixes",
}
LEVEL_NAMES = ("range", "azimuth", "inclination", "fix", "message", "motion")
NOTED_ERRORS = (0.01, 0.01, 0.01, 0.1, 0.01, 0.01, 0.0)
"""Least of what is found that is worth a note."""
NOTED_LEVEL = 1.5
"""Level that is worth a note, or less than its inverse."""
WEIGHED = ("range", "azimuth", "inclination", "message", "trusted")
NOTED_CLOCK = 0.1
"""s, of a clock that is worth a note: in 120 worlds with nothing wrong at most 0.08 s was found."""


class Priors(NamedTuple):
    """What may be otherwise than sensors state; 0 for what is not.

    Attributes:
        heading: rad, and
        scale: standard deviations of errors of odometry that last.
        lasts: s, for which they do, over the square of the level of motions.
        compass: rad, and
        offset: m, of such errors of the ego's compass and ranges, where none is stated.
        range_scale: of such an error of the scale of these.
        pair_offset: m, of the offset of the ranges of a pair, which changes in a minute.
        clock: s, of a neighbour's clock.
        absent: log odds that each of these, but that of a pair, is not there, before anything was measured; of a
            clock, a compass and the scale of ranges 8 at least.
        exact: where absent is -inf, log odds that no odometry errs, times the vehicles in the star, two at least.
        slip: an ego that slips errs by that share of its late speed.
        fix: factor of the assumed standard deviation of fixes, which err together for a while.
        fix_gate: squared Mahalanobis distance from which the fixes of a step weigh less; 0 if no number is doubted.
        forget: s, in which what innovations have shown of levels is forgotten; 0 for levels that stay.
        quietest: least logarithm of the level of motions.
    """

    heading: float = 0.05
    scale: float = 0.05
    lasts: float = 1e5
    clock: float = 0.05
    compass: float = 0.05
    offset: float = 1.0
    range_scale: float = 0.0
    pair_offset: float = 0.0
    absent: float = 8.0
    exact: float = -inf
    slip: float = 0.7
    fix: float = 1.0
    fix_gate: float = 16.0
    forget: float = 10.0
    quietest: float = -2.0


NO_ODOMETRY = Priors(heading=0.0, scale=0.0, clock=0.0, compass=0.0, offset=0.0, slip=0.0, quietest=0.0)
"""Of velocities that fixes have shown: their noise is that of turns, too, before which all may be quiet."""
AS_STATED = NO_ODOMETRY._replace(fix_gate=0.0, forget=0.0)
"""Nothing is otherwise: the textbook's filter."""
ON_ROADS = Priors(
    heading=0.03,
    scale=0.03,
    clock=0.2,
    offset=0.0,
    range_scale=0.03,
    pair_offset=0.3,
    absent=-inf,
    exact=-4.0,
    fix=2.0,
    fix_gate=6.0,
)
"""Of measurements that are not simulated: hardly any odometry is without such errors."""
STATED = ON_ROADS._replace(exact=0.0, fix=1.5)
"""Of those whose log states how far its odometry errs: that none errs otherwise is as likely as not."""


class Broadcast(NamedTuple):
    """What a vehicle with a cooperative filter broadcasts, with its id and the time.

    Attributes:
        position: (3,) m, mean of its fixes, moved by the odometer, each with the weight exp(-age / 5 s) / variance.
        velocity: (3,) m/s.
        variance: (3,) m^2, 1 over the sum of these weights.
        odometer: (3,) m, sum of all its motions.
    """

    position: ArrayLike
    velocity: ArrayLike
    variance: ArrayLike
    odometer: ArrayLike


BROADCAST = Message("estimate, odometer and velocity", 3 * len(Broadcast._fields) + 2)


@dataclass(frozen=True, eq=False)
class CooperativeFilter(Checked):
    r"""Kalman filter of the star {ego} + neighbours that expects wrong numbers: one method for every condition.

    The state holds the members' positions and, where they are needed, the error of each receiver's fixes, the error
    that all fixes share, and errors of odometries and of the ego's compass and ranges:

    $$
    z_j = x_j + b_j + c + w_j, \qquad
    \theta_{ij} = \angle(x_j - x_i) + \beta + w
    $$

    - *Trust*: the fixes of a vehicle that is new have an unknown offset $b_j \sim N(0, \tau^2)$. When the odds
      $p(b_j = 0 \mid \text{all}) / p(b_j = 0)$ allow, $b_j$ is set to 0, the surest first, and all its fixes count in
      retrospect. A mean innovation that has become unlikely, beside those of others, revokes the trust; in the
      ego's own receiver, too, where there are neighbours, unless these put it where its fix is: then it goes there.
    - *Gates*: where the squared Mahalanobis distance $q$ of a fix, or of a component of a relative measurement,
      exceeds its gate, the innovation's covariance is multiplied by $q / \mathrm{gate}$; that of a component far beyond
      it by 100 more, and a fix far beyond it is left out, until many were (`kernels.gate`); the n-th fix in a row
      counts 1 / n, and alone those that jumped wait as long as others had agreed, less a third. A member that is
      contradicted for too long joins anew; an ego that rests on nothing that is trusted starts anew. Velocities that
      no vehicle can have reached are replaced by the last ones.
    - *Levels*: the variances of the ego's fixes, its neighbours' fixes, ranges, azimuths, inclinations and motions
      follow their innovations, between 0.14 and 33 times what is assumed, by recursive maximum likelihood
      (`kernels.stars.otherwise`). Where odometry surely errs, half of what successive innovations share is motion's.
    - *Errors that last and may not be there*: of heading $b$ and scale $s$ of each odometry,
      $x_t = x_{t-1} + (1 + s) R(b) \Delta t \, u$, of the ego's compass and of its ranges (of measured ones also their
      scale, and an offset of each pair); those of odometry change the faster, the noisier
      motions are, and those of the ego's the surer they are. Each is a state with a wide prior, and the estimate is the
      average over whether it is 0, by Bayes' rule (`kernels.stars.otherwise`).
    - *Slips*: a step whose numbers surprise is tried again with a motion that is not known, and the likelier of both
      is kept (`kernels.stars.otherwise`).
    - *The star*: an ego whose fixes and whose star contradict each other goes on alone for a while, where no noise
      explains what is measured of its neighbours.
    - *Starts*: at a fix, or where a neighbour that sends a position is measured whole, range and both angles.
    - *Messages* hold a fading mean of the sender's fixes, its weight, the odometer and the velocity. The mean of the
      fixes between any two of them follows: a lost message loses nothing, and no fix counts twice.

    Args:
        noise_model: "identity", "nominal" or a NoiseModel, whose errors that last (fixes, compass, ranges) are states.
        priors: of errors. The default was chosen on development worlds and validation tasks of CL-Bench. Real
            measurements have the default ON_ROADS: odometry errs until the evidence of the whole fleet is against it,
            and the standard deviation of fixes is twice the stated one. A log that states the noise of its odometry has
            the default STATED.

    References:
        Ljung, Soderstrom, Theory and Practice of Recursive Identification, MIT Press, 1983;
        Chang, Robust Kalman filtering based on Mahalanobis distance as outlier judging criterion, J. Geodesy 88, 2014;
        Friedland, Treatment of bias in recursive filtering, IEEE TAC 14(4), 1969; Sorenson, Sacks, Recursive fading
        memory filtering, Information Sciences 3, 1971.

    >>> CooperativeFilter().message.payload
    56
    >>> from coopoc import Fleet, Sensors, observe
    >>> still = Fleet(("a",), np.arange(400), np.zeros((400, 1, 3)), np.zeros((400, 1, 3)))
    >>> CooperativeFilter()(observe(still, Sensors(gnss_common_std=9.0))).notes  # that errors last is known
    ()
    """

    noise_model: NoiseModel | str = "nominal"
    priors: Priors = Priors()
    name: str = "cooperative-filter"
    cooperative, needs_fix = True, False

    def __post_init__(self) -> None:
        check_fields(self)
        for name, value in self.priors._asdict().items():
            least = -inf if name in ("absent", "exact", "quietest") else 0.0
            number(f"priors.{name}", value, least, allowed=">= 0", hint="Give Priors()._replace(...).")

    @property
    def message(self) -> Message:
        """Mean of fixes, odometer and velocity."""
        return BROADCAST

    @in_stretches
    def __call__(self, recording: Recording, egos: Vehicles = (0,)) -> Track:
        """Track of the egos and of the neighbours in their stars; InputError if an ego is unknown or absent.

        `extras` hold estimated errors, (R, T, E) each: the ego's "heading_error" and "compass_error" rad,
        "scale_error", "range_offset" m and "range_scale"; whether it "slips", or is "alone"; "range_level" and so on,
        factors of standard deviations. They also hold weights, 1 for a measurement that was fully used: of each ego's
        "fix" (R, T, E), and by link (R, L) of "range", "azimuth", "inclination" and "message", NaN where there was
        none. By link, too: whether the neighbour is "trusted", and by how many s its "clock" is ahead.
        """
        noise_model = resolve(self.noise_model, check_recording(recording))
        priors, of_fixes = (priors_of(self, noise_model, recording.measured, shown) for shown in (False, True))
        velocity = recording.velocity
        if priors.fix_gate:
            recording, noise_model = with_odometry(recording, recording.observing(egos), noise_model, priors.fix)
        extra, noise_model = noise_model.extra, replace(noise_model, extra=None)
        notes = [*noise_model.notes]
        fix = np.full(len(recording.ids), priors.fix)
        fix[[*recording.shown]] = of_fixes.fix
        variance = np.square(fix)[:, None] * noise_model.fix_variance(recording)
        sent = fading_memory(recording.gnss, recording.velocity, variance, recording.dt)
        stated = noise_model.compass[1], noise_model.sensors.range_offset_std if noise_model.sensors else 0.0

        def run(ego: int, inbox: Inbox) -> Iterator[Estimate]:
            model = model_of(noise_model, of_fixes if ego in recording.shown else priors)
            inputs, assumed = measurements(recording, ego, inbox), assumptions(recording, noise_model, ego, inbox)
            assumed = assumed._replace(fixes=variance)
            odometry = np.zeros((*velocity.shape[:2], 4))
            if extra is not None:
                odometry[..., :3] = recording.dt * (recording.velocity - velocity)[:, :, ego]
                odometry[..., 3] = extra[:, :, ego]
            of_ego, by_link = run_filter(inputs, assumed, sent, odometry, model)
            fixes, deviations, x, cov = np.split(of_ego, [1, -12, -9], axis=-1)
            neighbours, weights = by_link[..., :3], by_link[..., 3:]
            extras = {"fix": fixes} | {kind: weights[..., k] for k, kind in enumerate((*WEIGHED, "clock"))}
            names = (*(name.replace(" ", "_") for name in FOUND_UNITS), *(f"{kind}_level" for kind in LEVEL_NAMES))
            extras |= {name: deviations[..., i, None] for i, name in enumerate(names)}
            own_id = recording.ids[ego]
            if priors.fix_gate and np.isfinite(x).any():
                notes.extend(otherwise(own_id, deviations, fix[ego], stated))
            notes.extend(rejected(f"fixes, {own_id}", (fixes < 0.1).sum(), np.isfinite(fixes).sum()))
            if model.own + model.common == 0.0 and priors.fix_gate:
                notes.extend(lasting(own_id, recording.gnss[:, :, ego] - x, recording.dt))
            shares = weights[..., : len(WEIGHED)]
            low, measured = (shares < 0.1).sum(0), np.isfinite(shares).sum(0)
            for j in np.unique(inputs.neighbour):
                here = inputs.neighbour == j
                clock = weights[:, here, len(WEIGHED)]
                ahead = float(np.median(clock[np.isfinite(clock)])) if np.isfinite(clock).any() else 0.0
                if abs(ahead) > NOTED_CLOCK:
                    way = "ahead, or its messages are late" if ahead > 0 else "behind"
                    notes.append(f"clock, {recording.ids[j]}: {abs(ahead):.2g} s {way}")
                for kind, count, of in zip(WEIGHED, low[here].sum(0), measured[here].sum(0), strict=True):
                    what = f"{kind}, {own_id} and {recording.ids[j]}"
                    notes.extend(rejected(what, count, of, 0.5 if kind == "trusted" else 0.05))
            yield Estimate(x, cov.reshape(*x.shape, 3), neighbours, extras=extras)

        return follow_egos(self, recording, egos, run, notes)


def otherwise(ego: str, estimates: Floats, fix: float = 1.0, stated: Sequence[float] = (0.0, 0.0)) -> list[str]:
    """Notes on what differs from the stated noise in the second half of a drive, by mean squares over runs and steps.

    A level that no measurement has changed has no note. Where fixes are assumed to err more than stated, low levels of
    ranges, angles and motions have none either.

    Args:
        ego: its name.
        estimates: (R, T, 13) errors that last, whether it slips, whether it is alone, and levels.
        fix: factor of the stated deviation of fixes that was assumed.
        stated: deviations of the errors of the compass, rad, and of ranges, m; errors within them have no note.

    >>> otherwise("a", np.array([[[0.0, 0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 3.0, 1.0, 1.0]]]))
    ['scale error, a: 0.02', 'fix level, a: 3 times the stated deviation']
    >>> otherwise("a", np.array([[[0.0] * 7 + [0.4] + [1.0] * 5]]), 2.0)  # of a road, where nothing was wrong
    []
    """
    estimates = estimates[:, np.isfinite(estimates[..., 4]).any(0)]  # from where it knows where it is
    late = estimates[:, estimates.shape[1] // 2 :]
    usual = np.sqrt(np.nanmean(np.square(late), axis=(0, 1)))
    usual[5:7] = np.nanmean(estimates[..., 5:7], axis=(0, 1))
    usual[len(FOUND_UNITS) :][(late[..., len(FOUND_UNITS) :] == 1.0).all(axis=(0, 1))] = np.nan
    usual[10:12] *= fix
    least = np.maximum(NOTED_ERRORS, (0.0, 0.0, *stated, 0.0, 0.0, 0.0))
    notes = [
        f"{name}, {ego}: {value:.2g} {unit}".rstrip()
        for (name, unit), value, most in zip(FOUND_UNITS.items(), usual, least, strict=False)
        if value > most
    ]
    levels = zip(LEVEL_NAMES, usual[len(FOUND_UNITS) :], strict=True)
    return notes + [
        f"{kind} level, {ego}: {value:.2g} times the stated deviation"
        for kind, value in levels
        if value > NOTED_LEVEL or (value < 1 / NOTED_LEVEL and (fix == 1.0 or kind in ("fix", "message")))
    ]


def rejected(what: str, count: int, measured: int, share: float = 0.05) -> list[str]:
    """A note if that share of the measured numbers, ten at least, weighed next to nothing.

    >>> rejected("range, a and b", 10, 40)
    ['range, a and b: 10 of 40 rejected']
    """
    return [f"{what}: {count} of {measured} rejected"] if count >= max(10, share * measured) else []


def lasting(ego: str, residual: Floats, dt: float) -> list[str]:
    """A note if the residuals (R, T, 3) m of an ego's fixes are correlated over a second: then their errors last.

    >>> white = np.random.default_rng(0).normal(size=(1, 400, 3))
    >>> lasting("a", white.repeat(2, axis=1), dt=0.1)  # errors of 0.2 s
    []
    >>> len(lasting("a", white.repeat(20, axis=1), dt=0.1))
    1
    """
    lag = max(round(1.0 / dt), 1)
    product, square = residual[:, lag:] * residual[:, :-lag], np.nansum(residual**2)
    correlation = (
        float(np.nanmean(product) / np.nanmean(residual**2)) if square > 0.0 and np.isfinite(product).any() else 0.0
    )
    if correlation < 0.1 + 4.0 / np.sqrt(max(np.isfinite(product).sum(), 1)):
        return []
    return [
        f"fixes, {ego}: errors a second apart are correlated by {correlation:.2f}; give Sensors(gnss_drift_std=...)"
    ]


def priors_of(method: CooperativeFilter, noise_model: NoiseModel, measured: bool, shown: bool = False) -> Priors:
    """The method's own, and if they are the usual ones those of real roads where measurements are real, of a vehicle
    with odometry or one whose velocity fixes have shown; none where no noise is stated that an innovation could
    exceed."""
    priors, sensors = method.priors, noise_model.sensors
    if sensors is None:
        return AS_STATED
    if measured and priors == Priors():
        on_roads = ON_ROADS if sensors.velocity_std_ratio > 0.0 else STATED  # a ratio is assumed where none is stated
        priors = NO_ODOMETRY if shown else on_roads
    return priors


def model_of(noise_model: NoiseModel, priors: Priors) -> Model:
    """The noise model of the kernel."""
    std, least = relative_noise(noise_model)
    white, time, absent = np.ones(3), 1.0, np.full(6, priors.absent)
    own = common = bias = heading = offset = 0.0
    absent[[2, 3, 5]] = max(priors.absent, Priors().absent)  # most are right, on roads, too
    turn = np.square([priors.heading, priors.scale, priors.clock])
    ranged = np.square([priors.range_scale, priors.pair_offset])
    if noise_model.sensors is not None:
        sensors, std = noise_model.sensors, np.array(std)
        own, common, offset = sensors.gnss_drift_std**2, sensors.gnss_common_std**2, sensors.range_offset_std**2
        white = np.square(sensors.gnss_std) / np.square(sensors.fix_std)
        time, (heading, bias) = sensors.gnss_drift_time, np.square(noise_model.compass)
        std[1] = np.sqrt(std[1] ** 2 - heading - bias)
        absent[3:5][np.array([bias, offset]) > 0.0] = -inf
        bias, offset = bias or priors.compass**2, offset or priors.offset**2
    lasting = own, common, time, white, bias, heading, offset, turn, priors.lasts, ranged, absent, priors.exact
    judged = priors.slip, GATE if priors.fix_gate else 0.0, priors.fix_gate, priors.forget, priors.quietest
    # whole numbers need no kernel of their own
    numbers: Any = [np.float64(value) for value in (std, least, FORGOTTEN, *lasting, *judged)]
    return Model(*numbers)
