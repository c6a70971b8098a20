"""coopoc data list | get | show | check."""

import sys
from functools import partial
from pathlib import Path

import tyro
from tabulate import tabulate

from coopoc import InputError, plot_recording, plot_track
from coopoc.arrays import one_of
from coopoc.paths import replaceable, write

from .fetch import Entry, fetch, public
from .registry import DATASETS, LOGS, card, kind_of, load_fleet, read_log
from .source import split


def list_() -> None:
    """List the bundled fleets, and the public measurements that `coopoc data get` brings, one line each.

    Example: coopoc data list
    """
    columns = ("name", "map", "map_licence", "vehicles", "steps", "dt", "sha256")
    cards = [[card(name)[column] for column in columns] for name in DATASETS]
    print(tabulate(cards, columns, "github"), end="\n\n")
    rows = [
        (name, "yes" if entry.fetched else "no", round(entry.bytes / 1e6, 2), entry.licence, entry.what)
        for name, entry in public().items()
    ]
    print(tabulate(rows, ("name", "fetched", "MB", "licence", "what"), "github"))


def get(names: tyro.conf.Positional[tuple[str, ...]], /) -> None:
    """Fetch public measurements by name, verify them by SHA-256, and print the paths that --data takes.

    Example: coopoc data get f9k plaza1

    Args:
        names: as coopoc data list shows them.
    """
    if not names:
        raise InputError("names", "()", "must name a data set", "coopoc data list shows them.")
    for name in names:
        print(fetch(name))


def show(name: tyro.conf.Positional[str]) -> None:
    """Show the card of a bundled fleet or of public measurements, or what a file of drives or a log holds.

    Example: coopoc data show town10

    Args:
        name: a bundled fleet, public measurements, or a path as in --data.
    """
    if name in public() and not Path(name).exists():
        _print(name, _fields(public()[name]))
        return
    if name in DATASETS:
        _print(name, card(name)["words"])
        return
    if kind_of(name) in LOGS:
        log = read_log(name)
        print(log.summary)
        if log.truth is None:
            return
    fleet = load_fleet(name)
    _print(repr(fleet), {of: getattr(fleet, of) or "(not stated)" for of in ("source", "licence")})


def _fields(entry: Entry) -> dict[str, str]:
    """What a reader has to know of a public data set, to fetch it by hand, too."""
    named = "what", "licence", "citation", "page", "archive"
    stated = {field: text for field, text in entry._asdict().items() if text and field in named}
    files = {
        f"{file}, {size:,} bytes": f"{address} {digest}".strip()
        for file, (address, size, digest) in entry.files.items()
    }
    fetched = str(entry.path) if entry.fetched else f"no: coopoc data get {entry.name}"
    return stated | {"addresses": entry.tried, "fetched": fetched} | files


def _print(name: str, fields: dict[str, str]) -> None:
    print(name, *(f"  {key:<12} {value}" for key, value in fields.items()), sep="\n")


def check(path: tyro.conf.Positional[str], *, picture: Path | None = None) -> None:
    """Check a log of your own: what was read, what was not and why, innovation statistics, and a picture.

    Example: coopoc data check "mylog?dt=0.1&columns=t:timestamp,vehicle:car"

    Args:
        path: a file or a folder: tables, NMEA, a ROS bag, PyFG, and options; see docs/your_data.md.
        picture: its file; default: the log's name with -check.png, in the working folder.
    """
    from .log.check import check as checked

    out = picture or Path(f"{Path(split(path)[0]).resolve().stem}-check.png")
    one_of("ending of --picture", replaceable(out).suffix, (".png", ".pdf", ".svg", ".jpg"))
    log = read_log(path)
    print(log.summary)
    try:
        result = checked(log)
    except InputError as error:
        print(f"\ncheck: no filter follows it, no picture is drawn: {error}")
        return
    for title, rows in (("Fixes", result.vehicles), ("Relative measurements", result.measurements)):
        if rows:
            print(
                f"\n{title}: innovations against a filter of each vehicle alone{', ' * bool(result.span)}{result.span}"
            )
            print(tabulate(rows, headers="keys", tablefmt="github", floatfmt=".3g"))
    print()
    for warning in result.warnings or ("nothing looks wrong",):
        print(f"check: {warning.replace(f': {log.summary.columns}.', ', as listed above.')}")
    for what in result.unseen:
        print(f"not seen: {what}")
    figure = plot_track(result.track, plot_recording(result.log.recording, step=0), fleet=result.log.truth).figure
    write(out, partial(figure.canvas.print_figure, format=out.suffix[1:]))
    print(f"picture: {out}", file=sys.stderr)


COMMANDS = {"list": list_, "get": get, "show": show, "check": check}
