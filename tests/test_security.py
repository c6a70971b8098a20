"""Data, weights and results are not trusted: reading them runs no code and writes nothing outside the named folder."""

import csv
import io
import json
import os
from collections.abc import Callable
from dataclasses import replace

import pytest
from conftest import refused
from numpy.random import default_rng
from test_report import Page

from coopoc.cli import _status
from coopoc.study import store
from coopoc.study.publish import tables, views
from coopoc.study.reference import Reference
from coopoc.study.report import report
from coopoc.study.results import Results
from coopoc.study.run import run_study
from coopoc.study.study import Study
from coopoc.study.tables import Table, pivot

EVIL = "from pathlib import Path\nPath({mark!r}).write_text('ran')\n"
SCRIPT = '<script>alert("1")</script>'


def cell(p):
    """Two runs of two egos, whose ids are not to be trusted."""
    return [{"run": r, "ego": e, "rt_le_m": 1.0 + r + p["x"], "text": "=1+1"} for r in range(2) for e in ("=a", "b")]


def table(results):
    """With a caption that is not to be trusted."""
    return replace(pivot(results, "x", "method", "rt_le_m"), caption=f"Caption {SCRIPT}", notes=(SCRIPT,))


STUDY = Study(
    name="made",
    question="What?",
    cell=cell,
    grid={"x": (1, 2), "method": ("kalman", SCRIPT)},
    tables={"rt_le": table},
    findings=lambda results: [f"Finding {SCRIPT}"],
    limitations=(SCRIPT,),
)


@pytest.fixture
def folder(tmp_path):
    """A folder in which STUDY has run."""
    run_study(STUDY, tmp_path)
    return tmp_path / "made"


@pytest.fixture
def evil(tmp_path):
    """A file that leaves a mark when it is run, and the mark."""
    mark = tmp_path / "mark"
    path = tmp_path / "evil.py"
    path.write_text(EVIL.format(mark=str(mark)) + "STUDY = None\nNet = dict\n")
    return path, mark


def edited(path, change):
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


def files(folder):
    return {path for path in folder.rglob("*") if path.is_file()}


def test_weights_run_no_code_that_their_card_names(evil, tmp_path):
    torch = pytest.importorskip("torch")
    from coopoc.learned.checkpoint import load, write

    path, mark = evil
    write(tmp_path / "net.safetensors", {"w": torch.zeros(1)}, {"kind": f"{path}:Net", "net": {}})
    with refused(r"whose code does not run unless you name it.*load\(.*net="):
        load(tmp_path / "net.safetensors")
    assert not mark.exists()


@pytest.mark.parametrize("command", ["reference", "report", "table"])
def test_results_run_no_code_that_their_manifest_names(folder, evil, command, monkeypatch):
    path, mark = evil
    monkeypatch.chdir(folder.parent)
    edited(folder / "manifest.json", lambda m: {**m, "study": f"{path}:STUDY"})
    assert _status([command, str(folder)]) == 2
    assert not mark.exists()


def test_a_study_of_ones_own_is_named_again_for_its_reference(tmp_path, capsys):
    (tmp_path / "mine.py").write_text(
        "from coopoc.study.study import Study\n"
        "def cell(p):\n    return [{'run': 0, 'ego': 'a', 'rt_le_m': p['x']}]\n"
        f"known = dict(metrics={{'rt_le_m': 'lower'}}, reference={str(tmp_path / 'known.json')!r})\n"
        "STUDY = Study('mine', '?', cell, {'x': (1.0, 2.0)}, **known)\n"
        "OTHER = Study('other', '?', cell, {'x': (1.0,)}, **known)\n"
    )
    mine, out = f"{tmp_path / 'mine.py'}:STUDY", str(tmp_path / "mine")
    run_study(mine, tmp_path)
    given = ["reference", out]
    assert _status([*given, "--write"]) == 2
    assert "is not installed. If it is a file of your own, name it: coopoc reference" in capsys.readouterr().err
    assert _status([*given, "--study", mine.replace("STUDY", "OTHER")]) == 2
    assert _status([*given, "--write", "--study", mine]) == 0
    assert _status([*given, "--study", mine]) == 0
    assert "2 of 2 reference numbers hold." in capsys.readouterr().out
    assert "reference numbers" not in (tmp_path / "mine" / "views.json").read_text()  # no finding of the study
    known = Reference.load(tmp_path / "known.json")
    replace(known, numbers=tuple(replace(n, value=0.5 * n.value) for n in known.numbers)).save(tmp_path / "lower.json")
    assert _status([*given, "--study", mine, "--file", str(tmp_path / "lower.json")]) == 1
    assert "2 worse" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["../out", "/tmp/coopoc-out", "a/b", "..", "", "a\nb", 3, None])
def test_a_manifest_cannot_name_another_folder(folder, tmp_path, name):
    edited(folder / "manifest.json", lambda m: {**m, "study": name})
    with refused(r"must be a file name|holds a damaged manifest\.json \(it has no str study"):
        Results.load(folder)


def test_a_study_cannot_be_named_like_a_path():
    with refused("must be a file name"):
        replace(STUDY, name="../out")


@pytest.mark.parametrize("name", ["../../../x", "/tmp/x", "a", "0123456789abcdef012G"])
def test_a_manifest_cannot_name_other_files(folder, tmp_path, name):
    first = next(iter(json.loads((folder / "manifest.json").read_text())["cells"]))
    content = (folder / "cells" / f"{first}.parquet").read_bytes()
    edited(folder / "manifest.json", lambda m: {**m, "cells": {name: next(iter(m["cells"].values()))}})
    (folder.parent / "x.parquet").write_bytes(content)
    with refused("is no name of a cell"):
        Results.load(folder)


def test_a_report_embeds_no_html_of_the_disk_and_escapes_all_text(folder):
    (folder / "tables" / "rt_le.html").write_text("<script>stolen()</script>")
    text = report([folder], folder / "report.html").read_text()
    page = Page(text)
    assert page.tags.count("script") == 1  # the page's own
    assert "stolen" not in text
    assert page.text.count(SCRIPT) >= 6  # caption, notes, finding, limitation and both labels of the method, as text
    assert page.tags.count("iframe") == page.tags.count("object") == 0


@pytest.mark.parametrize("kind", ["tables", "figures"])
@pytest.mark.parametrize("name", ["../../secret", "/etc/passwd", "a/../../../secret", "..", "", 7])
def test_views_show_and_remove_no_file_outside_their_folder(folder, kind, name):
    secrets = [folder.parent / f"secret.{form}" for form in ("html", "csv", "tex", "md", "svg", "pdf", "png")]
    for secret in secrets:
        secret.write_text("secret")
    view = {**json.loads((folder / "views.json").read_text())["tables"][0], "name": name}
    edited(folder / "views.json", lambda v: {**v, kind: [view]})
    with refused("must be a file name"):
        report([folder], folder.parent / "report.html")
    with refused("must be a file name"):
        tables(folder)
    run_study(STUDY, folder.parent)  # writes the views again; those of before are removed
    assert all(secret.read_text() == "secret" for secret in secrets)
    assert [view["name"] for view in views(folder)["tables"]] == ["rt_le"]


def test_a_figure_that_is_a_link_out_of_the_folder_is_not_embedded(folder, tmp_path):
    (folder / "figures").mkdir()
    for form in ("svg", "pdf", "png"):
        (tmp_path / f"secret.{form}").write_text("secret")
        (folder / "figures" / f"f.{form}").symlink_to(tmp_path / f"secret.{form}")
    edited(folder / "views.json", lambda v: {**v, "figures": [{"name": "f", "caption": ""}]})
    with refused(r"leads out of .* by a symbolic link"):
        report([folder], tmp_path / "report.html")
    for form in ("svg", "pdf", "png"):
        (folder / "figures" / f"f.{form}").unlink()
    with refused(r"lacks figures/f\.svg\. Repeat coopoc run"):
        report([folder], tmp_path / "report.html")


@pytest.mark.parametrize("stored", ["null", "{}", "[" * 100_000, '{"study": ["made"]}', "\0"])
@pytest.mark.parametrize("name", ["manifest.json", "views.json"])
def test_a_description_of_another_form_is_named_and_written_again(folder, name, stored):
    (folder / name).write_text(stored)
    read: Callable[[], object] = {
        "manifest.json": lambda: Results.load(folder),
        "views.json": lambda: report([folder], folder / "report.html"),
    }[name]
    with refused(rf"holds a damaged {name} .*Repeat coopoc run: finished cells are kept"):
        read()
    assert run_study(STUDY, folder.parent).failed == 0
    read()


FORMULAS = ("=1+1", "+1+1", "-1+1", "@SUM(A1)", "\t=1", '=cmd|"/c calc"!A1')


def test_no_text_of_a_csv_is_a_formula():
    made = Table(("=head", "b"), tuple((text, -0.5) for text in (*FORMULAS, "-3", "–")), "")
    found = list(csv.reader(io.StringIO(made.to_csv())))
    assert found[0] == ["'=head", "b"]
    assert [row[0] for row in found[1:]] == [*(f"'{text}" for text in FORMULAS), "-3", "–"]
    assert {row[1] for row in found[1:]} == {"-0.5"}


def test_no_text_of_a_csv_starts_a_row_or_reaches_the_terminal():
    assert Table(("a\x1b[31m", "b"), (("x\r=1+1", 1),), "").to_csv() == "a [31m,b\nx =1+1,1\n"


def test_no_text_of_a_markdown_table_is_a_tag_or_ends_a_row():
    made = Table((SCRIPT, "a|b"), ((SCRIPT, "x\ny"), ("</td>", "2 < 3")), f"{SCRIPT}\n# head", notes=("<!-- -->",))
    text = made.to_markdown()
    assert "<script" not in text.replace(r"\<", "")
    assert "</" not in text.replace(r"\<", "")
    assert "<!" not in text.replace(r"\<", "")
    assert "2 < 3" in text
    assert len(text.split("\n\n")[1].splitlines()) == 4
    assert not any(line.startswith("#") for line in text.splitlines())


def test_a_flipped_bit_is_noticed(tmp_path):
    """Of 4,000 flips without checksums 200 gave other numbers; now every one is noticed, that of the seal, too."""

    def noise(p):
        draws = default_rng(0).normal(size=(40, 20))
        return [{"run": r, "ego": "a", "rt_le_m": float(d[0]), "quantiles": d.tolist()} for r, d in enumerate(draws)]

    run_study(Study("noise", "?", noise, {"x": (1,)}), tmp_path)
    (path,) = (tmp_path / "noise" / "cells").iterdir()
    content = path.read_bytes()
    seal = content.rindex(b"sha256:")
    rng = default_rng(7)
    for at in [*rng.integers(0, len(content), 600).tolist(), *range(seal, seal + 71)]:
        damaged = bytearray(content)
        damaged[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        with pytest.warns(RuntimeWarning, match="is damaged and will be computed again"):
            assert store.load(tmp_path / "noise", path.stem) is None


@pytest.mark.parametrize("kind", ["folder", "pipe"])
def test_no_device_and_no_folder_is_replaced_by_a_file(folder, tmp_path, kind):
    """As root, a report "written to" /dev/null took its place for every program of the machine."""
    learned = pytest.importorskip("coopoc.learned")
    out = tmp_path / "out.html"
    os.mkfifo(out) if kind == "pipe" else out.mkdir()
    before = os.stat(out).st_mode
    weights = learned.Checkpoint(learned.NoiseParameters(), {})
    for write in (lambda: report([folder], out), lambda: learned.save(out, weights)):
        with refused(r"is a folder|must be a file"):
            write()
    assert os.stat(out).st_mode == before


@pytest.mark.parametrize(
    "change",
    [
        {"axes": [["x"]]},
        {"cells": {"0123456789abcdef0123": []}},
        {"environment": {"python": ["3"]}},
        {"settings": []},
        {"question": None},
    ],
)
def test_a_manifest_with_a_wrong_field_is_named(folder, change):
    edited(folder / "manifest.json", lambda m: {**m, **change})
    with refused(r"holds a damaged manifest\.json"):
        Results.load(folder)


@pytest.mark.parametrize(
    "change",
    [
        {"rows": [["<b>", {"mean": "<b>", "low": 0, "high": 0, "n": 0}]]},
        {"rows": 3},
        {"decimals": 10**9},
        {"best": "<b>"},
        {"header": None},
    ],
)
def test_a_stored_table_of_another_form_is_named(folder, change):
    stored = views(folder)["tables"][0]["table"]
    assert Table.from_data(stored) == Table.from_data(json.loads(json.dumps(stored)))
    with refused("table = dict: is damaged"):
        Table.from_data({**stored, **change})
    with refused("is damaged"):
        Table.from_data([])


@pytest.mark.parametrize("escape", ["\\ud800", "\\uDFff"])
def test_half_a_surrogate_pair_is_no_text_and_a_whole_one_is(folder, escape):
    path = folder / "views.json"
    known = path.read_text()
    path.write_text(known.replace("Caption", f"Caption {escape}"))
    with refused(r"holds a damaged views\.json"):
        report([folder], folder / "report.html")
    path.write_text(known.replace("Caption", "Caption \\ud83d\\ude97"))
    assert "\U0001f697" in report([folder], folder / "report.html").read_text()


def test_a_stored_table_is_the_table(folder):
    made = table(Results.load(folder))
    assert Table.from_data(views(folder)["tables"][0]["table"]) == made
    assert tables(folder, "latex") == [made.to_latex()]
    assert (folder / "tables" / "rt_le.md").read_text() == made.to_markdown()
