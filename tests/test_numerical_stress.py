"""Noise from a tenth of a millimetre to ten kilometres, in line, far away, close together: estimates that stay sane."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import textbook
from logs import NOISE, drive
from numpy import arange, nan
from numpy.linalg import eigvalsh, norm
from numpy.random import default_rng

import coopoc as co
from coopoc.methods.catalogue import METHODS

STEPS = 15
COOPERATIVE = [name for name, make in METHODS.items() if make("nominal").cooperative]


def in_line(count, gap, offset=0.0):
    """Vehicles one behind the other along x at 10 m/s."""
    t = arange(STEPS) / 10
    position, velocity = np.full((STEPS, count, 3), offset), np.zeros((STEPS, count, 3))
    position[..., 0] += gap * arange(count) + 10.0 * t[:, None]
    velocity[..., 0] = 10.0
    return co.Fleet(tuple(f"v{i}" for i in range(count)), t, position, velocity)


def drawn(seed):
    """A fleet in line or scattered, each standard deviation anywhere within eight orders of magnitude."""
    rng = default_rng(seed)
    gap, count = float(10 ** rng.uniform(0.5, 2)), int(rng.integers(2, 7))
    fleet = in_line(count, gap)
    if rng.uniform() < 0.5:
        fleet = replace(fleet, position=fleet.position + rng.normal(0, gap, (1, count, 3)))

    def std(low, high):
        return float(10 ** rng.uniform(low, high))

    even = rng.uniform() < 0.5
    white = std(-4, 4)
    fix = (white, white, white) if even else (white, std(-4, 4), std(-4, 4))
    return fleet, co.Sensors(
        gnss_std=fix,
        range_std=min(gap, std(-4, 2)),
        azimuth_std=std(-6, -1),
        inclination_std=std(-6, -1),
        velocity_floor=std(-4, 2),
        velocity_std_ratio=std(-4, 0),
    )


def off(x, fleet):
    """Of the first vehicle, m."""
    return x[:, :, 0] - fleet.position[:, 0]


def observed(fleet, sensors, runs=2, seed=0):
    return co.observe(fleet, sensors, co.V2X(max_neighbours=10), runs=runs, seed=seed)


def situations():
    """Geometries and noises that leave little of sixteen digits."""
    for seed in range(8):
        yield f"drawn {seed}", *drawn(seed)
    poor = co.Sensors(gnss_std=(10.0, 10.0, 10.0), range_std=5.0)
    yield "collinear", in_line(8, 10.0), poor
    yield "collinear, closer than the range's noise", in_line(8, 3.0), poor
    spread = in_line(5, 0.0)
    place = default_rng(4).normal(0.0, 15.0, (5, 3)) * [1.0, 1.0, 0.3]
    spread = replace(spread, position=spread.position + place)
    for fix, std in (((264.0, 333.0, 390.0), (1.1e-4, 0.012, 0.092)), ((645.0, 113.0, 15.0), (20.0, 3e-5, 0.01))):
        noise = dict(zip(("range_std", "azimuth_std", "inclination_std"), std, strict=True))
        yield f"{std}, uneven, beside {fix}", spread, co.Sensors(gnss_std=fix, velocity_std_ratio=1e-3, **noise)  # type: ignore[arg-type]
    yield "10^6 m away", in_line(4, 10.0, 1e6), co.Sensors()
    yield "in one place", in_line(4, 0.0), co.Sensors()
    yield "10^-6 m apart", in_line(4, 1e-6), co.Sensors()
    yield "micrometres beside kilometres", in_line(4, 10.0), co.Sensors((1e3, 1e3, 1e3), range_std=1e-6)


@pytest.mark.parametrize(("fleet", "sensors"), [pytest.param(*rest, id=name) for name, *rest in situations()])
def test_estimates_stay_sane_where_digits_are_few(fleet, sensors):
    """No method leaves its own fixes by more than their noise may; every covariance is symmetric, none is negative."""
    recording = observed(fleet, sensors)
    fixes = abs(off(recording.gnss, fleet)).max()
    for name in COOPERATIVE:
        track = METHODS[name]("nominal")(recording, [0])
        assert abs(off(track.x, fleet)).max() < 5.0 * fixes + 5.0 * min(sensors.range_std, 1.0), name
        if track.covariance is not None:
            size = abs(track.covariance).max(axis=(-1, -2), keepdims=True)
            assert abs(track.covariance - track.covariance.mT).max() <= 1e-9 * size.max(), name
            assert (eigvalsh(track.covariance / size) > -1e-9).all(), name


def test_a_relative_measurement_that_outruns_the_digits_is_assumed_coarser_and_the_track_says_so():
    """Least std (3e-7 x 800 m x 1 m)^(1/2), with the range's 1 m: finer ones made the joint covariance negative."""
    fleet, sensors = in_line(4, 10.0), co.Sensors(gnss_std=(800.0, 2.0, 0.02), azimuth_std=1.5e-6, inclination_std=6e-6)
    track = co.JointFilter()(observed(fleet, sensors), [0])
    assert any("at least 0.015 m and rad" in note for note in track.notes)
    assert (eigvalsh(track.covariance) > 0.0).all()
    assert not co.JointFilter()(observed(fleet, co.Sensors()), [0]).notes


@pytest.mark.parametrize("damage", [np.diag([1.0, -1e-6, 1.0]), np.eye(3) + 2 * (np.eye(3, k=1) + np.eye(3, k=-1))])
def test_a_track_notes_covariances_that_are_none(damage):
    track = co.Kalman()(observed(in_line(2, 9.0), co.Sensors()), [0])
    assert not track.notes
    covariance = track.covariance.copy()
    covariance[1, 3:5, 0] = damage
    noted = replace(track, covariance=covariance)
    assert noted.notes[0].startswith(f"2 of {2 * STEPS} covariances are not symmetric and positive semidefinite")
    assert replace(noted, seconds=1.0).notes == noted.notes


def test_covariances_that_are_fused_again_and_again_stay_what_they_are():
    """What rounding makes of symmetry grew by 1 / weight in each fusion, until eigenvalues were -1e53 m^2."""
    fine = co.Sensors((0.01, 0.01, 0.01), range_std=0.02, azimuth_std=0.02)
    recording = co.observe(drive(), fine, co.V2X(max_neighbours=3), frame="body")
    gnss = recording.gnss.copy()
    gnss[:, 1:, 1:] = nan  # one alone has fixes
    track = co.PoseFilter(fusion="intersection")(replace(recording, gnss=gnss), recording.ids)
    assert "symmetric and positive semidefinite" not in str(track.notes)


def test_the_smoother_descends_where_whole_steps_lead_away():
    """Azimuths of 9 degrees, ranges of a tenth of a millimetre, poor fixes: undamped Gauss-Newton ends 36 km off."""
    fleet = in_line(5, 11.84)
    sensors = co.Sensors(
        gnss_std=(0.8, 19.0, 58.0),
        velocity_floor=0.04,
        velocity_std_ratio=0.018,
        range_std=1e-4,
        azimuth_std=0.155,
        inclination_std=6e-4,
    )
    recording = observed(fleet, sensors, 6, 13)
    error = norm(off(co.BatchSmoother()(recording, [0]).x, fleet), axis=-1)
    assert error.max() < 3.0 * abs(off(recording.gnss, fleet)).max()


def errors_of(names, words, drives):
    """Rms error of the first vehicle, m; all but kalman say the words in a note."""
    squares: dict[str, list[np.ndarray]] = {}
    for fleet, recording in drives:
        for name in names.split():
            track = METHODS[name]("nominal")(recording, [0])
            squares.setdefault(name, []).append((off(track.x, fleet) ** 2).sum(-1))
            assert name == "kalman" or any(words in note for note in track.notes), name
    return {name: float(np.sqrt(np.mean(found))) for name, found in squares.items()}


@pytest.mark.parametrize(("range_std", "angle_std"), [(0.05, 0.3), (0.001, 1.0), (1e-4, 0.1)])
def test_a_fine_range_in_a_coarse_direction_is_not_taken_for_exact(range_std, angle_std):
    """Uncertain angles put a neighbour on an arc. Taken as stated, joint is 34, 42 and 12 m off, and LKF-SA's edge form
    6, 31 and 2 m, where a filter of the ego alone is 0.7 m off; and claims centimetres."""
    drives = []
    for seed in (1, 2):
        fleet, rng = in_line(4, 0.0), default_rng(seed)
        place = rng.uniform(-20, 20, (1, 4, 3)) * [1.0, 1.0, 0.0]
        fleet = replace(fleet, position=fleet.position + place)
        sensors = co.Sensors((1.5, 1.5, 1.5), range_std=range_std, azimuth_std=angle_std, inclination_std=angle_std)
        drives.append((fleet, observed(fleet, sensors, 6, seed)))
    names = "kalman lkf-sa-edge joint ci split-ci batch-smoother"
    error = errors_of(names, ", by the whole drive (not causal): angles of ", drives)
    assert all(each < 4.0 * error["kalman"] for each in error.values()), error


def without_azimuth(recording):
    relative = recording.relative.copy()
    relative[..., 1] = nan
    return replace(recording, relative=relative)


def test_fine_ranges_alone_bend_as_fixes_are_uncertain():
    """UWB of 1 mm between fixes of 1.5 m, 20 m apart. Taken as stated, joint was 1 m off, where a filter of the ego
    alone is 0.7 m off."""
    drives = []
    for seed in (1, 2, 3):
        rng, t = default_rng(seed), arange(60) / 10
        heading = rng.uniform(0, 2 * np.pi, 4) + np.cumsum(rng.normal(0, 0.02, (60, 4)), 0)
        velocity = 8.0 * np.stack([np.cos(heading), np.sin(heading), 0 * heading], -1)
        position = np.append(rng.uniform(-20, 20, (4, 2)), np.zeros((4, 1)), 1) + np.cumsum(velocity / 10, 0)
        sensors = co.Sensors((1.5, 1.5, 1.5), range_std=1e-3)
        fleet = co.Fleet(tuple("abcd"), t, position, velocity)
        drives.append((fleet, without_azimuth(co.observe(fleet, sensors, co.V2X(5, radius=200.0), runs=3, seed=seed))))
    error = errors_of("kalman joint lkf-sa-edge batch-smoother", "no azimuth put what is", drives)
    assert all(each < 1.05 * error["kalman"] for each in error.values()), error


def test_ranges_between_rare_fixes_say_no_more_than_where_they_point():
    """Three vehicles abreast, ranges at 5 Hz, a fix every 20 s. With each range taken for new joint is
    1.69 m off, where a filter of the ego alone is 1.58 m off."""
    fleet = drive(3, 600, 0.2, gap=12.0)
    seen = co.observe(fleet, NOISE, co.V2X(5), runs=6)
    rare = np.where(arange(600)[:, None, None] % 100, nan, seen.gnss)
    velocity = seen.velocity + default_rng(0).normal(0, 0.1, seen.velocity.shape)
    seen = without_azimuth(replace(seen, gnss=rare, velocity=velocity))
    error = errors_of("kalman joint", "100 ranges of a pair to a fix", [(fleet, seen)])
    assert all(each <= error["kalman"] for each in error.values()), error


def test_ranges_that_noise_reflects_at_zero_are_noted():
    seen = observed(in_line(4, 10.0), co.Sensors(range_std=1e3))
    assert any("none is negative" in note for note in co.JointFilter()(seen, [0]).notes)


def test_an_estimate_that_its_fixes_contradict_is_noted():
    """Ranges fifty times as long as stated move the estimate away from the ego's fixes, which a note reports."""
    seen = observed(in_line(4, 10.0), co.Sensors())
    wrong = replace(seen, relative=seen.relative * [50.0, 1.0, 1.0])
    method = textbook(co.JointFilter())
    assert not any("fixes, " in note for note in method(seen, [0]).notes)
    assert any("far from its estimates; it is lost, or rejects them (0 to " in n for n in method(wrong, [0]).notes)
