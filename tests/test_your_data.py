"""docs/your_data.md as it stands: its script, its commands and its Python run one by one in an empty folder."""

import re
import shlex

import numpy as np
import pandas as pd
import pytest
from shell import ROOT, python

import coopoc as co
from coopoc.data.log.units import KINDS

PAGE = (ROOT / "docs" / "your_data.md").read_text()


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", PAGE, flags=re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("page")
    (script,) = [text for text in blocks("python") if text.startswith("# make_log.py\n")]
    (out / "make_log.py").write_text(script)
    python("-W", "error", "make_log.py", cwd=out)
    return out


def test_the_table_of_the_page_is_a_log(tmp_path):
    (tmp_path / "measurements.csv").write_text(blocks("csv")[0])
    log = co.read_log(tmp_path)
    assert log.recording.ids == ("red", "blue")
    assert log.recording.arrival.tolist() == [[1, -1]]  # blue has the range, too, and no message of red
    assert log.recording.sensors.range_std == 0.3


@pytest.mark.slow
def test_every_command_runs(folder):
    commands = [line for block in blocks("sh") for line in block.splitlines()]
    assert len(commands) == 10
    for command in commands[1:]:
        out = python("-W", "error", "-m", "coopoc.cli", *shlex.split(command)[1:], cwd=folder)
        if "data check" in command:
            assert "nothing looks wrong" in out
            assert "stands at (180.0, -20.0, 0.0) m" in out
    assert (folder / "mylog-check.png").is_file()
    assert (folder / "coarse.png").is_file()
    rows = pd.read_parquet(folder / "runs" / "side_by_side" / "results.parquet")
    level = rows.groupby(["method", "max_neighbours"])["rt_le_m"].mean()
    assert level["joint", 3] < level["kalman", 3] < level["gnss", 3]


def test_every_block_of_python_runs(folder):
    code = "\n".join(text for text in blocks("python") if not text.startswith("# make_log"))
    script = folder / "page.py"
    script.write_text(code)
    out = python("-W", "error", script, cwd=folder)
    assert "not used" not in out
    assert "read: 180 fixes, 2700 ranges" in out
    assert "29.54 m\n30.0 m" in out
    assert float(re.findall(r"\[\[([\d.]+)\]\]", out)[0]) < 1.0


def test_every_kind_is_on_the_page():
    table = PAGE[PAGE.index("| kinds |") : PAGE.index("A relative measurement may")]
    for kind in KINDS:
        assert f"`{kind}`" in table or kind.endswith("_deg"), kind


def test_egos_are_a_number_a_list_or_a_name(folder, tmp_path):
    settings = {"data": str(folder / "mylog"), "method": "kalman", "max_neighbours": "0"}
    for egos, wanted in ((2, 2), (["red", "blue"], 2), ("green", 1), ("red,blue", 2), ("auto", 3)):
        frame = co.run_study("side_by_side", tmp_path, settings={**settings, "egos": egos}).frame
        assert len(np.unique(frame["ego"])) == wanted
