"""The site: every page has a place, and the tutorials run as they stand."""

import re

import pytest
from shell import ROOT, TUTORIALS, python

SLOW = ("learned", "compare", "paper")


def test_every_page_has_a_place():
    placed = set(re.findall(r"[\w/]+\.md", (ROOT / "mkdocs.yml").read_text().split("\nnav:\n")[1]))
    pages = {str(p.with_suffix(".md").relative_to(ROOT / "docs")) for p in [*(ROOT / "docs").glob("*.md"), *TUTORIALS]}
    assert placed ^ pages == {"gallery.md"}


def test_every_study_has_a_finding_and_a_page_that_is_there():
    pytest.importorskip("mkdocs", reason="make docs installs it")
    out = python("-c", "import pages; print(len(pages.names('coopoc.studies')), pages._gallery())", cwd=ROOT / "docs")
    title, *studies = out.split("\n## ")
    for study in studies:
        assert "**" in study, study
        page, _, place = re.findall(r"\[\w+\]\(([\w.]+)(#?)([\w-]*)\)", study)[0]
        titles = re.findall(r"^#+ (.*)", (ROOT / "docs" / page).read_text(), flags=re.MULTILINE)
        assert not place or place in {re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles}
    assert len(studies) == int(title.split()[0])


def test_figures_fit_a_phone_and_lines_of_code_stay_whole():
    assert not re.search(r"pre-wrap|img[^}]*max-width: none", (ROOT / "docs" / "site.css").read_text())
    template = (ROOT / "coopoc" / "study" / "report.html.j2").read_text()
    assert all('class="wide"' in line for line in template.splitlines() if "{{ plot(" in line)


def test_every_method_has_a_row_of_its_own_in_the_overview():
    from coopoc.methods.catalogue import METHODS

    page = (ROOT / "docs" / "methods.md").read_text()
    rows = [re.findall(r"`([\w-]+)`", line.split("|")[1]) for line in page.splitlines() if line.startswith("| `")]
    assert set(METHODS) <= {name for names in rows for name in names}


@pytest.mark.parametrize(
    "tutorial",
    [pytest.param(path, marks=pytest.mark.slow) if path.stem in SLOW else path for path in TUTORIALS],
    ids=lambda path: path.stem,
)
def test_a_tutorial_runs(tutorial, tmp_path):
    out = python("-W", "error", tutorial, cwd=tmp_path)
    assert out
    if tutorial.stem == "paper":
        says_what_it_prints(out)


def says_what_it_prints(printed):
    """The findings of the tutorial on the paper, from its table and its differences."""
    rows = {line[:25].strip(): [float(cell) for cell in line[25:].split()] for line in printed.splitlines()[6:21]}
    net, tuned = rows["FedKalmanNet"][0], rows["Kalman filter, fitted"][0]
    for name in ("MSMV", "LKF-SA"):
        assert min(rows[f"{name}, identity"][:5]) > 1.5 * net
        assert rows[f"{name}, fitted"][4] < 0.7 * tuned
    assert abs(net / tuned - 1) < 0.1
    assert net < min(rows[f"local net {k}"][0] for k in (1, 2, 3, 4))
    assert rows["joint filter, nominal"][4] < 1.1 * rows["bound"][4]


def test_doctests_and_tutorials_of_pages(monkeypatch):
    """What the package does not contain: the extension of the API pages, and what a tutorial becomes."""
    pytest.importorskip("griffe", reason="make docs installs it")
    monkeypatch.syspath_prepend(ROOT / "docs")
    from doctests import fenced
    from tutorial import page

    assert fenced("Words.\n\n>>> 1 + 1\n2") == "Words.\n\n```pycon\n>>> 1 + 1\n2\n```"
    cells = "# %% [markdown]\n# # A [sum](../learned.md)\n#\n#     more\n\n# %%\nprint(3)\n1 + 1\n\n# %%\n"
    drawn = "import sys\nimport matplotlib.pyplot as plt\nprint('compiling', file=sys.stderr)\n_ = plt.plot([1, 2])\n"
    content, pictures = page(cells + drawn, "sum")
    assert content.startswith(
        "# A [sum](../learned.md)\n\n    more\n\n```python\nprint(3)\n1 + 1\n```\n\n```text\n3\n```"
    )
    assert "```text\n2\n```" in content
    assert content.endswith("![What the code above draws](sum-1.png)")
    assert pictures["sum-1.png"].startswith(b"\x89PNG")


def test_an_unknown_command_of_a_formula_fails_the_build():
    pytest.importorskip("mkdocs", reason="make docs installs it")
    code = """
import pages
print(pages.on_page_content('<span class="arithmatex">\\\\(\\\\arg\\\\min_x\\\\)</span>').count("argmin"))
try:
    print(pages.on_page_content('<span class="arithmatex">\\\\(\\\\nowhere\\\\)</span>'))
except pages.PluginError:
    print("refused")
"""
    assert python("-c", code, cwd=ROOT / "docs").split() == ["1", "refused"]
