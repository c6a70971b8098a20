"""CovarianceIntersection and QCQPRelaxation over a Recording: consistency, laws and real channels."""

from dataclasses import replace

import numpy as np
import pytest
from qcqp_relaxation import QCQPRelaxation

import coopoc as co
from coopoc import V2X, NoiseModel, Sensors, observe
from coopoc.evaluate.metrics import nees
from coopoc.kernels.solo import FixNoise
from coopoc.kernels.stars.messages import ESTIMATE_GROWTH
from coopoc.methods.kalman import solo_filter
from coopoc.methods.star import stars
from coopoc.methods.star_filters import CovarianceIntersection
from coopoc.world.inbox import inbox

S2 = Sensors.paper_scenario2()
SPLIT = CovarianceIntersection(split=True, name="split-ci")
FILTERS = [CovarianceIntersection(), SPLIT, CovarianceIntersection("identity"), replace(SPLIT, noise_model="identity")]
SNAPSHOTS = [QCQPRelaxation(), QCQPRelaxation("identity")]
METHODS = [*FILTERS, *SNAPSHOTS]


def label(method):
    return f"{method.name}-{method.noise_model}"  # type: ignore[attr-defined]


def test_ci_is_not_over_confident_in_traffic():
    """NEES on a crop of town10: mean at most 3 beyond its interval, far above for the naive sum of MSMV-R."""
    fleet = co.load_fleet("town10").between(0, 250)
    recording = observe(fleet, S2, V2X(max_neighbours=10), runs=8, seed=2, observers=[0, 12, 24])
    found = {m.name: nees(m(recording, [0, 12, 24]), fleet).mean(1) for m in (*FILTERS[:2], co.MSMV("nominal"))}
    for name in ("ci", "split-ci"):
        per_drive = found[name].ravel()
        half = 2.58 * per_drive.std(ddof=1) / np.sqrt(len(per_drive))
        assert per_drive.mean() - half < 3.0
        assert per_drive.mean() > 0.5
    assert found["msmv-r"].mean() > 6.0


def test_a_late_message_is_no_surer_than_it_is():
    """Monte Carlo: an estimate brought forward by half a second and more errs by no more than its variance."""
    fleet = co.load_fleet("town10").between(0, 200)
    recording = observe(fleet, S2, V2X(max_neighbours=6, rate=1.0), runs=20, observers=[0])
    known = NoiseModel.nominal(recording.sensors)
    own = solo_filter(recording, range(len(recording.ids)), known, FixNoise(known.gnss_variance))[:2]
    box, share = inbox(recording, 0, SPLIT.message), []
    for t, star in enumerate(stars(recording, 0, known, SPLIT.message, sent=own, growth=ESTIMATE_GROWTH)):
        age = t - box.newest[:, box.start[t] : box.start[t + 1]]
        gap = star.position[:, 1:] - fleet.position[t, star.member[1:]]
        late = (age >= 5) & np.isfinite(star.variance[:, 1:]).all(-1) & (t >= 20)
        share += [*(gap**2 / star.variance[:, 1:])[late]]
    assert 0.3 < np.array(share)[:, :2].mean() < 1.1


@pytest.mark.parametrize("method", METHODS, ids=label)
def test_bytes_by_closed_form(method, crossing):
    """One message per link and step: 14 numbers for an estimate with its covariance, 8 for a fix."""
    fleet = crossing.between(0, 12) if isinstance(method, QCQPRelaxation) else crossing  # semidefinite programmes
    recording = observe(fleet, S2, V2X(max_neighbours=3, overhead=10))
    numbers = 14 if method in FILTERS else 8
    track = method(recording, [1])
    assert (track.received_bytes == len(recording.links.of(1)) * (4 * numbers + 10)).all()
    assert (track.sent_bytes == len(fleet.t) * (4 * numbers + 10)).all()


@pytest.mark.parametrize("method", [*FILTERS[:2], QCQPRelaxation()], ids=label)
def test_what_has_not_arrived_is_not_used(method, crossing):
    """Poison: what the others measured at steps whose messages the inbox never yields changes nothing. An estimate
    remembers all fixes before it: there, those after the last message that is used."""
    recording = observe(crossing, S2, V2X(max_neighbours=4, rate=2.5, latency=0.2, loss=0.3))
    box = inbox(recording, 0, method.message)
    who = recording.links.neighbour[box.link]
    received = {(int(s), int(j)) for s, j in zip(box.newest[0], who, strict=True) if s >= 0}
    secret = np.array([[j > 0 and (t, j) not in received for j in range(8)] for t in range(60)])
    if method in FILTERS:
        secret = np.logical_and.accumulate(secret[::-1])[::-1]
    assert secret.sum() > 20
    gnss, relative = recording.gnss.copy(), recording.relative.copy()
    gnss[:, secret] += 500.0
    links = recording.links
    relative[:, (links.observer > 0) & secret[links.step, links.observer]] += [50.0, 5.0, 5.0]
    assert method(replace(recording, gnss=gnss, relative=relative), [0]).x == pytest.approx(
        method(recording, [0]).x, abs=1e-7
    )
