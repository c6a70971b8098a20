"""Mutated files: whatever stands in one, a reader returns, or raises our exceptions, without a warning and in time."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coopoc import InputError, read_graph
from coopoc.data.log import read_log
from coopoc.data.registry import load_fleet
from coopoc.formats.kitti import read_kitti
from coopoc.formats.tum import read_tum

TABLE = "id,t,x,y,z,vx,vy,vz\n" + "".join(
    f"{v},{k / 10:.1f},{8 * k / 10 + 5 * (v == 'b'):.2f},1,0,8,0,0\n" for k in range(8) for v in "ab"
)
CARLA = ",id,x,y,z,yaw,velocity x,velocity y,velocity z,ax,ay,az,wx,wy,wz\n" + "".join(
    f"{2 * k + v},{v},{0.8 * k:.2f},{10 * v},0,{-0.0:.1f},8,0,0,0,0,0,0,0,0\n" for k in range(12) for v in range(2)
)
FCD = (
    "<fcd-export>\n"
    + "".join(
        f' <timestep time="{k / 10:.2f}"><vehicle id="e" x="{k}" y="5" z="1" angle="90" speed="10" slope="0"/>'
        f'<vehicle id="f" x="{2 * k}" y="9" angle="45.5" speed="3"/></timestep>\n'
        for k in range(6)
    )
    + "</fcd-export>\n"
)
G2O = (
    "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0.1\nVERTEX_XY 2 3 4\nFIX 0\nEDGE_SE2 0 1 1 0 0.1 4 0.5 0 4 0 100\n"
    "EDGE_SE2_XY 1 2 2 4 5 1 6\nEDGE_PRIOR_SE2 0 0 0 0 9 0 0 9 0 400\nEDGE_RANGE 1 2 4.4 25\n"
)
PYFG = (
    "VERTEX_SE2 0.0 A0 0 0 0\nVERTEX_SE2 0.1 A1 1 0 0.1\nVERTEX_XY L2 3 4\n"
    "EDGE_SE2 0.1 A0 A1 1 0 0.1 0.25 0.01 0 0.25 0 0.01\nEDGE_RANGE 0.1 A1 L2 4.4 0.04\n"
    "EDGE_SE2_XY 0.1 A1 L2 2 4 0.2 0.01 0.2\nVERTEX_SE2:PRIOR 0.0 A0 0 0 0 0.1 0 0 0.1 0 0.1\n"
)
TUM = "# t x y z qx qy qz qw\n" + "".join(f"{k / 10} {k} 0 0 0 0 0.6 0.8\n" for k in range(8))
KITTI = "".join(f"1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in range(8))
MRCLAM = {
    "Barcodes.dat": "# Subject Barcode\n1 5\n2 14\n6 63\n",
    **{
        f"Robot{n}_Groundtruth.dat": "# Time x y theta\n"
        + "".join(f"{1248.0 + k / 10:.3f} {n + k / 20:.3f} 0.5 0.1\n" for k in range(12))
        for n in (1, 2)
    },
    **{
        f"Robot{n}_Odometry.dat": "# Time v w\n" + "".join(f"{1248.0 + k / 10:.3f} 0.5 0.0\n" for k in range(12))
        for n in (1, 2)
    },
    "Robot1_Measurement.dat": "# Time code r b\n1248.3 14 1.0 0.1\n1248.5 63 2.0 0.2\n",
    "Robot2_Measurement.dat": "# Time code r b\n1248.4 5 1.0 3.0\n",
}
LOG = "t,vehicle,kind,partner,value,std,arrival\n" + "".join(
    f"{k / 10},{v},x,,{0.8 * k + 5 * (v == 'b')},1.5,\n{k / 10},{v},y,,1,1.5,\n{k / 10},{v},vx,,8,0.1,\n"
    f"{k / 10},{v},vy,,0,0.1,\n{k / 10},{v},range,{'ab'.replace(v, '')},5,0.3,\n"
    f"{k / 10},{v},message,{'ab'.replace(v, '')},,,{k / 10 + 0.1}\n"
    for k in range(8)
    for v in "ab"
)
WIDE = "time,lat,lon,alt,speed,heading_deg,partner,range\n" + "".join(
    f"2024-05-01T10:00:0{k}Z,48.14{k},11.58,520,11.1,90,,\n" for k in range(8)
)
NAMES = {"t": "time", "latitude": "lat", "longitude": "lon", "height": "alt"}
FILES: dict[str, tuple[dict[str, str], Callable[[Path], Any]]] = {
    "csv": ({"a.csv": TABLE}, lambda d: load_fleet(d / "a.csv")),
    "csv resampled": ({"a.csv": TABLE}, lambda d: load_fleet(d / "a.csv", dt=0.1)),
    "carla": ({"a.csv": CARLA}, lambda d: load_fleet(d / "a.csv", handedness="left")),
    "fcd": ({"a.xml": FCD}, lambda d: load_fleet(d / "a.xml")),
    "tum": ({"a.tum": TUM}, lambda d: load_fleet(d / "a.tum")),
    "tum poses": ({"a.tum": TUM}, lambda d: read_tum(d / "a.tum", repeats="drop")),
    "kitti": ({"a.txt": KITTI}, lambda d: read_kitti(d / "a.txt")),
    "g2o": ({"a.g2o": G2O}, lambda d: read_graph(d / "a.g2o")),
    "pyfg": ({"a.pyfg": PYFG}, lambda d: read_graph(d / "a.pyfg")),
    "mrclam": (MRCLAM, load_fleet),
    "log": ({"log.csv": LOG}, lambda d: read_log(d / "log.csv", any_scale=True)),
    "wide log": ({"car.csv": WIDE}, lambda d: read_log(d / "car.csv", columns=NAMES)),
}
TOKENS = (
    *("", "nan", "-nan", "inf", "1e308", "-1e308", "1e-320", "1e999", "0", "-1", "0x10", "1_0", "١٢", "9" * 400, "1,5"),
    *("#", '"', "\x00", "\n", "\r", ",", " ", "\ufeff", "\u2028", "é", "a" * 3000, "1700000000000000000", "2024-01-01"),
    *("true", "None", "=1+1", "<", ">", "&amp;", "&x;", "\x0b", "\x1c", "%s", "../x", "NaT", "1e5", "+-1", "1d3"),
)


def mutated(text: str, rng: np.random.Generator) -> bytes:
    """One to four changes: a token or a byte replaced, a line repeated, moved or cut, the end torn off."""
    data = text
    for _ in range(rng.integers(1, 5)):
        kind, at = int(rng.integers(8)), int(rng.integers(max(len(data), 1)))
        lines = data.split("\n")
        line = int(rng.integers(len(lines)))
        if kind <= 2:
            words = (
                data.replace(",", "\0,\0")
                .replace(" ", "\0 \0")
                .replace('"', '\0"\0')
                .replace("\n", "\0\n\0")
                .split("\0")
            )
            words[int(rng.integers(len(words)))] = str(rng.choice(TOKENS))
            data = "".join(words)
        elif kind == 3:
            data = data[:at] + chr(int(rng.choice([*range(32, 127), 0, 9, 228, 8232]))) + data[at + 1 :]
        elif kind == 4:
            data = "\n".join([*lines[: line + 1], *lines[line:]])
        elif kind == 5:
            data = "\n".join([*lines[:line], *lines[line + 1 :]])
        elif kind == 6:
            other = int(rng.integers(len(lines)))
            lines[line], lines[other] = lines[other], lines[line]
            data = "\n".join(lines)
        else:
            data = data[:at] if rng.uniform() < 0.5 else data[at:]
    raw = data.encode("utf-8", "surrogatepass")
    if rng.uniform() < 0.1 and raw:
        cut = int(rng.integers(len(raw)))
        raw = raw[:cut] + bytes([int(rng.integers(256))]) + raw[cut + 1 :]
    return raw


def verdict(read: Callable[[Path], Any], folder: Path) -> str:
    """Nothing, or what is wrong with the way in which the reader ended."""
    began = time.process_time()
    try:
        read(folder)
    except InputError as error:
        return "" if len(str(error)) < 5000 else "a message without end"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "" if time.process_time() - began < 2.0 else "slow"


@pytest.mark.parametrize("name", FILES)
def test_a_mutated_file_ends_in_our_exceptions(tmp_path: Path, name: str) -> None:
    files, read = FILES[name]
    for file, text in files.items():
        (tmp_path / file).write_text(text)
    read(tmp_path)  # as it stands it is right
    found = {}
    for seed in range(int(os.environ.get("COOPOC_MUTANTS", "70"))):
        rng = np.random.default_rng([seed, len(name)])
        file = sorted(files)[int(rng.integers(len(files)))]
        (tmp_path / file).write_bytes(mutated(files[file], rng))
        if wrong := verdict(read, tmp_path):
            found[seed] = wrong
        (tmp_path / file).write_text(files[file])
    assert not found
