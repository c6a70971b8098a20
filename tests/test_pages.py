"""The Python of the pages as it stands, page by page in an empty folder; what they show is what it prints."""

import os
import re
from itertools import zip_longest

import pytest
from shell import ROOT, python

HERE = ["README", "index", "methods", "optimize", "streaming", "studies", "learned"]
HERE += ["federation", "budget", "robustness", "heading_error"]
ELSEWHERE = {"extend": "test_extend.py", "your_data": "test_your_data.py"}
"""Pages whose blocks are files and commands, too."""
NUMBER = re.compile(r"([-+]?\d+(?:\.\d*)?(?:e[-+]?\d+)?)")
FREE = ("ms", "iterations")
"""Units of numbers that differ from machine to machine."""


def text(page):
    return (ROOT / "README.md" if page == "README" else ROOT / "docs" / f"{page}.md").read_text()


def blocks(page):
    """Blocks of Python; with each the block without a language that follows it, which shows what it prints."""
    return re.findall(r"```python\n(.*?)```\n(?:\n```\n(.*?)```\n)?", text(page), flags=re.DOTALL)


def printed(page, folder):
    (folder / "page.py").write_text("\n".join(code for code, _ in blocks(page)))
    flags = ["-W", "error", "-W", "ignore:'click.utils"]  # of a library that Flower imports
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT / "examples")}
    return python(*flags, "page.py", cwd=folder, env=environment)


def agree(shown, found):
    """Words alike, whole numbers alike, decimals to 5 % or two units of their last digit; "..." is any rest."""
    here, there = shown.split(), found.split()
    for a, b, unit in zip_longest(here, there, here[1:], fillvalue=""):
        if a == "...":
            return True
        ours, theirs = NUMBER.split(a), NUMBER.split(b)  # words and numbers by turns
        if ours[::2] != theirs[::2]:
            return False
        if unit.strip(";,") not in FREE and not all(map(close, ours[1::2], theirs[1::2])):
            return False
    return True


def close(shown, found):
    if shown.lstrip("+-").isdigit():
        return shown == found
    last = 10.0 ** -len(shown.partition("e")[0].partition(".")[2])
    slack = 1e-6 if "e" in shown else max(0.05 * abs(float(shown)), 2 * last)
    return abs(float(shown) - float(found)) <= slack


@pytest.mark.parametrize("page", HERE)
def test_the_python_of_a_page_prints_what_the_page_shows(page, tmp_path):
    shown = "".join(output for _, output in blocks(page)).splitlines()
    pairs = list(zip_longest(shown, printed(page, tmp_path).splitlines(), fillvalue=""))
    assert [(a, b) for a, b in pairs if not agree(a, b)] == []


def test_every_page_with_python_is_run():
    pages = [
        path.stem for path in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")) if "```python" in path.read_text()
    ]
    assert set(pages) == {*HERE, *ELSEWHERE}
    for page, test in ELSEWHERE.items():
        assert f'"{page}.md"' in (ROOT / "tests" / test).read_text()
