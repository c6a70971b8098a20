"""Worlds: what they draw, which fault changes what, and the cards of methods on them."""

import json
import math
import re
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from conftest import refused
from numpy import array_equal
from shell import ROOT

import coopoc as co
from coopoc.cli import _status
from coopoc.studies import benchmark, worlds_card
from coopoc.studies.world_faults import KINDS
from coopoc.studies.worlds import SPLITS, world

CHANGES = {
    "noise levels": {"fixes of egos", "fixes of others", "velocities", "range", "azimuth", "inclination"},
    "drift, told": {"fixes of egos", "fixes of others", "sensors"},
    "drift, not told": {"fixes of egos", "fixes of others"},
    "compass, told": {"velocities", "azimuth", "sensors"},
    "compass, not told": {"velocities", "azimuth"},
    "odometer scale, told": {"velocities", "sensors"},
    "odometer scale, not told": {"velocities"},
    "odometer slip": {"velocities"},
    **{f"no fixes{at}": {"fixes of egos"} for at in ("", ", at first")},
    **{f"own receiver, {how}": {"fixes of egos"} for how in ("jump", "creep", "from the start")},
    "multipath": {"fixes of egos", "fixes of others"},
    "NLOS": {"range"},
    "mistaken angles": {"azimuth", "inclination"},
    "range offset, told": {"range", "sensors"},
    "range offset, not told": {"range"},
    "measured, ranges only": {"azimuth", "inclination"},
    "measured, angles only": {"range"},
    "measured, inclinations only": {"range", "azimuth"},
    "measured, nothing": {"range", "azimuth", "inclination"},
    "late messages": {"messages", "channel"},
    "lost messages": {"messages", "channel"},
    "come and go": {"members", "fixes of others", "velocities"},
    "clock offsets": {"fixes of others", "velocities"},
    "liars, jump": {"fixes of others"},
    "liars, creep": {"fixes of others"},
    "liars, collusion": {"fixes of others"},
    "liars, replay": {"fixes of others", "velocities"},
    "liars, Sybil": {"members", "fixes of others"},
}
"""Kind of fault -> all that may differ from the world without it, and does in some worlds."""


@lru_cache
def drawn():
    return tuple(world(seed) for seed in range(300))


def with_kind(kind):
    found = [one for one in drawn() if kind in one.kinds]
    assert found, kind
    return found


def parts(one):
    """What methods see, in parts; those of links are None where the links themselves may differ."""
    seen = one.recording
    others = np.setdiff1d([k for k, name in enumerate(seen.ids) if not name.startswith("ghost")], one.egos)
    return {
        "fixes of egos": seen.gnss[:, :, list(one.egos)],
        "fixes of others": seen.gnss[:, :, others],
        "velocities": seen.velocity[:, :, : others.size + len(one.egos)],
        "range": seen.relative[..., 0],
        "azimuth": seen.relative[..., 1],
        "inclination": seen.relative[..., 2],
        "messages": np.append(seen.arrival.ravel(), seen.broadcasts),
        "members": np.array([*seen.ids, seen.links.neighbour.tobytes()]),
        "sensors": repr(seen.sensors),
        "channel": repr(seen.v2x),
    }


def different(one, other):
    first, second = parts(one), parts(other)
    of_links = {"range", "azimuth", "inclination", "messages"}
    same_links = array_equal(first["members"], second["members"])
    return {
        name
        for name, value in first.items()
        if (same_links or name not in of_links)
        and not (
            value == second[name]
            if isinstance(value, str)
            else array_equal(value, second[name], equal_nan=value.dtype.kind == "f")
        )
    }


def test_a_world_is_the_same_whenever_it_is_drawn():
    np.random.seed(1)  # noqa: NPY002
    again = world(11)
    assert not different(again, drawn()[11])
    assert (again.text, again.kinds, again.egos) == (drawn()[11].text, drawn()[11].kinds, drawn()[11].egos)
    assert again.fleet.digest == drawn()[11].fleet.digest


def test_splits_share_no_draw():
    first = [one.recording.gnss[0, 0, 0, 0] for split in SPLITS for one in (world(k, split) for k in range(20))]
    assert len({*first}) == 60
    towns = {split: {one.fleet.position[0, 0, 0] for one in (world(k, split) for k in range(20))} for split in SPLITS}
    assert not towns["test"] & (towns["validation"] | towns["development"])


def test_a_fifth_of_the_worlds_has_no_fault_and_no_world_more_than_three():
    counts = np.bincount([len(one.kinds) for one in drawn()], minlength=4)
    assert len(counts) == 4
    assert 0.15 < counts[0] / 300 < 0.3
    assert all(one.recording.notes == () for one in drawn())
    for one in drawn():
        assert one.recording.runs == 4
        assert 39 < one.fleet.t[-1] < 61
        assert one.recording.columns(one.egos) == [*one.egos]


@pytest.mark.parametrize("kind", KINDS)
def test_a_fault_changes_what_it_says_and_nothing_else(kind):
    found = set[str]()
    for one in with_kind(kind):
        changed = different(one, world(one.seed, without=[kind]))
        assert changed <= CHANGES[kind], one.text
        found |= changed
    assert found == CHANGES[kind]


def test_a_slip_alters_the_velocities_of_its_interval_alone():
    for one in with_kind("odometer slip"):
        right = world(one.seed, without=["odometer slip"]).recording.velocity[:, :, list(one.egos)]
        wrong = one.recording.velocity[:, :, list(one.egos)]
        factor, start, stop = map(float, re.findall(r"velocities times (\S+), (\d+) to (\d+) s", one.text)[0])
        t, dt = one.recording.t, one.recording.dt
        inside, outside = (t > start + 1) & (t < stop - 1), (t < start - 1) | (t > stop + dt + 1)
        assert array_equal(wrong[:, outside], right[:, outside])
        assert array_equal(wrong[:, inside], factor * right[:, inside])


def test_late_clocks_repeat_what_was_before():
    """Where another fault acts on the same messages later, it is left out."""
    for one in with_kind("clock offsets"):
        seconds = float(re.findall(r"clock offsets: \d+ are (\S+) s late", one.text)[0])
        late = [kind for kind in one.kinds if [*KINDS].index(kind) > [*KINDS].index("clock offsets")]
        gnss = world(one.seed, without=late).recording.gnss
        before = world(one.seed, without=[*late, "clock offsets"]).recording.gnss
        (who,) = np.nonzero(~np.isclose(gnss, before, equal_nan=True).all(axis=(0, 1, 3)))
        steps = round(seconds / one.recording.dt)
        there = np.isfinite(before[:, steps:, who]) & np.isfinite(before[:, :-steps, who])
        assert there.any()
        assert array_equal(gnss[:, steps:, who][there], before[:, :-steps, who][there])


def test_wrong_words_are_named():
    for given, more, message in (
        (-1, {}, "seed = -1"),
        (0, {"split": "train"}, "split = 'train'"),
        (0, {"without": ["slip"]}, "without = 'slip'"),
    ):
        with refused(message):
            world(given, **more)  # type: ignore[arg-type]
    for methods, more, message in (
        ((), {"worlds": 1}, "must name a method"),
        (("jiont",), {"worlds": 1}, "Did you mean joint"),
        (("joint",), {"worlds": -1}, "worlds = -1"),
        (("joint",), {"worlds": 1, "tasks": ("paper",)}, "without --tasks"),
    ):
        with refused(message):
            benchmark.benchmark(methods, **more)  # type: ignore[arg-type]


OWN = """
import coopoc as co

class Fails(co.Kalman):
    def __call__(self, recording, egos=(0,)):
        if len(recording.t) > 3 and recording.v2x.max_neighbours > 2:
            raise ValueError("too many neighbours")
        return super().__call__(recording, egos)
"""


def test_a_failed_world_is_worse_and_has_its_reason(tmp_path, capsys):
    (tmp_path / "mine.py").write_text(OWN)
    assert benchmark.benchmark((f"{tmp_path / 'mine.py'}:Fails",), worlds=4, out=tmp_path) == 1
    (file,) = (tmp_path / "worlds").glob("*.json")
    card = json.loads(file.read_text())
    many = [str(seed) for seed in range(4) if world(seed).recording.v2x.max_neighbours > 2]
    assert card["failed"] == dict.fromkeys(many, "ValueError: too many neighbours")
    assert card["summary"]["worse_than_alone"][0] == 25 * len(many)
    assert card["summary"]["percentile_95"] is None
    printed = capsys.readouterr()
    assert f"4 ({len(many)} failed)" in printed.out
    assert f"failed: world {many[0]}: ValueError: too many" in printed.err


def test_the_command_of_a_worst_world_repeats_its_number(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert benchmark.benchmark(("lkf-sa",), worlds=6, validation=True, jobs=2) == 0
    worst = json.loads(Path("runs/benchmark/worlds/validation/lkf-sa.json").read_text())["worst"][0]
    assert worst["ratio"] > 1.0
    assert worst["command"] in capsys.readouterr().out
    assert _status(worst["command"].split()[1:]) == 0
    (file,) = Path("runs/benchmark/worlds/validation").glob("seed-*/lkf-sa.json")
    assert json.loads(file.read_text())["worst"] == [worst]


def test_nees_and_ratios_are_as_by_hand():
    card = worlds_card.worlds_card("joint", 1, seed=2)
    one = world(2)
    tracks = [method(one.recording, list(one.egos)) for method in (co.JointFilter(), co.Kalman())]
    joint, alone = (co.rt_le(track, one.fleet).mean() for track in tracks)
    assert card["summary"]["worse_than_alone"][1:]  # it has ends
    (ratio,) = card["summary"]["over_better"]
    assert ratio == pytest.approx(joint / min(joint, alone), rel=1e-4)
    gap = tracks[0].x - one.fleet.position[None, :, list(one.egos)]
    square = np.einsum("rtei,rteij,rtej->rte", gap, np.linalg.inv(tracks[0].covariance), gap)
    assert card["summary"]["nees_inside"][0] == pytest.approx(((square > 0.2158) & (square < 9.3484)).mean(), abs=1e-3)
    assert math.isclose(card["summary"]["nees_median"], np.median(square), rel_tol=1e-4)


def test_the_page_shows_the_committed_cards():
    """`coopoc benchmark --table --out benchmarks/cards` prints the table."""
    cards = [json.loads(file.read_text()) for file in (ROOT / "benchmarks" / "cards" / "worlds").glob("*.json")]
    assert worlds_card.overview(cards) in (ROOT / "docs" / "benchmark.md").read_text()
    for card in cards:
        assert (card["split"], card["worlds"]["seed"]) == ("test", [*range(1000)])
