"""The site: every page has a place, and the tutorials run as they stand."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.py"))
SLOW = ("learned", "compare", "paper")


def test_every_page_has_a_place() -> None:
    placed = set(re.findall(r"[\w/]+\.(?:md|py)", (ROOT / "mkdocs.yml").read_text().split("\nnav:\n")[1]))
    pages = {str(p.relative_to(ROOT / "docs")) for p in [*(ROOT / "docs").glob("*.md"), *TUTORIALS]}
    assert pages - placed == set()
    assert placed - pages == {"gallery.md"}


def test_every_study_has_a_finding_and_a_page_that_is_there() -> None:
    pytest.importorskip("mkdocs")
    code = "import pages; print(pages._gallery())"
    out = subprocess.run([sys.executable, "-c", code], cwd=ROOT / "docs", capture_output=True, text=True, check=True)
    studies = out.stdout.split("\n## ")[1:]
    for study in studies:
        assert "**" in study, study
        page, _, place = re.findall(r"\[\w+\]\(([\w.]+)(#?)([\w-]*)\)", study)[0]
        titles = re.findall(r"^#+ (.*)", (ROOT / "docs" / page).read_text(), flags=re.MULTILINE)
        assert not place or place in {re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles}
    assert len(studies) >= 14


def test_every_method_has_a_row_of_its_own_in_the_overview() -> None:
    from coopoc.methods.catalogue import METHODS

    page = (ROOT / "docs" / "methods.md").read_text()
    rows = [re.findall(r"`([\w-]+)`", line.split("|")[1]) for line in page.splitlines() if line.startswith("| `")]
    assert set(METHODS) <= {name for names in rows for name in names}


@pytest.mark.parametrize(
    "tutorial",
    [pytest.param(path, marks=pytest.mark.slow) if path.stem in SLOW else path for path in TUTORIALS],
    ids=lambda path: path.stem,
)
def test_a_tutorial_runs(tutorial: Path, tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-W", "error", tutorial], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout
    if tutorial.stem == "paper":
        says_what_it_prints(done.stdout)


def says_what_it_prints(printed: str) -> None:
    """The findings of the tutorial on the paper, from its table and its differences."""
    rows = {line[:25].strip(): [float(cell) for cell in line[25:].split()] for line in printed.splitlines()[6:21]}
    net, tuned = rows["FedKalmanNet"][0], rows["Kalman filter, fitted"][0]
    for name in ("MSMV", "LKF-SA"):
        assert min(rows[f"{name}, identity"][:6]) > 1.5 * net
        assert rows[f"{name}, fitted"][5] < 0.7 * tuned
    assert abs(net / tuned - 1) < 0.1
    assert net < min(rows[f"local net {k}"][0] for k in (1, 2, 3, 4))
    assert rows["joint filter, nominal"][5] < 1.1 * rows["bound"][5]


def test_doctests_of_pages_are_fenced() -> None:
    """The extension of the API pages, which the package does not contain."""
    pytest.importorskip("griffe")
    sys.path.insert(0, str(ROOT / "docs"))
    try:
        from doctests import fenced
    finally:
        sys.path.pop(0)
    assert fenced("Words.\n\n>>> 1 + 1\n2") == "Words.\n\n```pycon\n>>> 1 + 1\n2\n```"


def test_a_dead_link_of_a_tutorial_and_an_unknown_command_of_a_formula_fail_the_build() -> None:
    pytest.importorskip("mkdocs")
    code = """
import types, pages
tutorial = types.SimpleNamespace(file=types.SimpleNamespace(src_uri="tutorials/a.py"))
print(pages.on_page_content('<a href="../learned.md#the-papers-net">', tutorial))
print(pages.on_page_content('<span class="arithmatex">\\\\(\\\\arg\\\\min_x\\\\)</span>', tutorial).count("argmin"))
formula = '<span class="arithmatex">\\\\(\\\\nowhere\\\\)</span>'
wrong = ('<a href="../nowhere.md">', '<a href="../learned.md#nowhere">', formula)
for text in wrong:
    try:
        print(pages.on_page_content(text, tutorial))
    except pages.PluginError as error:
        print("refused", error)
"""
    out = subprocess.run([sys.executable, "-c", code], cwd=ROOT / "docs", capture_output=True, text=True, check=True)
    lines = out.stdout.splitlines()
    assert lines[0] == '<a href="../../learned/#the-papers-net">'
    assert lines[1] == "1"
    assert [line.split()[0] for line in lines[2:]] == ["refused"] * 3
