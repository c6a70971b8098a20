"""The study of bytes: payload, air, schedules, and the break-even with training."""

import numpy as np
import pytest
from conftest import refused

from coopoc import V2X, JointFilter, load_fleet, observe, run_study
from coopoc.evaluate.metrics import rt_le
from coopoc.evaluate.statistics import Interval, paired_difference
from coopoc.learned import Checkpoint, save
from coopoc.learned import load as load_weights
from coopoc.learned.recipes import WEIGHTS, Setting, jobs_of
from coopoc.studies import budget as study
from coopoc.studies import scene
from coopoc.study import numbers
from coopoc.world.channels import CHANNELS
from coopoc.world.sensing import find_links

QUICK = {"runs": 2, "egos": "2", "max_neighbours": "0,2", "method": "kalman,joint,split-ci,bound"}
SIZES = ("payload_bytes_per_second", "bytes_per_second")


@pytest.fixture(scope="module")
def results(tmp_path_factory, short_town):
    return run_study("budget", tmp_path_factory.mktemp("budget"), settings={**QUICK, "data": short_town})


@pytest.fixture(scope="module")
def tight(tmp_path_factory, short_town):
    """Under caps and schedules, and a training: the shipped weights."""
    folder, shipped = tmp_path_factory.mktemp("weights"), load_weights(WEIGHTS / "fedokf.safetensors")
    drives = load_fleet("town10-clients")
    (job,) = jobs_of("fedokf", Setting(), drives)
    save(folder / f"{job.label}.safetensors", Checkpoint(shipped.model, {**shipped.card, "key": job.key(drives)}))
    wanted = {
        "data": short_town,
        "runs": 2,
        "egos": "2",
        "max_neighbours": "0,10",
        "method": "joint,fedokf",
        "noise_model": "nominal,trained",
        "weights": str(folder),
        "train_seeds": 1,
    }
    return run_study("budget", tmp_path_factory.mktemp("tight"), settings=wanted)


def rows(table):
    assert table is not None
    return list(table.rows)


def at(**where: object):
    return {"max_neighbours": 2, **study.IDEAL_CHANNEL, "method": "joint", "noise_model": "nominal", **where}


@pytest.mark.slow
def test_bytes_are_payload_and_what_goes_on_air(results, short_town):
    """By hand: 32 B at 10 Hz from each of the neighbours that are there; a CAM carries 350 B more."""
    drive = load_fleet(short_town)
    egos = [drive.index(ego) for ego in scene.egos({"data": short_town, "egos": 2})]
    near = len(find_links(drive, egos, V2X(2, 30.0), 2.0)) / len(egos) / len(drive.t)
    ideal = [numbers.mean(results, at(channel="ideal"), kind) for kind in SIZES]
    assert ideal == pytest.approx([near * 320, near * 320])
    payload, air = (numbers.mean(results, at(channel="cam"), kind) for kind in SIZES)
    assert payload is not None
    assert air == pytest.approx(payload * 382 / 32)
    assert payload < 0.3 * near * 320  # 2.2 Hz and 2 % lost


@pytest.mark.slow
def test_channels_keep_their_order(results):
    error = {name: numbers.mean(results, at(channel=name)) for name in CHANNELS}
    assert error["ideal"] == min(error.values())  # type: ignore[type-var]
    assert numbers.mean(results, at(method="bound", noise_model="with its past", channel="ideal")) is not None


@pytest.mark.slow
def test_best_within_a_budget_never_gets_worse_with_it(results):
    texts = study.STUDY.answers(results)
    errors = [float(text.split()[-2]) for text in texts]
    assert len(errors) == len(study.BYTE_LIMITS)
    assert (np.diff(errors) <= 0).all()
    assert "K =" not in texts[0]


def test_a_channel_that_is_not_there_is_named():
    with refused("channel"):
        scene.channel({"channel": "wifi"})
    assert scene.channel({"channel": "bsm", "max_neighbours": 4, "radius_m": 50.0}) == V2X(
        4, 50.0, rate=10.0, latency=0.06, loss=0.03, burst=5.0, overhead=212
    )
    assert scene.channel({"radius_m": 0.0, "cap_bytes_per_second": 0.0}) == V2X(0, 0.0, bytes_per_second=0.0)


@pytest.mark.slow
def test_schedules_are_compared_on_the_same_egos_and_runs(tight, short_town):
    """The row of a cap, by hand."""
    fleet = load_fleet(short_town)
    egos, errors = scene.egos({"data": short_town, "egos": 2}), []
    for schedule in study.SCHEDULES:
        channel = V2X(10, bytes_per_second=200.0, schedule=schedule)
        seen = observe(fleet, scene.sensors({**tight.settings}), channel, runs=2, observers=egos)
        errors.append(rt_le(JointFilter()(seen, egos), fleet).T)
    table = study.STUDY.tables["schedules"](tight)
    assert [row[0] for row in rows(table)] == list(study.CAPS)
    (row,) = [row for row in rows(table) if row[0] == 200]
    found = [entry for entry in row if isinstance(entry, Interval)]
    assert [entry.mean for entry in found[:2]] == pytest.approx([error.mean() for error in errors])
    for gap, wanted in zip(found[2:], [paired_difference(error, errors[0]) for error in errors[1:]], strict=True):
        assert [gap.mean, gap.low, gap.high] == pytest.approx([wanted.mean, wanted.low, wanted.high])
        assert gap.mean != 0.0
