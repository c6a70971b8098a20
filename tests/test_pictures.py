"""Pictures and hostile names: what is drawn is where the numbers say, text is text everywhere."""

import csv
import io
import re
import unicodedata

import matplotlib
import numpy as np
import pytest
from conftest import refused, winding
from latex import compiled
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from numpy.testing import assert_array_equal
from scipy import stats
from test_report import Page

import coopoc as co
from coopoc.evaluate.pictures import ellipses
from coopoc.study.plot import legend
from coopoc.study.publish import views
from coopoc.study.report import report
from coopoc.study.run import run_study
from coopoc.study.study import Study
from coopoc.study.tables import Table


@pytest.fixture(scope="module")
def seen():
    fleet = co.load_fleet("town10").between(0, 60)
    return fleet, co.observe(fleet, co.Sensors.paper_scenario2(), co.V2X(4), runs=2, observers=[24, 3])


def test_an_ellipse_holds_95_percent():
    """Independent check: chi-square of SciPy, and points drawn by NumPy."""
    cov = np.array([[4.0, 1.5], [1.5, 1.0]])
    ax = Figure().add_subplot()
    ellipses(ax, np.array([[3.0, -2.0]]), cov[None], "k")
    (patch,) = [patch for patch in ax.patches if isinstance(patch, Ellipse)]
    assert patch.width * patch.height == pytest.approx(4 * stats.chi2.ppf(0.95, 2) * np.sqrt(np.linalg.det(cov)))
    points = np.random.default_rng(0).multivariate_normal([3.0, -2.0], cov, 20_000)
    along = patch.get_patch_transform().inverted().transform(points)  # to the unit circle
    assert ((along**2).sum(1) < 1).mean() == pytest.approx(0.95, abs=0.005)


def test_a_recording_shows_its_fixes_and_links(seen):
    _fleet, recording = seen
    ax = co.plot_recording(recording, run=1, step=20)
    assert not ax.spines["top"].get_visible()
    assert_array_equal(ax.lines[7].get_xydata(), recording.gnss[1, :, 7, :2])
    (lines,) = [c for c in ax.collections if isinstance(c, LineCollection)]
    assert len(lines.get_segments()) == int((recording.links.step == 20).sum()) > 0
    again = Figure().add_subplot()
    assert co.plot_recording(recording, again) is again


def test_a_notebook_shows_a_picture_without_pyplot(seen):
    """IPython's own formatter makes a PNG of the figure; a plain Figure gives text alone."""
    formatters = pytest.importorskip("IPython.core.formatters", reason="pip install ipython")

    shown, _ = formatters.DisplayFormatter().format(co.plot_recording(seen[1], step=1).figure)
    assert shown["image/png"].startswith(b"\x89PNG")


def test_a_track_shows_paths_and_truth(seen):
    fleet, recording = seen
    track = co.JointFilter()(recording, [24, 3])
    ax = co.plot_track(track, fleet=fleet, every=20)
    assert_array_equal(ax.lines[0].get_xydata(), fleet.position[:, 24, :2])
    assert_array_equal(ax.lines[3].get_xydata(), track.x[0, :, 1, :2])
    assert len(ax.patches) == 2 * 3
    assert len(co.plot_track(co.GNSS()(recording, [24])).patches) in (0, 60)
    crowd = co.plot_track(co.GNSS()(co.observe(fleet, co.Sensors()), range(60)), fleet=fleet)  # names would hide paths
    road = winding(400, 9.0, 900.0)
    drive = co.observe(road, co.Sensors())
    line = co.plot_track(co.Kalman()(drive), co.plot_recording(drive), fleet=road)
    assert line.get_aspect() == "auto" != ax.get_aspect()
    for picture, labels in ((crowd, ["truth"]), (line, ["a", "t = 19.9 s", "truth"])):
        assert [text.get_text() for text in picture.get_legend().texts] == labels


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"run": 2}, r"run = 2: must be in 0\.\.1"),
        ({"step": -1}, r"step = -1: must be in 0\.\.59"),
        ({"ax": "here"}, r"ax = 'here': must be axes of matplotlib"),
    ],
)
def test_what_cannot_be_drawn_is_named(seen, options, message):
    with refused(message):
        co.plot_recording(seen[1], **options)  # type: ignore[arg-type]


NAMES = {
    "tag": "<script>alert(1)</script>",
    "input": r"\input{/etc/passwd}",
    "mathematics": r"$\frac{$",
    "path": "../../etc/passwd",
    "formula": "=cmd|' /C calc'!A0",
    "formula behind a blank": " =1+1",
    "hidden": "_a",
    "percent": "%s {0} {{ 7 * 7 }}",
}


UNPRINTABLE = {"line": "a\n\n# b", "right to left": "a\u202egnp.exe", "terminal": "a\x1b[2Jb"}
"""Names that no vehicle may have, and any other text."""
ALL = NAMES | UNPRINTABLE | {"command": r"\write18{touch ran}", "letters by code": "^^5cinput"}


def controls(text):
    return {letter for letter in text if letter != "\n" and unicodedata.category(letter)[0] == "C"}


def words(figure):
    """What a figure shows, from its SVG with text as text."""
    out = io.BytesIO()
    figure.savefig(out, format="svg")
    return out.getvalue().decode()


@pytest.fixture(autouse=True)
def text_as_text(monkeypatch):
    """In SVG, where matplotlib draws letters as paths otherwise."""
    monkeypatch.setitem(matplotlib.rcParams, "svg.fonttype", "none")


@pytest.mark.parametrize("kind", NAMES)
def test_pictures_show_names_as_text(kind):
    """Of recordings, tracks and studies; the name is in the legend, whatever it holds."""
    name, t = NAMES[kind], np.arange(40) / 10
    position = np.stack([np.column_stack([8 * t, y + 0 * t, 0 * t]) for y in (0.0, 9.0)], axis=1)
    fleet = co.Fleet((name, "b"), t, position, np.gradient(position, 0.1, axis=0))
    rec = co.observe(fleet, co.Sensors(), co.V2X(max_neighbours=1))
    studied = Figure()
    legend(studied.subplots(), [{"method": name}, {"method": "kalman"}], {})
    figures = [co.plot_track(co.Kalman()(rec, [0]), fleet=fleet).figure, co.plot_recording(rec).figure, studied]
    texts = [*map(words, figures)]
    shown = re.sub(r"[^\w=]|_", "", name)[:6]
    for text in texts:
        assert "<script" not in text
        assert not controls(text)
        assert shown in re.sub(r"[^\w=]|_", "", re.sub(r"<[^>]*>", "", re.sub(r"(?s)<style.*?</style>", "", text)))


@pytest.mark.parametrize("kind", UNPRINTABLE)
def test_no_vehicle_has_a_name_that_acts_on_a_terminal(kind):
    still = np.zeros((2, 1, 3))
    with refused("must be printable"):
        co.Fleet((UNPRINTABLE[kind],), [0.0, 0.1], still, still)


def cell(p):
    return [{"run": run, "ego": p["name"], "rt_le_m": 1.0 + run} for run in range(2)]


def test_pages_and_tables_show_names_as_text(tmp_path):
    def table(results):
        rows = tuple((name, 1.0, f"{name} [m]") for name in ALL.values())
        return Table(("Name", "RT-LE", r"$\input{x}$"), rows, " ".join(ALL.values()), notes=tuple(ALL.values()))

    grid = {"name": tuple(ALL.values())}
    study = Study("made", "What?\u202e", cell, grid, tables={"t": table}, limitations=tuple(ALL.values()))
    assert run_study(study, tmp_path).failed == 0
    folder = tmp_path / "made"
    page = Page(report([folder], tmp_path / "report.html").read_text())
    assert page.tags.count("script") == 1
    assert page.tags.count("base") == page.tags.count("iframe") == 0
    assert not controls(page.text)
    assert "{{ 7 * 7 }}" in page.text
    made = Table.from_data(views(folder)["tables"][0]["table"])
    for text in (made.to_markdown(), made.to_latex(), made.to_html()):
        assert not controls(text)
    assert not {"\\input", "\\write"} & set(re.findall(r"\\[a-z]+", made.to_latex()))
    assert "Output written" in compiled(made.to_latex(), tmp_path)
    assert not (tmp_path / "ran").exists()
    cells = [row[0] for row in csv.reader(io.StringIO(made.to_csv()))][1:]
    assert len(cells) >= len(ALL)
    assert not any(re.match(r"\s*[=+@-]", text) for text in cells)
    assert not {name.strip("./") for name in ALL.values()} & {path.name for path in tmp_path.rglob("*")}


def test_a_solution_shows_nodes_factors_and_headings(seen):
    problem = co.Problem.from_snapshot(seen[1], step=10, ego=24)
    solution = co.solve(problem)
    ax = co.plot_solution(solution, problem=problem)
    assert_array_equal(ax.lines[0].get_xydata(), solution.position[:, :2])
    assert [text.get_text() for text in ax.texts] == list(solution.names)
    with refused("must be the one that was solved"):
        co.plot_solution(solution, problem=co.Problem([*"ab"]).add("position", ["a", "b"], np.zeros((2, 3)), std=1.0))
