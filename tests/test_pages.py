"""The Python of pages that no other test runs, as it stands, page by page in an empty folder."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
GRAPH = ROOT.parent / "shared" / "data" / "pyfg" / "mrclam5a.pyfg"
PAGES = [
    "optimize",
    pytest.param("distributed", marks=pytest.mark.skipif(not GRAPH.is_file(), reason=f"{GRAPH.name} is not there")),
]


@pytest.mark.parametrize("page", PAGES)
def test_the_python_of_a_page_runs_and_prints_what_it_shows(page: str, tmp_path: Path) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / f"{page}.md").read_text(), flags=re.DOTALL)
    if page == "distributed":
        shutil.copy(GRAPH, tmp_path)
    (tmp_path / "page.py").write_text("\n".join(blocks))
    command = [sys.executable, "-W", "error", "page.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for shown in re.findall(r"^# (SOLVED|\[[\d. ,]+\])", "\n".join(blocks), flags=re.MULTILINE):
        assert shown in done.stdout
