"""Solo filters against textbook oracles, with gaps and absences; what the noise-adaptive one estimates."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import refused, textbook, winding
from numpy.testing import assert_allclose
from oracles import solo as oracle
from scipy import stats

from coopoc import GNSS, V2X, Fleet, Kalman, NoiseModel, Recording, Sensors, observe
from coopoc.arrays import Floats
from coopoc.evaluate.metrics import nees, nees_inside, rt_le
from coopoc.kernels.solo import FixNoise
from coopoc.methods.kalman import ASSUMED, AdaptiveKalman, solo_filter

DRIVE = winding(900, 10.0, 7.0)
DEFAULT, FOREVER = AdaptiveKalman(), AdaptiveKalman(window=np.inf)


def seen(std: tuple[float, float, float], runs: int, seed: int = 0, steps: int = 900) -> Recording:
    return observe(winding(steps, 10.0, 7.0), Sensors(gnss_std=std), V2X(max_neighbours=0), runs=runs, seed=seed)


def test_the_estimate_converges_within_its_chi_square_error() -> None:
    """After T fixes a variance is known to sqrt(2 / T); 60 runs show mean and spread, per axis."""
    std, runs = (1.5, 2.5, 3.5), 60
    found = FOREVER.gnss_std(seen(std, runs))[:, -1, 0] ** 2 / np.square(std)
    error = np.sqrt(2 / 900)
    assert found.mean(axis=0) == pytest.approx(np.ones(3), abs=3 * error / np.sqrt(runs) + 5 / 900)
    low, high = np.sqrt(stats.chi2.ppf([0.001, 0.999], runs - 1) / (runs - 1))
    assert (found.std(axis=0, ddof=1) > 0.9 * low * error).all()
    assert (found.std(axis=0, ddof=1) < 1.1 * high * error).all()


def test_a_jump_of_the_noise_is_followed() -> None:
    """From 1.5 to 3.5 m in the middle of the drive, and back: the mean of 100 runs forgets as 0.99^fixes."""
    low, high = seen((1.5,) * 3, runs=100), seen((3.5,) * 3, runs=100, seed=1)
    for first, then, before, after in ((low, high, 1.5, 3.5), (high, low, 3.5, 1.5)):
        gnss = np.concatenate([first.gnss[:, :450], then.gnss[:, 450:]], axis=1)
        found = np.mean(DEFAULT.gnss_std(replace(first, gnss=gnss)) ** 2, axis=(0, 2, 3))
        assert np.sqrt(found[449]) == pytest.approx(before, rel=0.03)
        for fixes in (50, 100, 200, 400):
            expected = after**2 + (before**2 - after**2) * 0.99**fixes
            assert np.sqrt(found[449 + fixes]) == pytest.approx(np.sqrt(expected), rel=0.06)


@pytest.mark.parametrize("std", [1.5, 3.5])
def test_one_set_of_defaults_is_as_good_as_knowing_the_noise(std: float) -> None:
    """Within 1 % of the filter that knows the variances, and its NEES in the band, at 1.5 and 3.5 m."""
    recording = seen((std,) * 3, runs=60)
    track, known = DEFAULT(recording), Kalman("nominal")(recording)
    assert rt_le(track, DRIVE).mean() < 1.01 * rt_le(known, DRIVE).mean()
    assert nees_inside(track, DRIVE)[0] >= 0.95
    assert 2.7 < nees(track, DRIVE).mean() < 3.3
    assert track.notes == ("assumes velocity noise of 10 % of each axis, at least 0.02 m/s",)


def test_steps_without_a_fix_teach_nothing() -> None:
    stream = DEFAULT.start()
    draw = np.random.default_rng(0)
    for _ in range(20):
        stream.step(draw.normal(0, 3, 3), np.zeros(3), 0.1)
    before = stream.state
    for _ in range(5):
        x, cov = stream.step(None, [9.0, 0.0, 0.0], 0.1)
    after = stream.state
    assert before is not None
    assert after is not None
    np.testing.assert_array_equal(after.noise, before.noise)
    np.testing.assert_array_equal(after.weight, before.weight)
    assert_allclose(x, before.x + np.array([4.5, 0.0, 0.0]))
    grown = np.diag(cov) - (before.share * before.noise + before.motion)
    std = ASSUMED.motion_std(np.array(20 * [[0.0, 0.0, 0.0]] + 5 * [[9.0, 0.0, 0.0]])[None, :, None], 0.1)
    assert_allclose(grown, (std[0, 20:, 0] ** 2).sum(axis=0))


def test_late_fixes_do_not_count_as_noisy() -> None:
    """Motion since a late fix is not taken for GNSS noise, even where it is as large: 0.3 m, all fixes 0.5 s late."""
    std, runs, late = (0.3, 0.3, 0.3), 8, 5
    recording, found = seen(std, runs), []
    start = replace(DEFAULT, assumed=replace(ASSUMED, gnss_std=std))
    for run in range(runs):
        stream = start.start()
        for t in range(late, 900):
            fix = recording.gnss[run, t - late, 0] if t >= 2 * late else None
            stream.step(fix, recording.velocity[run, t, 0], 0.1, fix_age=0.1 * late)
            found += [] if fix is None else [stream.state.noise]
    assert np.sqrt(np.mean(found)) == pytest.approx(0.3, rel=0.05)


def test_a_known_variance_gives_kalman_with_late_and_missing_fixes() -> None:
    sensors, draw = Sensors(), np.random.default_rng(4)
    ours = replace(FOREVER, assumed=sensors, prior_weight=np.inf).start()
    theirs = Kalman(NoiseModel.nominal(sensors)).start()
    for stream in (ours, theirs):
        stream.step(np.zeros(3), np.zeros(3), 0.1)
    for k in range(200):
        fix = None if draw.uniform() < 0.3 else draw.normal(0, 3, 3)
        given = {"gnss": fix, "velocity": draw.normal(0, 9, 3), "dt": draw.uniform(0.05, 0.3)}
        late = draw.uniform(0, 0.5) * (k > 20)
        for a, b in zip(ours.step(**given, fix_age=late), theirs.step(**given, fix_age=late), strict=True):
            assert_allclose(a, b, atol=1e-12)


def test_bad_settings_are_named() -> None:
    recording = seen((2.0,) * 3, runs=1, steps=5)
    for field, make in {
        "prior_weight": lambda: AdaptiveKalman(prior_weight=0.0),
        "window": lambda: AdaptiveKalman(window=-1.0),
        "velocity_floor": lambda: AdaptiveKalman(Sensors(velocity_floor=0.0))(recording),
        "x0": lambda: AdaptiveKalman(x0=np.zeros((2, 3)))(recording),
    }.items():
        with refused(f"^{field} = "):
            make()


S2 = Sensors.paper_scenario2()


def gaps(fleet: Fleet, absent: bool, runs: int = 3) -> Recording:
    """Some fixes missing everywhere, and one vehicle that is away for a while."""
    position, velocity = fleet.position.copy(), fleet.velocity.copy()
    if absent:
        position[20:30, 1], velocity[20:30, 1] = np.nan, np.nan
    recording = observe(replace(fleet, position=position, velocity=velocity), S2, V2X(max_neighbours=0), runs=runs)
    gnss, gone = recording.gnss.copy(), np.random.default_rng(2).uniform(size=recording.gnss.shape[:3]) < 0.4
    gone[:, 0] = False
    gone[:, 30] = False
    gnss[gone] = np.nan
    return replace(recording, gnss=gnss)


def series(seen: Recording, q: Floats, r: Floats, *at: int) -> tuple[Floats | float, ...]:
    """Fixes, velocities and variances of one axis of a vehicle, and dt."""
    run, n, c = at
    return *(part[run, :, n, c] for part in (seen.gnss, seen.velocity, q)), r[c], seen.dt


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("noise", ["nominal", "identity"])
def test_kalman(crossing: Fleet, noise: str, known: bool) -> None:
    seen = gaps(crossing, absent=True)
    model = NoiseModel.identity() if noise == "identity" else NoiseModel.nominal(S2)
    q, r = np.broadcast_to(model.process_variance(seen, first=int(known)), seen.gnss.shape), model.gnss_variance
    start = crossing.position[0] if known else None
    x, p, _ = solo_filter(seen, range(len(seen.ids)), model, FixNoise(r), start)
    for run, n, c in np.ndindex(3, 4, 3):
        mean, variance = oracle.kalman(*series(seen, q, r, run, n, c), None if start is None else start[n, c])
        assert_allclose(x[run, :, n, c], mean, rtol=1e-12, atol=1e-12)
        assert_allclose(p[run, :, n, c], variance, rtol=1e-10)


@pytest.mark.parametrize("runs", [1, 3])
def test_adaptive(crossing: Fleet, runs: int) -> None:
    seen, method = gaps(crossing, absent=False, runs=runs), textbook(AdaptiveKalman(window=20.0))
    model = NoiseModel.nominal(method.assumed)
    q, r = model.process_variance(seen), model.gnss_variance
    track, std = method(seen, [2, 0]), method.gnss_std(seen, [2, 0])
    for run, (e, n), c in ((a, b, c) for a in range(runs) for b in enumerate([2, 0]) for c in range(3)):
        mean, noise = oracle.adaptive(*series(seen, q, r, run, n, c), 5.0, 20.0)
        assert_allclose(track.x[run, :, e, c], mean, rtol=1e-11, atol=1e-11)
        assert_allclose(std[run, :, e, c] ** 2, noise, rtol=1e-10)


def test_gnss_holds_the_last_fix(crossing: Fleet) -> None:
    seen = gaps(crossing, absent=False)
    track = GNSS()(seen, [1, 3])
    assert 0 < track.seconds < 60
    for t in range(len(seen.t)):
        newest = max(k for k in range(t + 1) if np.isfinite(seen.gnss[0, k, 1]).all())
        np.testing.assert_array_equal(track.x[0, t, 0], seen.gnss[0, newest, 1])
    missing = np.isnan(seen.gnss[:, :, [1, 3], 0]).mean()
    assert track.notes == (f"holds the last fix where there is none: {100 * missing:.0f} % of the steps",)
