"""Seven robots that stand and range one another (TIERS): places from ranges, as measured and less their common offset.

    python benchmarks/standing.py FOLDER [BACKEND ...]      # a Markdown table; FOLDER holds test1_0.db3, however deep

No robot of this ROS 2 bag moves, and no odometry is in it: there is nothing to filter. The medians of the ranges of
each pair place four robots from three whose places are known, so that nothing is left to turn or mirror. The offset is
the mean error of the ranges between these three.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from tabulate import tabulate

import coopoc as co
from coopoc.studies.pose_drives import hashed
from coopoc.studies.tasks import RANGE_STD, located

FILE, KNOWN = "test1_0.db3", ("1", "2", "4")


def medians(path: Path) -> dict[str, Any]:
    """Place (2,) m of each robot, by its digit, and range m of each pair, by both."""
    made: dict[str, list[Any]] = {}
    with AnyReader([path.parent], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for topic, _, raw in reader.messages():
            m: Any = reader.deserialize(raw, topic.msgtype)
            name = "".join(sorted(letter for letter in topic.topic if letter.isdigit()))
            made.setdefault(name, []).append(m.range if len(name) == 2 else (m.pose.position.x, m.pose.position.y))
    return {name: np.median(values, axis=0) for name, values in made.items()}


def begin(places: dict[str, Any], ranges: dict[str, float], name: str) -> Any:
    """(2,) m from the ranges to the known robots: the difference of two squared ranges is linear in the place."""
    centres = np.array([places[other] for other in KNOWN])
    square = np.square(centres).sum(1) - [ranges["".join(sorted(name + other))] ** 2 for other in KNOWN]
    return np.linalg.solve(2 * (centres[1:] - centres[0]), square[1:] - square[0])


def rows(path: Path, backends: tuple[str, ...]) -> list[list[Any]]:
    """Backend, offset m, errors m of the four robots and their root mean square, ms."""
    found = medians(path)
    places = {name: place for name, place in found.items() if len(name) == 1}
    pairs = [name for name in found if len(name) == 2 and set(name) <= set(places)]
    off = {pair: found[pair] - np.linalg.norm(places[pair[0]] - places[pair[1]]) for pair in pairs}
    common = float(np.mean([off[pair] for pair in pairs if set(pair) <= set(KNOWN)]))
    print(f"{len(pairs)} pairs, ranges {min(off.values()):+.2f} to {max(off.values()):+.2f} m off", file=sys.stderr)
    made = []
    for backend in backends:
        for offset in (0.0, common):
            ranges = {pair: float(found[pair]) - offset for pair in pairs}
            x0 = np.array([places[k] if k in KNOWN else begin(places, ranges, k) for k in places])
            problem = co.Problem(tuple(places), x0=x0, dimension=2)
            problem = problem.add("position", KNOWN, [places[name] for name in KNOWN], std=1e-3)
            problem = problem.add("range", [*map(tuple, pairs)], [[ranges[pair]] for pair in pairs], std=RANGE_STD)
            solution = co.solve(problem, backend)
            gaps = [np.linalg.norm(solution.x[i] - places[k]) for i, k in enumerate(places) if k not in KNOWN]
            level = float(np.sqrt(np.mean(np.square(gaps))))
            made.append([backend, offset, *gaps, level, 1e3 * solution.solve_seconds])
    return made


if __name__ == "__main__":
    folder, *named = sys.argv[1:]
    file = located(Path(folder), FILE)
    table = rows(file, tuple(named) or ("gauss-newton",))
    header = ["backend", "offset [m]", "four robots [m]", "", "", "", "rms [m]", "ms"]
    print(f"{file.name}, {hashed(file)}\n\n" + tabulate(table, header, tablefmt="github", floatfmt=".3f"))
