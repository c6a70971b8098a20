"""Pages that are made from the code when the site is built: a page per method, the gallery of studies, the API."""

import contextlib
import html
import io
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from latex2mathml.converter import convert
from matplotlib.ticker import LogLocator, NullFormatter
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from scipy import stats

import coopoc as co
from coopoc.evaluate.bounds import fleet_bound
from coopoc.methods.catalogue import METHODS, needs_whole_fleet
from coopoc.plugins import find, names
from coopoc.study import style

matplotlib.use("Agg")
DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS))
from tutorial import notebook  # noqa: E402
from tutorial import page as tutorial  # noqa: E402

RUNS, EGO, NEIGHBOURS = 10, 24, 4
SECTIONS = {
    "world": ("Worlds and measurements", "Fleets, sensors, V2X, recordings."),
    "methods": ("Methods", "Recording → Track."),
    "optimize": ("Problems and solvers", "Problems, factors, `solve`."),
    "evaluate": ("Evaluation", "Metrics, bounds, statistics, pictures."),
    "study": ("Studies", "Grids of cells, results, views."),
    "data": ("Files", "Drives, graphs and logs from files."),
    "formats": ("Trajectory files", "Estimates for other programs."),
    "errors": ("Errors", "What is raised on bad input."),
}

FOUND = {
    "convergence": (
        "learned.md#the-papers-net",
        "**Federated training reaches the centralised net**: within 3 % from round 1 on, 1.417 and 1.411 m "
        "after 20 rounds.",
    ),
    "error_cdf": (
        "learned.md#the-papers-net",
        "**A fitted Kalman filter is as good as the net**: 1.41 and 1.42 m in scenario 1, 0.89 and 0.94 m in "
        "scenario 2.",
    ),
    "neighbours": (
        "index.md",
        "**With identity covariances the federated net alone beats cooperative filters; with fitted covariances it "
        "does not**: 0.97 m, against 2.19 and 0.54 m for LKF-SA with ten neighbours.",
    ),
    "side_by_side": (
        "your_data.md",
        "**Any methods under any conditions, with the bound**, on a bundled drive or on your own log.",
    ),
}
"""Studies without a page of their own: where they are described, and what they found."""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Give the made pages their place: empty lists of the navigation."""
    places = {
        "Each method": [
            {"All on one drive": "methods/each.md"},
            *({style.look(name).label: f"methods/{name}.md"} for name in METHODS),
        ],
        "API": ["api/index.md", *({title: f"api/{room}.md"} for room, (title, _) in SECTIONS.items())],
    }
    _place(config.nav, places)
    return config


MADE = {r"\]\(tutorials/(\w+)\.py\)": r"](tutorials/\1.md)", r"\]\(\.\./studies\)": "](gallery.md)"}
"""Links that lead to a file of the repository -> to the page that is made from it."""


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Lead links to the sources of made pages to these pages: one text serves the repository's view and the site."""
    for source, page in MADE.items():
        markdown = re.sub(source, page, markdown)
    return markdown


FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


FIGURE = re.compile(r'<p>(<img [^>]*src="([^"]+)"[^>]*>)</p>')


def on_page_content(content: str, **_: Any) -> str:
    """Render the formulas of a page and of its docstrings as MathML, which browsers draw without any script; lead from
    a figure, which fits the width of a phone, to its file.

    Raises:
        PluginError: a formula that MathML cannot show.
    """
    return FIGURE.sub(r'<p><a href="\2">\1</a></p>', FORMULA.sub(_formula, content))


def _formula(match: re.Match[str]) -> str:
    text = html.unescape(match[2]).replace(r"\arg\min", r"\operatorname{argmin}")
    shown = convert(text, display="inline" if match[1] == "span" else "block")
    if "\\" in shown:
        raise PluginError(f"A formula that MathML cannot show: {text}")
    return shown


def _place(entries: Any, places: dict[str, list[Any]]) -> None:
    for entry in entries:
        for title, value in entry.items() if isinstance(entry, dict) else ():
            if title in places:
                entry[title] = places[title]
            elif isinstance(value, list):
                _place(value, places)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made.

    Raises:
        PluginError: one that would replace another page.
    """
    made = {**dict(_methods()), **dict(_tutorials()), "gallery.md": _gallery(), **dict(_api())}
    for path, content in made.items():
        file = File.generated(config, path, content=content)
        if taken := [other.src_uri for other in files if other.dest_uri == file.dest_uri]:
            raise PluginError(f"{path} and {taken[0]} are both {file.dest_uri}: rename one of them.")
        files.append(file)
    return files


NOTEBOOK = '\n\n[This page as a notebook]({0}.ipynb){{ download="{0}.ipynb" }}\n\n'
"""Below the title of a tutorial."""


def _tutorials() -> Iterator[tuple[str, str | bytes]]:
    """The tutorials, run, with their pictures, and as notebooks."""
    for path in sorted((DOCS / "tutorials").glob("*.py")):
        content, pictures = tutorial(path.read_text(), path.stem)
        yield f"tutorials/{path.stem}.md", content.replace("\n\n", NOTEBOOK.format(path.stem), 1)
        yield f"tutorials/{path.stem}.ipynb", notebook(path.read_text())
        yield from ((f"tutorials/{file}", picture) for file, picture in pictures.items())


def _methods() -> Iterator[tuple[str, str | bytes]]:
    """A page for each method: what it is, what it sends, how it does on one drive."""
    lines, names = (
        ["# All methods on one drive", "", "| method | name | what it does | RT-LE [m] |", "|---|---|---|---|"],
        dict[str, Any](),
    )
    exec(RECORDING, names)
    fleet = names["fleet"]
    bounds = dict(_bounds(fleet, names["sensors"]))
    solo = _error(co.Kalman("nominal")(names["recording"], [EGO]), fleet)
    page = (DOCS / "methods.md").read_text()
    table, failures = _rows(page), dict(re.findall(r"^\| `([\w-]+)` \| ([^|]+) \|$", page, flags=re.MULTILINE))
    for name, make in METHODS.items():
        method = make("nominal")
        kind, look = type(method), style.look(name)
        with contextlib.redirect_stdout(io.StringIO()) as said:
            exec(METHOD.format(name=name), names)
        track = names["track"]
        bound = "fleet, smoothing" if needs_whole_fleet(name) else "star"
        curves = (solo, _error(track, fleet), bounds[bound if method.cooperative else "solo"])
        yield f"methods/{name}.png", _picture(fleet.t, curves, look, bound if method.cooperative else "solo")
        what, sends, covariance = table.get(name, ("", "", ""))
        size = method.message.payload if method.cooperative else 0
        facts = [
            f"- **Does:** {what}",
            f"- **Sends per step:** {sends or 'nothing'}{f' ({size} B payload)' if size and ' B' not in sends else ''}",
            f"- **Covariance:** {covariance}",
            f"- **Fails when:** {failures[name]}",
            f"- **RT-LE in the picture:** {_rms(track, fleet):.2f} m; solo Kalman filter {_root_mean(solo):.2f} m",
        ]
        notes = [f"- {note}" for note in track.notes]
        yield (
            f"methods/{name}.md",
            "\n".join(
                [
                    f"# {look.label}",
                    "",
                    f"`{name}`, `coopoc.{kind.__name__}`" if hasattr(co, kind.__name__) else f"`{name}`",
                    "",
                    *facts,
                    "",
                    *("```python", f"{RECORDING}{METHOD.format(name=name)}", "```", ""),
                    *("```", said.getvalue().rstrip(), "```", ""),
                    f"![Error of {look.label} over time]({name}.png)",
                    "",
                    f"Root mean square error of one ego over {RUNS} noise draws, `town10`, scenario 2, "
                    f"{NEIGHBOURS} neighbours, ideal channel, nominal noise model. The band contains 95 % of such "
                    "errors of an estimator at the bound.",
                    "",
                    *(["Notes on its Track:", "", *notes, ""] if notes else []),
                    f"::: {kind.__module__}.{kind.__name__}",
                    "",
                    *_oracle(name),
                ]
            ),
        )
        lines.append(f"| [{look.label}]({name}.md) | `{name}` | {what} | {_rms(track, fleet):.2f} |")
    yield "methods/each.md", "\n".join([*lines, ""])


RECORDING = """import coopoc as co
from coopoc.plugins import find

fleet = co.load_fleet("town10").between(0, 200)
sensors, v2x = co.Sensors.paper_scenario2(), co.V2X(max_neighbours=4)
recording = co.observe(fleet, sensors, v2x, runs=10, seed=0)
"""
METHOD = """method = find("coopoc.methods", "{name}")("nominal")
track = method(recording, egos=[24])
print(f"{{co.rt_le(track, fleet).mean():.2f}} m, {{track.received_bytes.mean() / 20:.0f}} B/s received")"""
"""The example of every method: it is run when the site is built, its recording once."""


ORACLES = {
    "kalman": "solo",
    "lkf-sa": "lkf_sa",
    "lkf-sa-edge": "joint",
    "joint": "joint",
    "cooperative-filter": "cooperative",
    "msmv-r": "msmv",
    "ci": "covariance_intersection",
    "split-ci": "covariance_intersection",
    "batch-smoother": "batch_smoother",
}
"""The textbook implementation of `tests/oracles` that each method is held against."""


def _oracle(name: str) -> list[str]:
    """The method written plainly, as the tests hold it against the compiled one."""
    if name not in ORACLES:
        return []
    file = DOCS.parent / "tests" / "oracles" / f"{ORACLES[name]}.py"
    words = f"The equations as a loop with dense matrices, one run at a time (`tests/oracles/{file.name}`)."
    return ["## The method in plain NumPy", "", words, "", "```python", file.read_text().rstrip(), "```", ""]


def _bounds(fleet: Any, sensors: Any) -> Iterator[tuple[str, Any]]:
    """Root of the bound's trace over time, m, by information set."""
    v2x = co.V2X(NEIGHBOURS)
    yield "solo", _root(co.posterior_bound(fleet, sensors, EGO))
    yield "star", _root(co.posterior_bound(fleet, sensors, EGO, v2x))
    for name, smoothing in (("fleet", False), ("fleet, smoothing", True)):
        yield name, _root(fleet_bound(fleet, sensors, v2x, smoothing=smoothing)[:, EGO])


def _root(bound: Any) -> Any:
    return np.sqrt(np.trace(bound, axis1=-2, axis2=-1))


def _rows(page: str) -> dict[str, tuple[str, str, str]]:
    """Name -> what it does, sends and claims, from the first table of the overview."""
    found = {}
    for line in page.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 5 and cells[0].startswith("`"):
            own, others = (re.findall(r"`([\w-]+)`", cells[k]) for k in (0, 2))
            said = tuple(cell.replace("](#", "](../methods.md#") for cell in cells[2:])
            found |= dict.fromkeys(own, said) | {name: said for name in others if name not in found}
    return found


def _error(track: Any, fleet: Any) -> Any:
    gap = track.x[:, :, 0] - fleet.position[None, :, EGO]
    return np.sqrt((gap**2).sum(axis=-1).mean(axis=0))


def _rms(track: Any, fleet: Any) -> float:
    return _root_mean(_error(track, fleet))


def _root_mean(error: Any) -> float:
    return float(np.sqrt((error**2).mean()))


def _picture(t: Any, curves: tuple[Any, Any, Any], look: Any, information: str) -> bytes:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 3.0), dpi=130, layout="constrained")
    ax = figure.add_subplot()
    solo, error, bound = curves
    ax.plot(t, solo, color="#E69F00", lw=1.0, label="Kalman filter, alone")
    ax.plot(t, error, color=look.color, lw=1.6, label=look.label)
    ax.plot(t, bound, color="black", ls="--", lw=1.0, label=f"bound, {information}")
    low, high = np.sqrt(stats.chi2.ppf([0.025, 0.975], 3 * RUNS) / (3 * RUNS))
    ax.fill_between(t, low * bound, high * bound, color="black", alpha=0.12, lw=0, label=f"95 % of {RUNS} draws at it")
    ax.set(xlabel="Time [s]", ylabel="RMS error [m]", yscale="log")
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.grid(True, color="#E3E7EC")
    ax.legend(fontsize=8, frameon=False)
    out = io.BytesIO()
    figure.savefig(out, format="png")
    return out.getvalue()


def _gallery() -> str:
    """Every study with its question, its figure, its finding and its page."""
    lines = ["# Studies", "", "`coopoc run NAME` reproduces a study ([Running studies](studies.md)).", ""]
    for name in names("coopoc.studies"):
        study = find("coopoc.studies", name)
        page, finding = FOUND.get(name, (f"{name}.md", ""))
        finding = finding or _first_finding(DOCS / page)
        lines += [f"## [{name}]({page})", "", f"*{study.question}*", "", finding, ""]
        if (DOCS / f"{name}.png").is_file():
            lines += [f"[![Figure of {name}]({name}.png)]({name}.png)" + "{ .gallery }", ""]
    return "\n".join(lines)


def _first_finding(page: Path) -> str:
    """The first sentence of a page's first bullet that begins in bold."""
    found = re.search(r"^- (\*\*.+?\*\*.*?\.)(?=\s)", page.read_text(), re.DOTALL | re.MULTILINE)
    return " ".join(found[1].split()) if found else ""


def _api() -> Iterator[tuple[str, str]]:
    """A page for each room, with the public names that live there."""
    homes = re.findall(r"from \.([\w.]+) import (\w+)", (DOCS.parent / "coopoc" / "__init__.pyi").read_text())
    lines = ["# API reference", "", "The public names of `import coopoc as co`.", ""]
    for room, (title, words) in SECTIONS.items():
        mine = [(module, name) for module, name in homes if module.split(".")[0] == room]
        above = "" if room == "data" else "coopoc."  # in the sources that folder stands beside the package
        yield f"api/{room}.md", "\n".join([f"# {title}", "", *(f"::: {above}{m}.{n}\n" for m, n in mine)])
        lines.append(f"- [{title}]({room}.md): {words} " + ", ".join(f"`{name}`" for _, name in mine))
    yield "api/index.md", "\n".join([*lines, ""])
