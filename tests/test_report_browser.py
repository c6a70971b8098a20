"""The page of a real study in headless Chromium: it works offline, sorts, switches, and fits a desk and a phone."""

import re
import shutil
from dataclasses import replace

import pytest

from coopoc.study.report import report
from coopoc.study.run import run_study
from coopoc.study.tables import Table

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install 'coopoc[dev]'")

WIDTHS = {"desktop": (1280, 900), "phone": (390, 844)}


def _numbers(results):
    """Numbers whose order as text is another one, what is missing, intervals, and durations."""
    wide = results.interval("rt_le_m", method="kalman", max_neighbours=0)
    narrow = results.interval("rt_le_m", method="joint", max_neighbours=2)
    rows = (
        ("b 10", -1.0, wide, "2.0 h"),
        ("a", None, None, "5 s"),
        ("b 9", 10.25, narrow, "10 min"),
        ("c", -2.0, 0.5, "inf"),
    )
    return Table(("Name", "Number", "Interval", "Duration"), rows, "Made to be sorted.")


def _wide(results):
    """More columns than a screen is wide."""
    found = results.interval("rt_le_m", method="kalman", max_neighbours=0)
    return Table(("Method", *(f"Column {i}" for i in range(20))), (("KF", *(found,) * 20),), "Wide.")


@pytest.fixture(scope="module")
def page_file(study, tmp_path_factory):
    out = tmp_path_factory.mktemp("browser")
    run_study(replace(study, tables={"numbers": _numbers, "wide": _wide, **study.tables}), out)
    return report([out / "small"], out / "report.html", cards={"circle": {"vehicles": 5, "name": "a" * 120}})


@pytest.fixture(scope="module")
def browser():
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if program is None:
        pytest.skip("there is no Chromium: apt-get install chromium")
    with playwright.sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=program, args=["--no-sandbox", "--disable-gpu"])
        yield opened
        opened.close()


@pytest.fixture(params=WIDTHS)
def page(request, browser, page_file):
    """The page at both widths; nothing may be asked of the network or said in the console, whatever the test does."""
    width, height = WIDTHS[request.param]
    context = browser.new_context(viewport={"width": width, "height": height})
    opened = context.new_page()
    asked: list[str] = []
    said: list[str] = []
    opened.on("request", lambda request: asked.append(request.url))
    opened.on("console", lambda message: said.append(message.text))
    opened.on("pageerror", lambda error: said.append(str(error)))
    opened.goto(page_file.as_uri())
    yield opened
    context.close()
    assert [url for url in asked if not url.startswith("data:")] == [page_file.as_uri()]
    assert said == []


def _column(page, table, index):
    cells = page.locator(f"#small-table-{table} tbody tr td:nth-child({index + 1})").all_inner_texts()
    return [re.split(r"\s", cell)[0] if index else cell for cell in cells]


@pytest.mark.parametrize(
    ("title", "upwards", "downwards"),
    [
        ("Name", ["a", "b 9", "b 10", "c"], ["c", "b 10", "b 9", "a"]),
        ("Number", ["c", "b 10", "b 9", "a"], ["b 9", "b 10", "c", "a"]),  # what has no number is last both times
        ("Duration", ["a", "b 9", "b 10", "c"], ["c", "b 10", "b 9", "a"]),
    ],
)
def test_a_click_on_a_header_sorts(page, title, upwards, downwards):
    head = page.locator("#small-table-numbers th", has_text=title)
    button = head.get_by_role("button")
    orders = []
    for direction in ("ascending", "descending", None):
        button.click()
        assert head.get_attribute("aria-sort") == direction
        orders.append(_column(page, "numbers", 0))
    assert orders == [upwards, downwards, ["b 10", "a", "b 9", "c"]]


def test_intervals_sort_by_their_mean_from_the_keyboard(page):
    heads = page.locator("#small-table-rt_le thead th")
    for index, key in ((1, "Enter"), (2, "Space")):
        heads.nth(index).get_by_role("button").focus()
        page.keyboard.press(key)
        means = [float(cell) for cell in _column(page, "rt_le", index)]
        assert means == sorted(means)
    assert [head.get_attribute("aria-sort") for head in heads.all()] == [None, None, "ascending", None]


def test_nothing_is_wider_than_the_page(page):
    wide, window = page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
    assert wide <= window
    box = page.locator("figure img").bounding_box()
    assert box["width"] > 300
    assert box["x"] + box["width"] <= window
    beyond = """[...document.querySelectorAll("body *")].filter(e => !e.closest(".wide") && e.getClientRects().length
        && e.getBoundingClientRect().right > innerWidth + 1).map(e => e.outerHTML.slice(0, 80))"""
    assert page.evaluate(beyond) == []


def test_a_figure_can_be_enlarged_on_a_phone(page):
    figure = page.locator("figure:visible")
    button = figure.get_by_role("button", name="Enlarge")
    if page.viewport_size["width"] > 640:
        assert button.count() == 0
        return
    fits = figure.locator("img").bounding_box()["width"]
    button.click()
    assert figure.locator("img").bounding_box()["width"] > 2 * fits
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    figure.get_by_role("button", name="Fit").click()
    assert figure.locator("img").bounding_box()["width"] == fits


def test_without_javascript_everything_is_there(browser, page_file):
    context = browser.new_context(java_script_enabled=False)
    plain = context.new_page()
    plain.goto(page_file.as_uri())
    assert [table.is_visible() for table in plain.locator(".table table").all()] == [True] * 3
    assert plain.locator("figure img").is_visible()
    assert plain.locator("button").count() == 0
    context.close()
