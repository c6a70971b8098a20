"""The survey: its stages share settings, and its answers are those of the studies' numbers."""

from __future__ import annotations

from pathlib import Path

import pytest

from coopoc.studies import survey, views


def test_answers_come_from_the_numbers(tmp_path: Path, short_town: str, capsys: pytest.CaptureFixture[str]) -> None:
    few = {"data": short_town, "runs": 2, "egos": "2", "method": "gnss,kalman,joint,bound", "max_neighbours": "0,4",
           "train_seeds": 1}  # fmt: skip
    found = survey.stages(("budget",), tmp_path, 1, {**few, "channel": "ideal"})
    two = {**few, "method": "kalman,joint,bound", "max_neighbours": "0,2"}
    found |= survey.stages(("heading_error",), tmp_path, 1, two)
    assert "stage 1 of 2: heading_error" in capsys.readouterr().err
    said = survey.answers(found)
    alone, together, bound = (
        views.rms(found["budget"], {"method": method, "knowledge": known, "max_neighbours": k, "rate_hz": 0.0})
        for method, known, k in (("kalman", "nominal", 0), ("joint", "nominal", 4), ("bound", "bound", 4))
    )
    assert alone is not None
    assert together is not None
    assert bound is not None
    rich, poor, none, heading = said
    assert rich.startswith("Which method with at most 5 kB/s? with the noise known, Joint filter with K = 4 and ")
    assert f"{together / bound:.2f} times the bound" in rich
    assert none.startswith("Which method with no V2X? with the noise known, KF: ")
    assert "with the noise fitted elsewhere, KF" in none
    assert poor != rich  # 4 neighbours at 10 Hz take more than 300 B/s
    assert heading.startswith("If the heading is wrong? 4° of")
    assert (tmp_path / "budget" / "views.json").is_file()
