"""The command line: coopoc run, table, report, list, and the commands of installed distributions."""

import json
import os
import re
import shlex
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import EntryPoint, version
from io import TextIOWrapper
from pathlib import Path
from shutil import get_terminal_size
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from . import plugins
from .errors import InputError, MissingLibraryError, missing, unknown
from .workers import say

Command = Callable[..., int | None] | Mapping[str, Any] | EntryPoint
Folder = Annotated[Path, arg(metavar="FOLDER")]
Folders = Annotated[Positional[tuple[Path, ...]], arg(metavar="FOLDER ...")]
Format = Literal["markdown", "csv", "latex", "html"]

_ABOUT = """usage: coopoc COMMAND [options]

Cooperative localization: solvers, filters, learned gains, and studies that compare them.

commands:
{commands}

Options and an example of each command: coopoc COMMAND --help. Example: coopoc run neighbours --jobs 2
Real measurements: coopoc data get f9k, then coopoc data check f9k
Tables and JSON go to stdout, progress and messages to stderr.
Exit status: 0 done, 1 some cells failed, 2 usage, 130 interrupted and resumable."""


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of the console script; exits with the status that the help text names."""
    warnings.formatwarning = lambda message, *_args, **_options: f"coopoc: warning: {message}\n"
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # of a locale that lacks a letter
    sys.exit(_status(list(sys.argv[1:] if argv is None else argv)))


def run(
    name: Annotated[Positional[str], arg(metavar="NAME")],
    /,
    data: Annotated[str | None, arg(metavar="NAME_OR_PATH")] = None,
    out: Folder = Path("runs"),
    jobs: int = 1,
    set: Annotated[tuple[tuple[str, ...], ...], UseAppendAction, arg(metavar="KEY=VALUE ...")] = (),
    retry_failed: bool = False,
    dry_run: bool = False,
    tracks: Literal["none", "tum"] = "none",
) -> int:
    """Run a study, or resume it: finished cells are kept; --retry-failed repeats failed ones.

    Example: coopoc run neighbours --jobs 2 --set runs=100 max_neighbours=0,4

    Args:
        name: name of the study (see coopoc list), or FILE.py:NAME.
        data: data set to use instead of the study's own.
        out: folder of all studies; this one is written to FOLDER/NAME.
        jobs: number of worker processes; results do not depend on it.
        set: settings or axes of the study; commas separate the values of a list.
        retry_failed: repeat failed cells.
        dry_run: print which cells would be kept, repeated and computed, then stop.
        tracks: tum writes the estimates, a TUM file for each ego and run, to FOLDER/NAME/tracks.
    """
    from .study.cell import assignments
    from .study.study import find_study, points

    chosen = [] if data is None else [f"data={data}"]
    changes = assignments([*chosen, *(text for group in set for text in group)])
    study = find_study(name).override(changes)  # a mistake is reported before pandas and Arrow are imported
    for first in points(study)[:1]:
        study.key({**study.settings, **first})
    if tracks == "tum":
        study.tracks_of()
    from .study.publish import tables
    from .study.run import plan, run_study, write_tracks

    if dry_run:
        print(json.dumps(plan(name, out, changes, retry_failed), indent=1, default=str))
        return 0
    results = run_study(name, out, jobs, changes, retry_failed=retry_failed)
    folder = out / results.study
    for text in tables(folder):
        print(text, end="\n\n")
    for _, row in results.failures.head(5).iterrows():
        params = (f"{axis} = {row[axis]}" for axis in results.axes if axis in row)
        lines = [f"failed: {row['reason']} ({', '.join(params)})", *row["traceback"].splitlines()[-5:]]
        say("\n  ".join(lines))
    if tracks == "tum":
        say(f"estimates are in {write_tracks(name, out, changes)}")
    failed = f"; cells failed: {results.failed}, try them again with --retry-failed" if results.failed else ""
    say(f"results are in {folder}{failed}. Report: coopoc report {shlex.quote(str(folder))}")
    return int(results.failed > 0)


def table(
    folder: Annotated[Positional[Path], arg(metavar="FOLDER")],
    /,
    format: Format = "markdown",
    name: Annotated[str | None, arg(metavar="NAME")] = None,
) -> None:
    """Print the tables of a study; `coopoc.study.tables.pivot` makes others.

    Example: coopoc table runs/neighbours --format latex

    Args:
        folder: folder of the study.
        format: format of the table.
        name: print only this table of the study.
    """
    from .study.publish import tables

    print("\n\n".join(text.rstrip("\n") for text in tables(folder, format, name)))


def report(folders: Folders, /, out: Annotated[Path | None, arg(metavar="FILE")] = None) -> None:
    """Write a self-contained HTML page on one or several studies.

    Example: coopoc report runs/neighbours runs/error_cdf --out report.html

    Args:
        folders: folders of the studies, in the order of the page.
        out: file to write. Default: report.html in the first folder.
    """
    from .study.report import report as write_report

    print(write_report(folders, out or Path(*folders[:1], "report.html")))


def list_names() -> None:
    """List what is installed: data sets, methods, studies, backends, recipes, channels and more.

    Example: coopoc list
    """
    for group in plugins.GROUPS:
        if group != "coopoc.commands":
            print(
                f"{group.removeprefix('coopoc.')}: {', '.join(plugins.names(group)) or '(none but the built-in ones)'}"
            )


OWN_COMMANDS: Mapping[str, Command] = {"run": run, "table": table, "report": report, "list": list_names}


def _status(argv: list[str]) -> int:
    home = os.path.expanduser("~")  # of a quoted path, or one behind "=", which shells leave as it is
    argv = [re.sub("(^|=)~(?=/|$)", lambda match: match[1] + home, word) for word in argv]
    try:
        if argv[:1] in (["--version"], ["-V"]):
            print(version("coopoc"))
            return 0
        status = _dispatch({**plugins.points("coopoc.commands"), **OWN_COMMANDS}, argv, "coopoc")
        print(end="", flush=True)  # whether there is a stdout or not
        return status
    except ModuleNotFoundError as error:
        if (problem := missing(error, " ".join(["coopoc", *argv[:1]]))) is error:
            raise
        say(problem)
        return 2
    except (InputError, MissingLibraryError) as error:
        say(error)
        return 2
    except KeyboardInterrupt:
        say("interrupted. A study keeps its finished cells: repeat its command to resume.")
        return 130
    except BrokenPipeError:  # the reader of stdout has ended, as in: coopoc table FOLDER | head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (OSError, MemoryError) as error:
        say(error)
        return 1


def _dispatch(commands: Mapping[str, Command], argv: list[str], prog: str) -> int:
    """Call the command that argv names. Only that one is loaded and parsed: a quick start."""
    if not argv or argv[0] in ("-h", "--help"):
        print(_help(commands, prog))
        return 0 if argv else 2
    name, rest = argv[0], argv[1:]
    if name not in commands:
        raise unknown("command", name, commands)
    command = commands[name]
    loaded = plugins.load(command, f"{prog} {name}") if isinstance(command, EntryPoint) else command
    if loaded is run and {"-h", "--help"} & {*rest} and not rest[0].startswith("-"):
        print(_settings(rest[0]))
    if isinstance(loaded, Mapping):
        return _dispatch(loaded, rest, f"{prog} {name}")
    os.environ["COLUMNS"] = str(max(get_terminal_size().columns, 40))  # help is laid out for 40 columns at least
    return int(tyro.cli(loaded, prog=f"{prog} {name}", args=rest, config=(FlagCreatePairsOff,)) or 0)


CHOICES = {
    "start": "gnss, true",
    "scenario": "0, 1, 2",
    "velocity_reading": "axis, speed",
    "noise_model": "identity, nominal, fitted, oracle",
}
"""Keys of --set that have no group of entry points -> values."""


def _settings(name: str) -> str:
    """The keys of --set that a study has: settings with their defaults, axes with their values, and names to choose."""
    from .study.study import find_study

    study, groups = find_study(name), ("method", "recipe", "channel", "metric", "dataset")
    choices = {key: ", ".join(plugins.names(f"coopoc.{key}s")) for key in groups} | CHOICES
    choices |= {"method": "{method}, {recipe}, bound".format(**choices), "data": f"{choices['dataset']}, a path"}
    listed = () if isinstance(study.grid, Mapping) else study.axes  # a fixed list has no other values
    lines = [f"{study.name}: {study.question}", "", "keys of --set, with their defaults:"]
    for key, values in {**{k: (v,) for k, v in study.settings.items()}, **study.values()}.items():
        allowed = f"  (of {choices[key]})" if key in choices and key not in listed else ""
        lines.append(f"  {key}={','.join('' if v is None else str(v) for v in values)}{allowed}")
    return "\n".join([*lines, ""])


def _help(commands: Mapping[str, Command], prog: str) -> str:
    order = sorted(commands, key=lambda name: name not in OWN_COMMANDS)
    lines = "\n".join(f"  {name:<10} {_summary(commands[name])}" for name in order)
    return _ABOUT.format(commands=lines) if prog == "coopoc" else f"usage: {prog} COMMAND [options]\n\n{lines}"


def _summary(command: Command) -> str:
    """First line of the docstring; for a command that cannot be loaded the reason, and the others stay visible."""
    if isinstance(command, EntryPoint) and (written := plugins.summary_in(command.value)) is not None:
        return written
    try:
        loaded = command.load() if isinstance(command, EntryPoint) else command
    except Exception as error:
        return f"(cannot be loaded: {error})"
    if isinstance(loaded, Mapping):
        return " | ".join(loaded)
    return (loaded.__doc__ or "").strip().partition("\n")[0]


if __name__ == "__main__":
    main()
