"""What `coopoc data check` names in logs with several faults at once, and that it names nothing in clean ones."""

import re
from typing import Any

import numpy as np
import pandas as pd
import pytest
from logs import noisy, star
from numpy import arange, exp, sin
from numpy.random import default_rng
from strange_logs import strange

import coopoc as co
from coopoc.data.log.check import check
from coopoc.data.log.residuals import begin_of
from coopoc.data.registry import read_log as load_log

PAIRS = {("drone0", "drone1"): 0.45, ("drone1", "drone3"): -0.25, ("drone0", "drone2"): 0.6}
TAGS = {"drone0": (0.4, 0.2, 0.1), "drone1": (-0.3, 0.4, 0.0), "drone2": (0.0, -0.5, -0.1), "drone3": (0.5, 0.0, 0.2)}
DRONES: dict[str, Any] = {"pairs": PAIRS, "clocks": {"drone1": 0.3, "drone3": -0.12}}
CONVOY: dict[str, Any] = {"wheels": {"car2": 0.03}, "tunnel": (60, 100), "pairs": {("car0", "car1"): 1.2}}
ROBOTS: dict[str, Any] = {"wheels": {"robot0": 0.03, "robot1": 0.03}, "unit": 1e-3}


def said(folder, options=""):
    return "\n".join(check(load_log(f"{folder}?{options}" if options else str(folder))).warnings)


@pytest.mark.parametrize("truth", [True, False])
@pytest.mark.parametrize("seed", [1, 2])
def test_offsets_of_drones_and_both_clocks_are_named(tmp_path, seed, truth):
    folder = strange(tmp_path / "log", "drone", seed, rate=seed, **DRONES)
    if not truth:
        (folder / "truth.csv").unlink()
    text = said(folder)
    found = {name: float(late) for name, late in re.findall(r"clock=(\w+):(-?[\d.]+\d)", text)}
    assert found == pytest.approx(DRONES["clocks"], abs=0.02)
    offsets = {frozenset(pair): float(by) for *pair, by in re.findall(r"(\w+) and (\w+) by (\S+) ", text)}
    assert offsets == pytest.approx({frozenset(pair): by for pair, by in PAIRS.items()}, abs=0.15)
    assert text.startswith("drone1: its filter errs by") == truth
    clocks = ",".join(f"{name}:{late}" for name, late in found.items())
    (taken,) = re.findall(r"(offset=\S+) takes", said(folder, f"clock={clocks}"))
    assert not re.search("clock=|offset=", said(folder, f"clock={clocks}&{taken}"))


@pytest.mark.parametrize("late", [0.0, 0.4])
def test_faults_of_a_convoy_are_named(tmp_path, late):
    text = said(strange(tmp_path / "log", "car", 3, late=late, **CONVOY))
    assert text.startswith("car2: its filter errs by")
    assert re.findall(r"(\w+): its odometry is too fast by (\d)", text) in ([("car2", "3")], [("car2", "2")])
    assert "ranges of car0 and car1 by +1.2" in text.replace("+1.1", "+1.2")
    assert "azimuths" not in text
    assert len(re.findall(r"fixes are 0\.[34]\d s behind the truth", text)) == 4 * (late > 0)


def test_millimetres_and_wheels_of_robots_are_named(tmp_path):
    folder = strange(tmp_path / "log", "robot", 4, **ROBOTS)
    text = said(folder, "frame=body")
    assert "scale=range:0.001 (of mm" in text
    assert re.findall(r"(\w+): its odometry is too fast by 3\.0|2\.9", text)
    assert "ranges scatter more than stated" in said(folder, "frame=body&scale=range:0.001&std=range:0.01")
    text = said(folder, "frame=body&scale=range:0.001")
    assert set(re.findall(r"(\w+): its odometry is too fast by", text)) == {"robot0", "robot1"}
    assert "ranges" not in text


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(
    ("kind", "fault", "taken"),
    [
        ("car", CONVOY, ""),
        ("drone", DRONES, "clock|offset"),
        ("drone", {"pairs": PAIRS, "body": True, "tags": TAGS}, ""),
        ("robot", ROBOTS, "scale"),
    ],
)
def test_the_filter_is_near_one_that_knows_the_faults(tmp_path, kind, fault, taken, seed):
    """The reference: the same filter on the same drive without what was planted, the tunnel but; the filter takes what
    the check prints of some options."""
    errors, frame = list[Any](), "frame=body" if kind == "robot" or "body" in fault else "frame=world"
    tags = ",".join(f"{name}:{'/'.join(map(str, tag))}" for name, tag in fault.get("tags", {}).items())
    for planted in (fault, {key: fault[key] for key in fault if key in ("tunnel", "body")}):
        folder = strange(tmp_path / str(len(errors)), kind, seed, **planted)
        printed = re.findall(rf"(?:{taken})=\S*\d", said(folder, frame)) if taken and not errors else []
        options = [frame, *printed, *[f"tag={tags}"] * ("tags" in planted)]
        log = load_log(f"{folder}?{'&'.join(options)}")
        begin, spread, _ = begin_of(log) if log.recording.body else (None, None, "")
        method = co.PoseFilter(begin=begin, spread=spread) if log.recording.body else co.CooperativeFilter()
        errors.append(co.rt_le(method(log.recording, log.recording.vehicles), log.truth).mean())
    assert errors[0] < (1.1 if tags else 1.3) * errors[1]


def test_wheels_that_spin_lead_no_smoother_astray(tmp_path):
    log = load_log(str(strange(tmp_path / "log", "car", 3, seconds=90, wheels={"car2": 0.9})))
    assert co.rt_le(co.BatchSmoother()(log.recording, log.recording.ids), log.truth).max() < 5.0


@pytest.mark.parametrize(
    ("kind", "hidden"), [("drone", []), ("car", []), ("car", ["heading", "heading_std"]), ("robot", [])]
)
def test_nothing_is_named_in_clean_logs(tmp_path, kind, hidden):
    rng, named = default_rng(len(kind)), []
    for seed in rng.integers(1000, size=3).tolist():
        options = {"rate": float(rng.choice([0.5, 1.0, 2.0])), "seconds": float(rng.choice([90, 180]))}
        folder = strange(tmp_path / f"{seed}", kind, seed, **options)
        pd.read_csv(folder / "log.csv").drop(columns=hidden).to_csv(folder / "log.csv")
        result = check(co.read_log(folder, frame="body" if kind == "robot" else "world"))
        named += result.warnings
        assert ("robot0" in str(result.unseen)) == (kind == "robot")
    assert not named


def test_ranges_of_a_convoy_look_like_no_scale_where_a_clock_differs_nor_a_short_drive_like_a_clock(tmp_path):
    assert said(strange(tmp_path / "short", "car", 2, 12)) == ""
    folder = strange(tmp_path / "log", "car", 1, clocks={"car1": 0.3})
    (folder / "truth.csv").unlink()
    assert re.fullmatch(r"car1: its clock is 0\.(2[5-9]|3)\S* \+- 0\.0[1-4]\S+ s ahead of .*", said(folder))


@pytest.mark.parametrize(("kind", "odometry", "truth"), [("car", 0, 1), ("drone", 0, 0), ("car", 1, 0), ("car", 1, 1)])
def test_a_base_station_that_is_lost_is_named(tmp_path, kind, odometry, truth):
    """All fixes shift by 5 m for 40 s; without odometry a truth shows it, or the fixes that jump. Understated
    noise is no shift."""
    folder = strange(tmp_path / "log", kind, 1)
    assert "at once" not in said(folder, "std=x:0.2,y:0.2")
    log = pd.read_csv(folder / "log.csv")
    part = log["t"].between(60, 100)
    log = log.assign(x=log["x"] + 4 * part, y=log["y"] - 3 * part)
    log.filter(regex="." if odometry else "^(?!speed|yaw|heading|v[xyz])").to_csv(folder / "log.csv")
    if not truth:
        (folder / "truth.csv").unlink()
    assert "all vehicles at once, from" in said(folder)


def test_a_position_filter_notes_offsets_of_pairs(tmp_path):
    for pairs, named in ((PAIRS, True), ({}, False)):
        recording = load_log(str(strange(tmp_path / f"{named}", "drone", 1, pairs=pairs))).recording
        for method, has in ((co.JointFilter(), named), (co.BatchSmoother(), named), (co.Kalman(), False)):
            assert ("drone0 and drone2 contradict fixes by an offset" in str(method(recording).notes)) == has


def test_what_lies_between_two_and_four_standard_errors_may_be(tmp_path):
    folder = strange(tmp_path / "log", "drone", 1, wheels={"drone1": 0.015}, pairs={("drone0", "drone3"): 0.21})
    (folder / "truth.csv").unlink()
    text = said(folder)
    assert re.search(r"drone1: its odometry may be too fast by 1", text), text
    assert re.search(r"drone0 and drone3 by \+0\.[12]\d+ \+- \S+ m may be off", text), text


OTHER = {"drone1": "drone2", "drone2": "drone1"}
OF_RANGES: dict[str, Any] = {
    r"drone0 to drone1 by \S+ m, as if to drone2": lambda f: {
        "partner": f["partner"].where(f["vehicle"] != "drone0", f["partner"].replace(OTHER))
    },
    r"drone1.*(18 s behind the truth|: its clock is 1[78]\.\d s ahead)": lambda f: {
        "t": f["t"] + 18 * (f["vehicle"] == "drone1")
    },
    r"ranges are 0\.[23]\d+ \+- \S+ s late": lambda f: {"t": f["t"] + 0.3 * f["range"].notna()},
    r"drone1: its clock is 10\.0 s ahead of .* by all ranges that are off": lambda f: {
        "t": f["t"] + 10 * ((f["vehicle"] == "drone1") & (f["t"] > 90))
    },
    r"ranges are too long by [45]\.\S+ \+- \S+ %: scale=": lambda f: {"range": 1.05 * f["range"]},
}


@pytest.mark.parametrize("truth", [True, False])
@pytest.mark.parametrize("words", OF_RANGES)
def test_what_ranges_share_is_named_and_no_offset_is(tmp_path, words, truth):
    folder = strange(tmp_path / "log", "drone")
    log = pd.read_csv(folder / "log.csv")
    log.assign(**OF_RANGES[words](log)).to_csv(folder / "log.csv")
    if not truth:
        (folder / "truth.csv").unlink()
    text = said(folder)
    assert re.search(words, text), text
    assert "offset=" not in text


PLACES = pd.DataFrame({"vehicle": [*"abcde"], "x": [-20.0, 20, 20, -20, 0], "y": [-20.0, -20, 20, 20, 30]})


@pytest.mark.parametrize("wrong", [0, 1])
def test_anchors_elsewhere_are_named_and_no_scale_is(tmp_path, wrong):
    """Walkers with a fix each: dead reckoning that drifts was ranges that are too long."""
    rng, t, tables, truth = default_rng(5), arange(0, 150, 0.2), list[pd.DataFrame](), list[pd.DataFrame]()
    for k, name in enumerate("uvw"):
        u = (1 + 0.3 * sin(0.3 * t)) * exp(1j * (0.07 * t + 2 * k))
        x = 5j * k + 0.2 * np.cumsum(u) - 0.1 * u
        true = {"x": (x.real, 0.5), "y": (x.imag, 0.5)}
        seen = {
            f"range_{one}": (abs(east + 1j * north - x), 0.1) for one, east, north in PLACES.itertuples(index=False)
        }
        tables.append(noisy(rng, t, name, {"vx": (u.real, 0.1), "vy": (u.imag, 0.1), **seen, **true}))
        tables[-1].loc[1:, ["x", "y"]] = np.nan
        truth.append(pd.DataFrame({"t": t, "vehicle": name, "x": x.real, "y": x.imag}))
    places = PLACES.copy()
    places.loc[[1] * wrong, ["x", "y"]] += [-1.5, 0.96]
    for frames, name in ((tables, "log"), (truth, "truth"), ([places], "places")):
        pd.concat(frames).to_csv(tmp_path / f"{name}.csv")
    text = said(tmp_path)
    assert re.fullmatch(
        r"b: it stands \+1\.[45]\d m east and -0\.9\d m north of its fix.*Correct its place\." * wrong, text
    )


def test_understated_ranges_are_named_without_a_truth(tmp_path):
    (strange(tmp_path, "drone", seconds=60) / "truth.csv").unlink()
    assert re.search(r"scatter more than stated.*std=range:0\.0[89]", said(tmp_path, "std=range:0.03"))


def test_a_hundred_anchors_are_read_without_a_word(tmp_path):
    """pandas warned of frames with more than a hundred columns, once for each of them."""
    rng, t = default_rng(2), arange(0, 40, 0.5)
    x, places = 10 * exp(0.1j * t), 20 * rng.uniform(-1, 1, (2, 110))
    ranges = abs(x[:, None] - places[0] - 1j * places[1]) + rng.normal(0, 0.01, (len(t), 110)) + 0.05
    table = {"x": x.real, "y": x.imag} | {f"range_m{k}": each for k, each in enumerate(ranges.T)}
    pd.DataFrame({"t": t, "vehicle": "a", **table}).to_csv(tmp_path / "log.csv")
    pd.DataFrame({"vehicle": [f"m{k}" for k in range(110)], "x": places[0], "y": places[1]}).to_csv(
        tmp_path / "places.csv"
    )
    log = load_log(str(tmp_path))
    assert len(log.recording.relative[0]) == 110 * len(t)
    assert not check(log).places


def test_a_receiver_that_loses_its_base_is_named(tmp_path):
    folder = strange(tmp_path / "log", "car", 1)
    log = pd.read_csv(folder / "log.csv")
    part = (log["vehicle"] == "car1") & log["t"].between(60, 100)
    noise = default_rng(0).normal(0, 10, (2, len(log))) * part.to_numpy()
    log.assign(x=log["x"] + noise[0], y=log["y"] + noise[1]).to_csv(folder / "log.csv")
    assert "car1: its fixes scatter by" in said(folder)


@pytest.mark.parametrize(
    ("pace", "factor", "words"),
    [(1.2, exp(0.1j), "turned by [56]"), (9.0, 1.04, "too fast by [34]"), (9.0, 0.96, "too slow by [34]")],
)
def test_odometry_of_one_that_errs_is_no_clock_of_others(tmp_path, pace, factor, words):
    rng, t, k = default_rng(5), arange(0, 150, 0.2), arange(4)[:, None]
    u = pace * (1 + 0.25 * sin(0.08 * t + k)) * exp(1.2j * sin(0.07 * t + 0.3 * k))
    x = 0.2 * np.cumsum(u, 1) - 0.1 * u + 9j * k
    u[1] *= factor
    ways = dict(zip("abcd", x, strict=True))
    pd.concat([star(t, rng, name, ways, own, ways[name]) for name, own in zip("abcd", u, strict=True)]).to_csv(
        tmp_path / "log.csv"
    )
    text = said(tmp_path)
    assert re.findall(rf"(\w): its odometry is {words}", text) == ["b"]
    assert text.count("its odometry") == 1
    assert "clock=" not in text


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("reverses", r"car1: its odometry .*fixes go back on [12]\d% of the way"),
        ("spins", r"car1: its odometry fails, .*6\d\S* to 9\d\S* s"),
    ],
)
def test_odometry_that_fails_in_a_part_is_no_fault_of_others(tmp_path, fault, words):
    """A car that reverses or slips for 30 s: clocks, scales and outliers of others were named for it."""
    folder = strange(tmp_path / "log", "car", 1)
    log = pd.read_csv(folder / "log.csv")
    part = (log["vehicle"] == "car1") & log["t"].between(60, 90)
    back, spins = part * (fault == "reverses"), part * (fault == "spins")
    log.assign(heading=log["heading"] + np.pi * back, speed=log["speed"] * (1 + spins)).to_csv(folder / "log.csv")
    text = said(folder)
    assert re.search(words, text), text
    assert not re.search("clock=|scale|outliers|NIS|ranges|car[023]:", text)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("receivers wander", "(?!.*(clock=|offset=|off for long))"),
        ("fixes are late", r"b: its fixes are 0\.[23]\d \+- \S+ s behind its odometry"),
        ("a clock", r"b: its clock is 0\.[23]\S+ \+- \S+ s ahead"),
    ],
)
def test_errors_that_last_are_no_fault_and_small_lags_are(tmp_path, fault, words):
    """Errors that last 30 s on a straight road were an offset of radios; 0.3 s were no lag."""
    rng, t, tables = default_rng(1), arange(0, 300, 0.5), list[pd.DataFrame]()
    wanders, swing = fault == "receivers wander", 0.1 * sin(0.06 * t)
    u = 20 * exp(1j * (swing if wanders else 12 * swing)) * (1 + swing)
    memory = exp(-arange(200) / 60)
    x = {name: 0.5 * np.cumsum(u) - 0.25 * u - 30 * k for k, name in enumerate("abc")}
    for name, way in x.items():
        late = 0.3 * (name == "b" and not wanders)
        noise = 0.22 * wanders * rng.normal(size=(2, len(t) + 199))
        east, north = (np.convolve(each, memory, "valid") for each in noise)
        seen = way - late * u * (fault == "fixes are late") + east + 1j * north
        tables.append(star(t + late * (fault == "a clock"), rng, name, x, u, seen))
    pd.concat(tables).to_csv(tmp_path / "log.csv")
    assert re.match(words, said(tmp_path), re.DOTALL)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda log: {"speed": log["speed"] * np.where(log["vehicle"] == "car1", -1, 1)}, r"scale=car1\.speed:-1"),
        (lambda log: {"x": log["x"] + 80 * ((log["vehicle"] == "car1") & (log["t"] % 7 > 6))}, "13.8% .* outliers"),
    ],
)
def test_faults_that_pose_filters_hide_are_named(tmp_path, change, words):
    """A filter turns its headings until fixes agree, and gates outliers."""
    folder = strange(tmp_path / "log", "car", 1, 60.0)
    log = pd.read_csv(folder / "log.csv").drop(columns=["heading", "heading_std"])
    log.assign(**change(log)).to_csv(folder / "log.csv")
    assert re.fullmatch(f"car1: .*{words}.*", said(folder, "frame=body"))
