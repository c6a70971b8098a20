"""The survey: its stages share settings, and its answers are those of the studies' numbers."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from coopoc.studies import survey
from coopoc.study import numbers
from coopoc.study.report import report


@pytest.mark.slow
def test_answers_come_from_the_numbers(tmp_path: Path, short_town: str, capsys: pytest.CaptureFixture[str]) -> None:
    few = {
        "data": short_town,
        "runs": 2,
        "egos": "2",
        "method": "gnss,kalman,joint,bound",
        "max_neighbours": "0,4",
        "train_seeds": 1,
    }
    found = survey.stages(("budget",), tmp_path, 1, {**few, "channel": "ideal"})
    two = {"runs": 1, "max_neighbours": "2", "after_s": "3,30", "speed": "0,1,10"}
    found |= survey.stages(("heading_error",), tmp_path, 1, two)
    assert "stage 1 of 2: heading_error" in capsys.readouterr().err
    said = survey.answers(found)
    alone, together, bound = (
        numbers.rms(found["budget"], {"method": method, "noise_model": known, "max_neighbours": k, "rate_hz": 0.0})
        for method, known, k in (("kalman", "nominal", 0), ("joint", "nominal", 4), ("bound", "with its past", 4))
    )
    assert alone is not None
    assert together is not None
    assert bound is not None
    limits = [f"Which method with {words}?" for words in survey.LIMITS.values()]
    assert list(said) == [*limits, "If the heading is not known?"]
    rich, poor, none, heading = said.values()
    assert rich.startswith("With the noise known, Joint filter with K = 4 and ")
    assert f"{together / bound:.2f} times the bound" in rich
    assert none.startswith("With the noise known, KF: ")
    assert "with the noise fitted elsewhere, KF" in none
    assert poor != rich  # 4 neighbours at 10 Hz take more than 300 B/s
    assert heading.startswith("K = 2, 10 m/s: ")
    page = report([tmp_path / "budget"], tmp_path / "report.html", answers=said).read_text()
    assert f"<dt>Which method with no V2X?</dt><dd>{none}</dd>" in re.sub("</?abbr[^>]*>", "", page)
