"""Outliers: their rates, sizes and durations, pairs with clean draws, what an estimator is told, and the bounds."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import among, refused
from numpy import array_equal, nan
from numpy.linalg import norm

from coopoc import V2X, Fault, Outliers, Sensors, observe
from coopoc.world.links import to_vector, wrap
from coopoc.world.sensing import episodes
from coopoc.world.storage import read_recording, save_recording

S2 = Sensors.paper_scenario2()
ALL = Outliers(
    ranges=Fault(0.05, (3.0, 20.0), lasts=1.0),
    angles=Fault(0.02),
    fixes=Fault(0.1, (10.0, 50.0), lasts=2.0),
    outages=Fault(0.05, lasts=2.0),
    odometry=Fault(0.1, (0.2, 1.0), lasts=0.5),
)


def seen(fleet, outliers=ALL, **options: object):
    return observe(fleet, replace(S2, outliers=outliers), V2X(max_neighbours=4), **{"runs": 3, **options})


@pytest.mark.parametrize("lasts", [0.0, 0.7])
def test_a_fault_has_the_rate_the_size_and_the_duration_that_it_names(lasts):
    """The state is redrawn with probability 1 - exp(-dt / lasts), so that it is correlated as a Gauss-Markov error."""
    dt, steps = 0.1, 400_000
    uniform, rare = (episodes(Fault(q, (3, 20), lasts=lasts), (0, "x", 0, "a", "b"), steps, dt) for q in (0.2, 0.05))
    long = episodes(Fault(0.2, (3, 20), "exponential", lasts), (0, "x", 0, "a", "b"), steps, dt)
    independent = steps * np.tanh(0.5 * dt / lasts) if lasts else steps
    assert abs(uniform.wrong.mean() - 0.2) < 4 * 0.4 / np.sqrt(independent)
    assert uniform.wrong[rare.wrong].all()
    assert array_equal(uniform.size[rare.wrong], rare.size[rare.wrong])
    assert abs(uniform.size.mean() - 11.5) < 4 * 17 / np.sqrt(12 * independent)
    assert abs(long.size.mean() - 20.0) < 4 * 17 / np.sqrt(independent)
    assert min(uniform.size.min(), long.size.min()) >= 3
    centred = uniform.wrong - uniform.wrong.mean()
    keep = np.exp(-dt / lasts) if lasts else 0.0
    assert (centred[1:] * centred[:-1]).mean() / centred.var() == pytest.approx(keep, abs=0.02)


def test_without_a_rate_nothing_changes_by_a_bit(crossing):
    none = Outliers(ranges=Fault(0.0, (5.0, 6.0), "exponential", 3.0))
    for frame in ("world", "body"):
        clean, same = (seen(crossing, o, frame=frame) for o in (Outliers(), none))
        for name in ("gnss", "velocity", "relative"):
            assert array_equal(getattr(clean, name), getattr(same, name))
        assert same.notes == ()


@pytest.mark.parametrize("frame", ["world", "body"])
def test_outliers_are_added_to_the_clean_draws(crossing, frame):
    clean, bad = (seen(crossing, o, frame=frame, runs=20) for o in (Outliers(), ALL))
    longer = bad.relative[..., 0] - clean.relative[..., 0]
    hit = longer != 0
    assert abs(hit.mean() - 0.05) < 0.015
    assert longer[hit].min() + 1e-9 >= 3.0
    assert longer.max() < 20.0 + 1e-9
    jump = norm(bad.gnss - clean.gnss, axis=-1)
    assert abs(np.isnan(jump).mean() - 0.05) < 0.02
    assert abs((jump > 1e-9).mean() - 0.1 * 0.95) < 0.03
    assert jump[jump > 1e-9].min() + 1e-9 >= 10.0
    assert np.nanmax(jump) < 50.0 + 1e-9
    assert not np.isnan(bad.gnss[:, 0]).any()
    assert array_equal(bad.gnss[:, 0], clean.gnss[:, 0])
    everywhere = seen(crossing, Outliers(fixes=Fault(1.0, (10.0, 10.0))), frame=frame, runs=20).gnss - clean.gnss
    assert abs(everywhere[:, 1:].mean(axis=(0, 1, 2))).max() < 0.3  # of 10 m in any direction
    assert abs((abs(bad.velocity - clean.velocity).max(-1) > 1e-9).mean() - 0.1) < 0.03
    assert bad.sensors == clean.sensors
    assert [note.split()[0] for note in bad.notes] == ["5", "2", "10", "5", "10"]


def test_a_slip_is_a_share_of_the_true_motion(crossing):
    clean, bad = (seen(crossing, o, runs=20) for o in (Outliers(), ALL))
    speed = norm(crossing.velocity, axis=-1)
    share = np.einsum("rtni,tni->rtn", bad.velocity - clean.velocity, crossing.velocity) / speed**2
    wrong = abs(share) > 1e-9
    assert abs(share[wrong]).min() > 0.2 - 1e-6
    assert abs(share[wrong]).max() < 1.0 + 1e-6
    assert 0.35 < (share[wrong] > 0).mean() < 0.65
    assert bad.velocity - clean.velocity == pytest.approx(share[..., None] * crossing.velocity, abs=1e-9)


def test_a_wrong_association_is_the_direction_of_the_nearest_other_vehicle(crossing):
    exact = replace(S2, range_std=1e-9, azimuth_std=1e-9, inclination_std=1e-9)
    v2x = V2X(max_neighbours=4)
    clean, bad = (
        observe(crossing, replace(exact, outliers=o), v2x, runs=4) for o in (Outliers(), Outliers(angles=Fault(0.1)))
    )
    hit = abs(wrap(bad.relative[..., 1] - clean.relative[..., 1])) > 1e-6
    assert 0.05 < hit.mean() < 0.12
    assert array_equal(bad.relative[..., 0], clean.relative[..., 0])
    direction = to_vector(bad.relative / [1, 1, 1]) / bad.relative[..., :1]
    for run, link in np.argwhere(hit)[::7]:
        t, i, j = (int(side[link]) for side in (bad.links.step, bad.links.observer, bad.links.neighbour))
        place = crossing.position[t]
        others = [k for k in range(len(place)) if k not in (i, j) and 2 <= norm(place[k] - place[i]) <= 30]
        nearest = min(others, key=lambda k: norm(place[k] - place[j]))
        expected = (place[nearest] - place[i]) / norm(place[nearest] - place[i])
        assert direction[run, link] == pytest.approx(expected, abs=1e-6)


def test_a_range_past_an_obstacle_is_too_long_for_both_vehicles(crossing):
    clean, bad = (seen(crossing, o) for o in (Outliers(), Outliers(ranges=Fault(0.3, (3.0, 20.0), lasts=1.0))))
    late = {
        (r, int(bad.links.step[k]), int(bad.links.observer[k]), int(bad.links.neighbour[k])): value
        for r in range(3)
        for k, value in enumerate(bad.relative[r, :, 0] - clean.relative[r, :, 0])
    }
    both = [(key, (key[0], key[1], key[3], key[2])) for key in late if (key[0], key[1], key[3], key[2]) in late]
    assert len(both) > 100
    assert all(late[one] == pytest.approx(late[other], abs=1e-9) for one, other in both)


def test_draws_are_keyed_by_what_they_belong_to(crossing):
    """30 runs are a prefix of 100, a shorter drive of a longer one, K = 2 of K = 4; and one kind changes no other."""
    base = seen(crossing, runs=5)
    fewer, shorter = seen(crossing, runs=2), seen(crossing.between(0, 30), runs=2)
    assert array_equal(fewer.gnss, base.gnss[:2], equal_nan=True)
    assert array_equal(shorter.gnss, base.gnss[:2, :30], equal_nan=True)
    assert array_equal(shorter.velocity, base.velocity[:2, :30])
    few = observe(crossing, replace(S2, outliers=ALL), V2X(max_neighbours=2), runs=5)
    assert array_equal(few.relative, base.relative[:, among(base.links, few.links)])
    assert array_equal(seen(crossing, Outliers(ranges=ALL.ranges), runs=5).relative[..., 0], base.relative[..., 0])


@pytest.mark.parametrize("frame", ["world", "body"])
def test_what_is_told_is_what_differs_from_the_clean_recording(crossing, frame):
    clean, bad, told = (
        seen(crossing, o, frame=frame, remove_outliers=t) for o, t in ((Outliers(), 0 > 1), (ALL, 0 > 1), (ALL, True))
    )
    by_hand = np.where(bad.relative == clean.relative, clean.relative, nan)
    by_hand[..., 2] = np.where(np.isnan(by_hand[..., 1]), nan, by_hand[..., 2])
    assert array_equal(told.relative, by_hand, equal_nan=True)
    assert array_equal(told.gnss, np.where(bad.gnss == clean.gnss, clean.gnss, nan), equal_nan=True)
    assert array_equal(told.velocity, clean.velocity)
    assert all(note.endswith("removed") for note in told.notes)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: Fault(1.5), "rate"),
        (lambda: Fault(0.1, (5.0, 3.0)), "size"),
        (lambda: Fault(0.1, 3.0), "size"),  # type: ignore[arg-type]
        (lambda: Fault(0.1, law="normal"), "law"),  # type: ignore[arg-type]
        (lambda: Fault(0.1, lasts=-1.0), "lasts"),
        (lambda: Outliers(ranges=0.1), "ranges"),  # type: ignore[arg-type]
        (lambda: Sensors(outliers=0.1), "outliers"),  # type: ignore[arg-type]
        (lambda: Outliers.named("urban_canyn"), "urban_canyon"),
        (lambda: Outliers.named("ranges=2"), "rate"),
        (lambda: Outliers.named("ranges=many"), "ranges"),
        (lambda: Outliers.named("ranges"), "ranges"),
    ],
)
def test_a_wrong_setting_is_named(make, field):
    with refused(field):
        make()  # type: ignore[operator]


def test_settings_of_studies_name_presets_and_rates():
    assert Outliers.named("") == Outliers()
    found = Outliers.named("urban_canyon+uwb_nlos+angles=0.01")
    assert (found.fixes, found.ranges) == (Outliers.urban_canyon().fixes, Outliers.uwb_nlos().ranges)
    assert found.angles == Fault(0.01)
    assert Outliers.named("ranges=0.05:2").ranges == Fault(0.05, (3.0, 20.0), lasts=2.0)
    assert Outliers.named("fixes=0.05").fixes == Fault(0.05, (10.0, 50.0), lasts=10.0)
    assert found.odometry.rate == 0
    assert found.notes == (  # the shares, sizes and times of the sources in the docstrings
        "5 % of the ranges 0.3 to 0.42 m too long, exponential, for 0.5 s",
        "1 % of the angles those of another vehicle",
        "10 % of the fixes 10 to 50 m off, for 10 s",
        "5 % of the fixes missing, for 5 s",
    )


def test_a_recording_that_assumes_outliers_is_saved_with_them(crossing, tmp_path):
    base = seen(crossing.between(0, 3))
    kept = replace(base, sensors=replace(base.sensors, outliers=ALL))
    save_recording(kept, tmp_path / "kept.npz")
    found, _ = read_recording(tmp_path / "kept.npz")
    assert found.sensors == kept.sensors
    assert found.notes == base.notes
