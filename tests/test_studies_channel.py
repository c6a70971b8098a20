"""The studies of late, lost and false messages on few cells."""

from __future__ import annotations

from pathlib import Path

import pytest

from coopoc import run_study
from coopoc.studies import latency_loss, robustness
from coopoc.study import numbers


def test_late_and_lost_messages_cost_and_the_table_says_so(tmp_path: Path, short_town: str) -> None:
    wanted = {
        "data": short_town,
        "runs": 3,
        "egos": "1",
        "method": "kalman,joint",
        "latency_s": "0.0,0.3",
        "loss": "0.0,0.6",
    }
    results = run_study("latency_loss", tmp_path, settings=wanted, progress=False)
    perfect, late, lossy = (
        numbers.mean(results, {**latency_loss.PERFECT, "method": "joint", **change})
        for change in ({}, {"latency_s": 0.3}, {"loss": 0.6})
    )
    assert perfect is not None
    assert late is not None
    assert lossy is not None
    assert perfect < min(late, lossy)
    table = (tmp_path / "latency_loss" / "tables" / "rt_le.md").read_text()
    assert "lost in runs of 10" in table
    assert "0.3 s" in table


def test_who_trusts_everybody_is_led_astray_and_who_is_careful_is_not(tmp_path: Path, short_town: str) -> None:
    wanted = {
        "data": short_town,
        "runs": 1,
        "egos": "1",
        "method": "kalman,joint,cooperative-map-gnc",
        "max_neighbours": "0,4",
        "spoofed_share": "0.0,0.4",
    }
    results = run_study("robustness", tmp_path, settings=wanted, progress=False)
    alone, trusting, careful, unharmed = (
        numbers.mean(results, robustness.at(method, 4, share))
        for method, share in (("kalman", 0.4), ("joint", 0.4), *(("cooperative-map-gnc", s) for s in (0.4, 0.0)))
    )
    assert alone is not None
    assert trusting is not None
    assert trusting > 3 * alone
    assert careful == pytest.approx(unharmed, rel=0.3)
