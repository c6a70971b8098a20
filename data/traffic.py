"""OpenDRIVE map -> netconvert -> routes -> SUMO -> the file of floating-car data that `fcd.read_fcd` reads."""

from __future__ import annotations

import importlib.util
import subprocess
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from coopoc.errors import InputError, MissingLibraryError
from coopoc.plugins import suggestion

from .recipes import Recipe

Streets = dict[str, tuple[str, ...]]
VEHICLE_LENGTH = 4.6
"""Metres from bumper to bumper of every generated vehicle."""
DRIVER = 'sigmaStep="1" speedFactor="1" speedDev="0" accel="2" decel="3.5" tau="0.8" minGap="2"'
"""Krauss' model: m/s^2, s and m as in dense city traffic; dawdling changes once a second, not at every 0.1 s."""


def program(name: str) -> Path:
    """Path of one of SUMO's programs; MissingLibraryError if eclipse-sumo is not installed."""
    spec = importlib.util.find_spec("sumo")
    if spec is None or spec.origin is None:
        raise MissingLibraryError("eclipse-sumo", "making a fleet", "'coopoc[sumo]'")
    return Path(spec.origin).parent / "bin" / name


def build_network(map_file: Path, recipe: Recipe, out: Path) -> None:
    """Write the SUMO network of an OpenDRIVE map, in the frame of the map, elevation kept.

    The map has signals but no programmes, and netconvert misreads the signals' places: lights are guessed, or left out.
    """
    if not map_file.is_file():
        raise InputError(
            "map", map_file, "must be an OpenDRIVE file", "Point --maps at the folder of CARLA's .xodr files."
        )
    options = {
        "opendrive": map_file,
        "output-file": out,
        "offset.disable-normalization": "true",
        "opendrive.curve-resolution": 0.5,
        "junctions.internal-link-detail": 20,
        "junctions.limit-turn-speed": recipe.turn_acceleration,
        "tls.discard-loaded": "true",
        "tls.guess": str(recipe.lights).lower(),
        "tls.default-type": "actuated",
        "precision": 6,
    }
    _run("netconvert", options)


def read_streets(network: Path) -> tuple[Streets, dict[str, float]]:
    """Successors and length (m) of every edge from which every other one can be reached."""
    root = ElementTree.parse(network).getroot()
    length = {e.attrib["id"]: float(e[-1].attrib["length"]) for e in root.iter("edge") if e.get("function") is None}
    links = sorted({(c.attrib["from"], c.attrib["to"]) for c in root.iter("connection") if c.get("dir") != "t"})
    links = [(a, b) for a, b in links if a in length and b in length]
    order = {edge: k for k, edge in enumerate(length)}
    rows, columns = np.array([[order[a], order[b]] for a, b in links]).T
    graph = coo_array((np.ones(len(links)), (rows, columns)), shape=(len(order), len(order)))
    labels = connected_components(graph, connection="strong")[1]
    largest = np.bincount(labels).argmax()
    kept = [edge for edge, k in order.items() if labels[k] == largest]
    streets = {edge: tuple(b for a, b in links if a == edge and b in kept) for edge in kept}
    return streets, {edge: length[edge] for edge in kept}


def write_routes(recipe: Recipe, streets: Streets, length: dict[str, float], out: Path) -> None:
    """Write one SUMO vehicle per line: a tour that is repeated, or a random walk that a platoon shares."""
    rng = np.random.default_rng(recipe.seed)
    distance = recipe.top_speed[1] * (recipe.warmup + max(recipe.lengths) * recipe.dt) + 500.0
    lines, route = ["<routes>"], []
    for vehicle in range(recipe.vehicles):
        if vehicle < len(recipe.tours):
            route = _tour(recipe.tours[vehicle], length, distance)
        elif (vehicle - len(recipe.tours)) % recipe.platoon == 0:
            route = _walk(streets, length, distance, rng)
        lines += _vehicle(recipe, vehicle, route, rng.uniform(*recipe.top_speed))
    out.write_text("\n".join([*lines, "</routes>\n"]))


def drive(recipe: Recipe, network: Path, routes: Path, out: Path) -> None:
    """Run SUMO over the warm-up and the kept steps and write positions of the front bumper, angle and slope.

    Teleporting is switched off: a vehicle that is stuck stays stuck. Collisions are left to the car-following model.
    """
    options = {
        "net-file": network,
        "route-files": routes,
        "end": f"{recipe.warmup + max(recipe.lengths) * recipe.dt:.3f}",
        "step-length": recipe.dt,
        "seed": recipe.seed,
        "precision": 6,
        "fcd-output": out,
        "fcd-output.attributes": "x,y,z,angle,slope,speed",
        "device.fcd.begin": recipe.warmup,
        "lanechange.duration": 3,
        "time-to-teleport": -1,
        "ignore-junction-blocker": 5,
        "collision.action": "none",
        "no-step-log": "true",
        "xml-validation": "never",
    }
    _run("sumo", options)


def _tour(tour: str, length: dict[str, float], distance: float) -> list[str]:
    edges = tour.split()
    wrong = [e for e in edges if e not in length]
    if wrong:
        hint = suggestion(wrong[0], length, "Take ids from the file netconvert writes.")
        raise InputError("tours", wrong, "must be edges of the network", hint)
    return edges * int(np.ceil(distance / sum(length[e] for e in edges)))


def _walk(streets: Streets, length: dict[str, float], distance: float, rng: np.random.Generator) -> list[str]:
    edges = sorted(streets)
    share = np.array([length[e] for e in edges])
    route = [edges[rng.choice(len(edges), p=share / share.sum())]]
    while distance > 0:
        route.append(streets[route[-1]][rng.integers(len(streets[route[-1]]))])
        distance -= length[route[-1]]
    return route


def _vehicle(recipe: Recipe, number: int, route: list[str], top_speed: float) -> list[str]:
    name = f"{recipe.name}-{number:02d}"
    return [
        f'<vType id="{name}" length="{VEHICLE_LENGTH}" maxSpeed="{top_speed:.3f}" sigma="{recipe.dawdle}" {DRIVER}/>',
        f'<vehicle id="{name}" type="{name}" depart="0" departPos="{recipe.start}" departLane="random">'
        f'<route edges="{" ".join(route)}"/></vehicle>',
    ]


def _run(name: str, options: Mapping[str, object]) -> None:
    words = [f"--{key}={value}" for key, value in options.items()]
    done = subprocess.run([program(name), *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise InputError(name, done.stderr.strip()[-400:], "must run without an error", "Check the map and the recipe.")
