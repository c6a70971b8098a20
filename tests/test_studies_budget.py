"""The study of bytes: payload and air, the front, driving time until deciding has cost as much as training."""

from __future__ import annotations

import numpy as np
import pytest

from coopoc import V2X, InputError, Results, load, run
from coopoc.studies import budget as study
from coopoc.studies import scene, views
from coopoc.world.sensing import find_links

QUICK = {"runs": 2, "egos": "2", "max_neighbours": "0,2", "method": "kalman,joint,split-ci,bound"}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory, short_town: str) -> Results:
    wanted = {**QUICK, "data": short_town}
    return run("budget", tmp_path_factory.mktemp("budget"), settings=wanted, progress=False)


def at(**where: object) -> dict[str, object]:
    return {"max_neighbours": 2, **study.FREE, "method": "joint", "knowledge": "nominal", **where}


def test_bytes_are_payload_and_what_goes_on_air(results: Results, short_town: str) -> None:
    """By hand: 32 B at 10 Hz from each of the neighbours that are there; a CAM carries 350 B more."""
    drive = load(short_town)
    egos = [drive.index(ego) for ego in scene.egos(short_town, "2")]
    near = len(find_links(drive, egos, 2, 30.0, 2.0)) / len(egos) / len(drive.t)
    ideal = [views.mean(results, at(channel="ideal"), kind) for kind in study.BYTES]
    assert ideal == pytest.approx([near * 320, near * 320])
    payload, air = (views.mean(results, at(channel="cam"), kind) for kind in study.BYTES)
    assert payload is not None
    assert air == pytest.approx(payload * 382 / 32)
    assert payload < 0.3 * near * 320  # 2.2 Hz and 2 % lost


def test_channels_keep_their_order(results: Results) -> None:
    error = {name: views.mean(results, at(channel=name)) for name in scene.CHANNELS}
    assert error["ideal"] == min(error.values())  # type: ignore[type-var]
    assert views.mean(results, at(method="bound", knowledge="bound", channel="ideal")) is not None


def test_best_within_a_budget_never_gets_worse_with_it(results: Results) -> None:
    found = [study.best_under(results, limit) for limit in (0.0, 300.0, 600.0, 5000.0)]
    errors = [one[0] for one in found if one is not None]
    assert len(errors) == 4
    assert (np.diff(errors) <= 0).all()
    assert found[0] is not None
    assert found[0][2]["max_neighbours"] == 0


def test_a_channel_that_is_not_there_is_named() -> None:
    with pytest.raises(InputError, match="channel"):
        scene.channel({"channel": "wifi"})
    assert scene.channel({"channel": "bsm", "max_neighbours": 4, "radius_m": 50.0}) == V2X(
        4, 50.0, rate=10.0, latency=0.06, loss=0.03, burst=5.0, overhead=212
    )
