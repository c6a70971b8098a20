"""Small good files, one per reader, from which fuzzing starts."""

import json

TABLE = "id,t,x,y,z,vx,vy,vz\n" + "".join(
    f"{v},{k / 10:.1f},{8 * k / 10 + 5 * (v == 'b'):.2f},1,0,8,0,0\n" for k in range(8) for v in "ab"
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
ROBOTS = (
    "".join(f"VERTEX_SE2 {k / 10:.1f} {r}{k} {k / 20} {n} 0.1\n" for k in range(6) for n, r in enumerate("AB"))
    + "".join(
        f"EDGE_SE2 {k / 10:.1f} {r}{k} {r}{k + 1} 0.05 0 0 0.01 0 0 0.01 0 0.001\n" for k in range(5) for r in "AB"
    )
    + "VERTEX_XY L0 3 4\nEDGE_RANGE 0.2 A2 L0 4.0 0.04\nEDGE_RANGE 0.3 A3 B3 1.0 0.04\n"
)
TUM = "# t x y z qx qy qz qw\n" + "".join(f"{k / 10} {k} 0 0 0 0 0.6 0.8\n" for k in range(8))
LIBRSF = {
    "a_Input.txt": "".join(
        f"range2 {k / 10} 4.0 0.01 {3 * (k % 3)} {k % 2} {k % 3} 0\nodom2diff {k / 10} 0.5 0.6 0 0.1 0.01 0.01 0.01\n"
        for k in range(6)
    ),
    "a_GT.txt": "".join(f"point2 {k / 10} {k / 20} 1 0 0 0 0\n" for k in range(6)),
}
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


def sentence(text: str) -> str:
    check = 0
    for letter in text:
        check ^= ord(letter)
    return f"${text}*{check:02X}\r\n"


NMEA = "".join(
    sentence(f"GNGGA,23595{k}.00,4808.4{k}00,N,01134.8000,E,4,20,0.6,520.0,M,46.0,M,,")
    + sentence(f"GNGST,23595{k}.00,,,,,0.020,0.010,0.050")
    + sentence(f"GNRMC,23595{k}.00,A,4808.4{k}00,N,01134.8000,E,5.0,359.0,280224,,,R")
    + sentence("GNVTG,359.0,T,,M,5.0,N,9.3,K,A")
    for k in range(5, 9)
)
CELL = "0123456789abcdef0123"
MANIFEST = json.dumps(
    {
        "study": "made",
        "question": "What?",
        "axes": ["x", "method"],
        "settings": {"runs": 4, "fleet": "town10"},
        "cells": {CELL: {"x": 1, "method": "kalman"}},
        "environment": {"python": "3.11", "numpy": "2.4"},
    },
    indent=1,
)
_MEAN = {"mean": 1.5, "low": 1.25, "high": 1.75, "n": 4}
VIEWS = json.dumps(
    {
        "cells": [CELL],
        "tables": [
            {
                "name": "rt_le",
                "caption": "Errors in m",
                "table": {
                    "header": ["x", "kalman"],
                    "rows": [["1", _MEAN], ["2", 0.5]],
                    "caption": "Errors in m",
                    "best": "min",
                    "along": "row",
                    "decimals": 2,
                    "intervals": True,
                    "notes": ["Four runs."],
                },
            }
        ],
        "figures": [],
        "findings": ["It falls."],
        "recipe": {},
        "missing": {},
        "limitations": ["One town."],
        "idle": ["seed"],
    },
    indent=1,
)
REFERENCE = json.dumps(
    {
        "study": "made",
        "settings": {"runs": 4},
        "numbers": [
            {
                "where": {"method": "kalman"},
                "metric": "rt_le_m",
                "value": 1.5,
                "runs": 4,
                "run_std": 0.1,
                "tolerance": 0.01,
            }
        ],
    },
    indent=1,
)
CARD = json.dumps({"kind": "okf", "net": {"seed": 0}, "history": [], "training_pieces": [3]})
