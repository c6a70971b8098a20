"""The report: one file, nothing outside it, everything that must be said."""

import re
import shutil
from html.parser import HTMLParser

import pytest
from conftest import refused

from coopoc.study.report import report
from coopoc.study.run import run_study

VOID = {"meta", "link", "img"}


class Page(HTMLParser):
    """Collects tags, attributes that refer to something, ids and text, and checks that tags close in order."""

    def __init__(self, text):
        super().__init__()
        self.tags: list[str] = []
        self.open: list[str] = []
        self.references: list[str] = []
        self.ids: list[str] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        if tag not in VOID:
            self.open.append(tag)
        assert tag != "script" or attrs == []
        for name, value in attrs:
            if name in ("href", "src", "srcset", "action", "data"):
                self.references.append(value or "")
            if name == "id":
                self.ids.append(value or "")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.fixture(scope="module")
def made(study, tmp_path_factory):
    out = tmp_path_factory.mktemp("report")
    (out / "trouble").write_text("raise")
    run_study(study, out, settings={"trouble": str(out / "trouble")})
    cards = {"circle": {"vehicles": 5, "licence": "<none> & free"}}
    path = report([out / "small"], out / "page" / "report.html", "Circles & <more>", ["A lead."], cards)
    return path, Page(path.read_text())


def test_nothing_outside_the_file_is_needed(made):
    path, page = made
    assert page.open == []
    assert not [r for r in page.references if not r.startswith(("data:", "#"))]
    assert {r[1:] for r in page.references if r.startswith("#")} <= set(page.ids)
    css = re.search(r"<style>(.*?)</style>", path.read_text(), re.S)
    assert "url(" not in css[1]
    assert "@import" not in css[1]


@pytest.mark.parametrize(
    "words",
    [
        "What is a neighbour worth on a circle?",
        "Key findings",
        "KF: ",
        "Settings and seeds",
        "Recipe",
        "nothing here learns",
        "Limitations",
        "No vehicle drives in circles.",
        "Environment",
        "numpy",
        "Failed cells: 1",
        "FloatingPointError: the filter diverged at step 3",
        "K = 1, KF",
        "RT-LE [m] at a GNSS noise of 3.5 m.",
        "A lead.",
        "<none> & free",
        "Circles & <more>",
        "Training",
        "Pause",
    ],
)
def test_it_says(made, words):
    assert words in made[1].text


def test_the_same_folders_give_the_same_page(made, tmp_path):
    path, _ = made
    folder = path.parents[1] / "small"
    first, second = (report([folder], tmp_path / name) for name in ("a.html", "b.html"))
    assert first.read_bytes() == second.read_bytes()


def test_a_page_on_several_studies_opens_with_what_each_found(made, tmp_path):
    folder = made[0].parents[1] / "small"
    manifest = shutil.copytree(folder, tmp_path / "other") / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"study": "small"', '"study": "other"'))
    opening, _, rest = report([manifest.parent, folder], tmp_path / "r.html").read_text().partition("<nav")
    order = ("What is a neighbour worth", "KF: ", '<figure id="other-figure-rt_le">', "Figure 1.1.")
    assert sorted(order, key=opening.index) == [*order]
    assert '<figure id="small-figure-rt_le">' in rest
    assert order[2] not in rest


def test_folders_that_cannot_be_shown_are_named(made, tmp_path):
    folder = made[0].parents[1] / "small"
    with refused("different studies"):
        report([folder, folder], tmp_path / "r.html")
    with refused(r"must be a file that ends in \.html\. Name the file"):
        report([folder], tmp_path)
    with refused(rf"holds no manifest\.json\. Give {folder}"):
        report([folder.parent], tmp_path / "r.html")
