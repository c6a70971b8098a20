"""Links and notebooks: what a page of the repository leads to is there, in the repository's own view as in the site."""

import os
import re
import subprocess
from pathlib import Path

import pytest
from shell import ROOT, TUTORIALS, python

LINK = re.compile(r"\]\(<?([^)<>\s]+)>?(?:\s[^)]*)?\)|^\[[^\]]+\]:\s+(\S+)|(?:src|href)=\"([^\"]+)\"", re.MULTILINE)
CODE = re.compile(r"^(```|~~~).*?^\1|`[^`\n]+`", re.MULTILINE | re.DOTALL)


def tracked():
    """Files of the repository, and their folders."""
    files = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    names = set(files.split("\0")) - {""}
    return names | {str(folder) for name in names for folder in Path(name).parents}


def heads(text):
    """Anchors of a page's headings, as GitHub and the site name them."""
    titles = re.findall(r"^#+ (.*)", CODE.sub(lambda m: m[0].strip("`") if m[1] is None else "", text), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title).strip().lower().replace(" ", "-") for title in titles}


def broken(page, text, there):
    """Relative links of a page that lead to no tracked file, or to no heading of one."""
    found = []
    for groups in LINK.findall(CODE.sub("", text)):
        target = "".join(groups)
        path, _, anchor = target.partition("#")
        if re.match(r"[a-z][a-z0-9+.-]*:", target):
            continue
        file = os.path.normpath(Path(page).parent / path) if path else page
        if file not in there or (anchor and file.endswith(".md") and anchor not in heads((ROOT / file).read_text())):
            found.append(f"{page}: {target}")
    return found


def test_a_broken_link_is_found():
    there = tracked()
    text = '[a](nowhere.md) [b](install.md#no-such-place) ![c](no.png) `[d](x.md)` <img src="f">'
    text += " [e](https://example.org/x) [g](install.md) [h](../studies)\n[i]: gone.md\n"
    assert len(broken("docs/index.md", text, there)) == 5


def test_every_relative_link_leads_to_a_tracked_file():
    if not (ROOT / ".git").exists():
        pytest.skip("Not a clone: git knows no files.")
    there = tracked()
    pages = [name for name in there if name.endswith(".md")]
    assert len(pages) > 20
    assert [link for page in sorted(pages) for link in broken(page, (ROOT / page).read_text(), there)] == []
    for path in TUTORIALS:
        text = re.sub(r"^# ?", "", path.read_text(), flags=re.MULTILINE)
        assert broken(str(path.relative_to(ROOT)), text, there) == []


def test_links_to_sources_lead_to_the_made_pages_of_the_site():
    pytest.importorskip("mkdocs")
    code = "import pages; print(pages.on_page_markdown('[a](tutorials/solve.py) [b](../studies) [c](learned.md)'))"
    assert python("-c", code, cwd=ROOT / "docs") == "[a](tutorials/solve.md) [b](gallery.md) [c](learned.md)\n"


@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_a_notebook_is_valid_and_has_the_cells_that_the_page_runs(path, monkeypatch):
    """Independent check: nbformat's schema, and the cells as `page` cuts them; `make docs` runs these."""
    pytest.importorskip("jupytext")
    import nbformat

    monkeypatch.syspath_prepend(ROOT / "docs")
    from tutorial import CELL, LINE_OF_TEXT, notebook

    made = notebook(path.read_text())
    assert made == notebook(path.read_text())
    read = nbformat.reads(made, as_version=4)
    nbformat.validate(read)
    _, *cells = CELL.split(path.read_text())
    ran = [
        ("markdown", LINE_OF_TEXT.sub("", text.strip())) if "markdown" in kind else ("code", text.strip())
        for kind, text in zip(cells[::2], cells[1::2], strict=True)
    ]
    assert [(cell.cell_type, cell.source.strip()) for cell in read.cells] == ran
    assert len(ran) > 7
