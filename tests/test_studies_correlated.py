"""The study of lasting GNSS errors on a short drive."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from coopoc import InputError, Sensors, run_study
from coopoc.studies import correlated_gnss as study
from coopoc.studies import scene
from coopoc.study import numbers

QUICK = {"method": "kalman,joint,drift,bound", "max_neighbours": "0,6", "runs": 3, "egos": "2"}


def test_own_errors_average_out_over_neighbours_and_common_ones_do_not(tmp_path: Path, short_town: str) -> None:
    wanted = {"own_share": "0.9,0.0", "common_share": "0.0,0.9"}
    results = run_study("correlated_gnss", tmp_path, settings={**QUICK, **wanted, "data": short_town}, progress=False)
    value = {
        name: [numbers.rms(results, {**study.case(name), "method": "drift", "max_neighbours": k}) for k in (0, 6)]
        for name in ("white", "own", "common")
    }
    own, common = value["own"], value["common"]
    assert own[0] is not None
    assert own[1] is not None
    assert own[1] < 0.5 * own[0]
    assert common[0] is not None
    assert common[1] is not None
    assert common[1] > 0.8 * common[0]
    found = study.STUDY.found(results)
    assert list(found) == ["white", "own", "common"]
    assert all(text.startswith(f"{name}: ") for name, text in found.items())
    folder = tmp_path / "correlated_gnss"
    assert "Cramér-Rao bound" in (folder / "tables" / "rms.md").read_text()
    assert (folder / "figures" / "rms.pdf").stat().st_size > 5_000


def test_shares_keep_the_variance_of_a_fix() -> None:
    noise = scene.lasting(Sensors.paper_scenario2(), 0.45, 0.45)
    assert noise.fix_std == pytest.approx((3.5, 3.5, 3.5))
    assert noise.gnss_drift_std == pytest.approx(3.5 * np.sqrt(0.45))
    for own, common in ((0.6, 0.4), (-0.1, 0.0)):
        with pytest.raises(InputError, match="own_share"):
            scene.lasting(Sensors(), own, common)
