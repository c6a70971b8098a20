"""Every benchmark in one run, as one report, with a gate on ratios.

    OMP_NUM_THREADS=1 python benchmarks/run.py                     # report on stdout, benchmarks/results.json
    OMP_NUM_THREADS=1 python benchmarks/run.py --gate              # fails where a ratio has grown
    python benchmarks/run.py --only backends growth --gate         # some of them
    python benchmarks/run.py --baseline                            # write what was measured as the new baseline

A row's ratio is its time over that of another row of the same run, so that it means the same on every machine. The
gate compares it with baseline.json and names the rows that are slower by more than their tolerance, or were not
measured. A row whose answer is wrong fails always. Rows that the baseline does not name are peers or new.
"""

import argparse
import importlib
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from timing import report

HERE = Path(__file__).parent
BENCHMARKS = (
    "compile",
    "classical",
    "networked",
    "cliffs",
    "learned_gain",
    "backends",
    "building",
    "peers",
    "poses",
    "fleet",
    "growth",
)
"""Modules beside this one; each has measured() -> rows {name, us, ratio, right}."""
BASELINE, RESULTS = HERE / "baseline.json", HERE / "results.json"
TOLERANCE = 1.5
"""Of a new baseline's rows: two runs on a shared machine differ by less."""
PYTHON, WIDE = 0.1, 2.5
"""Ratio below which a row stands against an interpreter, whose time varies more from machine to machine than compiled
code does, and its tolerance."""
OURS = ("cliffs", "compiled", "JointFilter", "BatchSmoother", "engine", "ours", "import", "vehicles")
"""Words of the rows that a new baseline names: a peer's time is not ours to keep."""

Rows = Sequence[Mapping[str, Any]]


def wrong(rows: Rows) -> list[str]:
    """What to say of the rows whose answer is not right."""
    return [f"{row['name']}: the answer is wrong" for row in rows if row["right"] is False]


def slower(rows: Rows, baseline: Mapping[str, Mapping[str, float]], measured: Sequence[str]) -> list[str]:
    """What to say of the baseline's rows that were not measured or whose ratio exceeds theirs times their tolerance.

    Args:
        baseline: ratio and tolerance by name.
        measured: benchmarks that have run, the first word of their rows' names.
    """
    ratios, failures = {row["name"]: row["ratio"] for row in rows}, []
    for name, wanted in baseline.items():
        if name.partition(": ")[0] not in measured:
            continue
        tolerance = max(wanted["tolerance"], WIDE * (wanted["ratio"] < PYTHON))
        limit = wanted["ratio"] * tolerance
        if name not in ratios:
            failures.append(f"{name}: in the baseline, but not measured")
        elif not ratios[name] <= limit:
            failures.append(
                f"{name}: ratio {ratios[name]:.3g}, at most {limit:.3g} allowed ({wanted['ratio']:.3g} x "
                f"{tolerance:.3g})"
            )
    return failures


def kept(rows: Rows, baseline: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """The baseline of these rows, with the tolerances that it had."""
    return {
        row["name"]: {
            "ratio": float(f"{row['ratio']:.3g}"),
            "tolerance": baseline.get(row["name"], {}).get("tolerance", TOLERANCE),
        }
        for row in rows
        if any(word in row["name"] for word in OURS) and row["right"]
    }


def gather(names: Sequence[str], load: Callable[[str], Any] = importlib.import_module) -> list[dict[str, Any]]:
    """The rows of some benchmarks, their names with that of the benchmark before them."""
    out = []
    for name in names:
        print(f"{name} ...", file=sys.stderr)
        out += [{**row, "name": f"{name}: {row['name']}"} for row in load(name).measured()]
    return out


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the report; 1 if a row is wrong or, with --gate, slower than it was."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--gate", action="store_true")
    parser.add_argument("--baseline", action="store_true")
    parser.add_argument("--only", nargs="+", choices=BENCHMARKS, default=BENCHMARKS)
    given = parser.parse_args(arguments)
    rows = gather(given.only)
    print(report(rows))
    RESULTS.write_text(json.dumps(rows, indent=1) + "\n")
    baseline = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    failures = wrong(rows) + (slower(rows, baseline, given.only) if given.gate else [])
    if given.baseline:
        others = {name: row for name, row in baseline.items() if name.partition(": ")[0] not in given.only}
        BASELINE.write_text(json.dumps(others | kept(rows, baseline), indent=1) + "\n")
    print("".join(f"\nFAILED {line}" for line in failures))
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main())
