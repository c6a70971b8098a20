"""Make a bundled fleet again, or another one: OpenDRIVE map -> netconvert, routes, SUMO, smoothing -> table and card.

    python examples/make_fleet.py town10 --maps carla_maps

CARLA's maps (MIT licence) are not part of the package; SUMO comes with pip install 'coopoc[sumo]'. The same recipe and
the SUMO that the card names give the same bytes.
"""

import argparse
import importlib.util
import json
import subprocess
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import solveh_banded
from scipy.sparse import diags_array, eye_array

from coopoc.data.assemble import backward_difference
from coopoc.data.fleet_files import read_fcd
from coopoc.data.registry import DATASETS, card
from coopoc.errors import InputError, MissingLibraryError, unknown
from coopoc.paths import write
from coopoc.text import spreadsheet
from coopoc.world.fleet import Fleet

Streets = dict[str, tuple[str, ...]]
VEHICLE_LENGTH = 4.6
"""Metres from bumper to bumper of every generated vehicle."""
DRIVER = 'sigmaStep="1" speedFactor="1" speedDev="0" accel="2" decel="3.5" tau="0.8" minGap="2"'
"""Krauss' model: m/s^2, s and m as in dense city traffic; dawdling changes once a second, not at every 0.1 s."""
JUMP = 8.0
"""m/s^2, less than the grip of a dry road."""
RADIUS, CAP = 30.0, 10
"""m and number of the neighbours that a card counts."""
DT, WARMUP = 0.1, 60.0
"""s: the sampling interval, and what is driven before the first step that is kept."""
CUTOFF = 0.5
"""Hz, half-power frequency of the smoother."""
TURN_ACCELERATION = 3.0
"""m/s^2, lateral, that limits the speed in turns of junctions."""
MAP_LICENCE = "MIT (CARLA project)"


@dataclass(frozen=True)
class Recipe:
    """Settings of a SUMO run, and the part of it that is kept: everything that decides the numbers of a fleet.

    Args:
        name: name of the fleet; vehicles are called name-00, name-01, ...
        map: OpenDRIVE file in the folder of maps.
        vehicles: number of vehicles N.
        steps: steps that are kept, one number for all or one per vehicle (absent, NaN, afterwards).
        seed: of routes, top speeds and SUMO.
        top_speed: (low, high) m/s, each vehicle's own top speed is uniform between them.
        platoon: vehicles that share one random route and start on the same edge.
        start: SUMO's departPos: "random_free" spreads a platoon over its first edge, "last" queues it.
        lights: True: netconvert guesses junctions with traffic lights, actuated; False: junctions of equal rank.
        tours: routes that are repeated instead of random ones, for the first vehicles: edge ids with spaces between.
        dawdle: Krauss' sigma in 0..1, how irregularly a driver keeps the speed.

    >>> Recipe("tiny", "Town10HD.xodr", vehicles=2, steps=20, seed=1).lengths
    (20, 20)
    """

    name: str
    map: str
    vehicles: int
    steps: int | tuple[int, ...]
    seed: int
    top_speed: tuple[float, float] = (8.0, 11.0)
    platoon: int = 1
    start: str = "random_free"
    lights: bool = True
    tours: tuple[str, ...] = ()
    dawdle: float = 0.5

    @property
    def lengths(self) -> tuple[int, ...]:
        """Kept steps of each vehicle."""
        return (self.steps,) * self.vehicles if isinstance(self.steps, int) else tuple(self.steps)

    @property
    def duration(self) -> float:
        """s, with the warm-up."""
        return WARMUP + max(self.lengths) * DT


def bundled_recipe(name: str) -> Recipe:
    """Of a bundled fleet, from its card.

    >>> bundled_recipe("town04").vehicles
    60
    """
    stored = card(name)["recipe"].items()
    fields: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in stored}
    return Recipe(**fields)


def make(recipe: str | Recipe, map_folder: str | Path, out_folder: str | Path) -> dict[str, Any]:
    """Drive a recipe in SUMO and write <name>.parquet and its card <name>.json: the same recipe, the same bytes.

    Args:
        recipe: a Recipe, or the name of a bundled fleet.
        map_folder: holds the OpenDRIVE file that the recipe names (CARLA's maps: MIT licence, not part of the package).
        out_folder: is created if needed; files of the same name are replaced.

    Returns:
        The card.

    Raises:
        InputError: an unknown recipe, a missing map; a vehicle that could not drive or that jumps: take another seed.
        MissingLibraryError: eclipse-sumo is not installed.
    """
    command = "make(Recipe(**card['recipe']), MAPS, OUT) of examples/make_fleet.py"
    if not isinstance(recipe, Recipe):
        if recipe not in DATASETS:
            raise unknown("recipe", recipe, DATASETS, "Or build a Recipe of your own, in Python.")
        command, recipe = f"python examples/make_fleet.py {recipe} --maps FOLDER", bundled_recipe(recipe)
    fleet, out = simulate(recipe, Path(map_folder)), Path(out_folder)
    out.mkdir(parents=True, exist_ok=True)
    write_table(fleet, out / f"{recipe.name}.parquet", velocity=False)
    origin = {"name": recipe.name, "map": recipe.map, "map_licence": MAP_LICENCE, "command": command}
    settings = {"sumo": version("eclipse-sumo"), "recipe": asdict(recipe)}
    made = {**origin, **settings, **facts(fleet)}
    made["words"] = in_words(made)
    (out / f"{recipe.name}.json").write_text(json.dumps(made, indent=1) + "\n")
    return made


def write_table(fleet: Fleet, path: Path, velocity: bool = True) -> None:
    """Write id, t, x, y, z and, if asked for, vx, vy, vz of every present vehicle and instant, vehicle by vehicle, to a
    .parquet or (any other ending) CSV file; numbers come back bit by bit."""
    columns = ["id", "t", "x", "y", "z", *velocity * ("vx", "vy", "vz")]
    frame = fleet.to_frame().rename(columns={"vehicle": "id"}).round({"t": 6})[columns]
    frame = frame.sort_values("id", key=lambda ids: ids.map(fleet.ids.index), kind="stable")
    if path.suffix.lower() != ".parquet":
        write(path, frame.assign(id=frame["id"].map(spreadsheet)).to_csv(index=False, lineterminator="\n"))
    else:
        split = dict.fromkeys(frame.columns[2:], "BYTE_STREAM_SPLIT")
        options: dict[str, Any] = {"use_dictionary": ["id", "t"], "column_encoding": split}
        write(path, lambda file: frame.to_parquet(file, index=False, compression="zstd", **options))


def in_words(facts: dict[str, Any]) -> dict[str, str]:
    """Where a fleet comes from, its size and statistics, as texts."""
    near, speed, height = facts["neighbours"], facts["speed"], facts["height"]
    return {
        "map": f"{facts['map']}, {facts['map_licence']}",
        "made by": f"{facts['command']} (SUMO {facts['sumo']})",
        "sha256": facts["sha256"],
        "size": f"{facts['vehicles']} vehicles x {facts['steps']} steps of {facts['dt']:g} s",
        "speed": f"{speed['min']:g}..{speed['max']:g} m/s, mean {speed['mean']:g}, standing {speed['standing']:.0%}",
        **{f"speed of {k}": f"{low:g}..{high:g} m/s" for k, (low, high) in enumerate(facts.get("speeds", ()), 1)},
        "neighbours": f"mean {near['mean']:g} within {near['radius']:g} m (cap {near['cap']:g}), some in "
        f"{near['any']:.0%} of the steps",
        "height": f"{height[0]:g}..{height[1]:g} m",
        "acceleration": f"at most {facts['acceleration']:g} m/s^2",
    }


def facts(fleet: Fleet) -> dict[str, Any]:
    """Size and statistics of a fleet: speed m/s, neighbours within RADIUS, height m, largest acceleration m/s^2.

    >>> x = np.array([[[0.0, 0, 0], [9, 0, 0], [99, 0, 0]]] * 2)
    >>> facts(Fleet(("a", "b", "c"), [0, 0.1], x, 0 * x))["neighbours"]["mean"]
    0.667
    """
    speed = np.linalg.norm(fleet.velocity, axis=2)[fleet.present]
    near = [np.linalg.norm(x[:, None] - x[None], axis=2) <= RADIUS for x in fleet.position]
    counts = np.minimum(np.array([n.sum(axis=1) for n in near]) - 1.0, CAP)[fleet.present]
    change = np.linalg.norm(np.diff(fleet.velocity, axis=0), axis=2)
    z = fleet.position[fleet.present][:, 2]
    each = [np.linalg.norm(fleet.velocity[there, k], axis=1) for k, there in enumerate(fleet.present.T)]
    ranges = [[round(float(end), 1) for end in (v.min(), v.max())] for v in each]
    lengths = sorted(set(fleet.present.sum(axis=0).tolist()))
    return {
        "sha256": fleet.digest,
        "vehicles": len(fleet.ids),
        "steps": lengths[0] if len(lengths) == 1 else f"{lengths[0]}..{lengths[-1]}",
        "dt": fleet.dt,
        "speed": _rounded(min=speed.min(), mean=speed.mean(), max=speed.max(), standing=np.mean(speed < 0.1)),
        **({"speeds": ranges} if len(lengths) > 1 else {}),
        "neighbours": _rounded(radius=RADIUS, cap=CAP, mean=counts.mean(), any=np.mean(counts > 0)),
        "height": [round(float(z.min()), 3), round(float(z.max()), 3)],
        "acceleration": round(float(np.nanmax(change, initial=0.0)) / fleet.dt, 3),
    }


def _rounded(**values: Any) -> dict[str, float]:
    return {name: round(float(value), 3) + 0.0 for name, value in values.items()}


def smooth(position: np.ndarray, dt: float, cutoff: float) -> np.ndarray:
    """Penalised least squares on jerk: argmin_s |s - x|^2 + lam |D^3 s|^2, with lam = (2 pi cutoff dt)^-6.

    The gain is 1 below the cutoff, 1/2 at it, and falls with the sixth power of the frequency above it; straight
    lines and constant accelerations pass unchanged, and so do both ends of the drive.

    Args:
        position: (T, ...) m, no NaN.
        dt: s.
        cutoff: Hz.

    Source: Whittaker, Proc. Edinburgh Math. Soc. 41, 1923; Eilers, Analytical Chemistry 75(14), 2003.

    >>> bool(np.allclose(smooth(np.arange(9.0) ** 2, 0.1, 0.5), np.arange(9.0) ** 2))
    True
    """
    steps = len(position)
    if steps < 4:
        return np.array(position, dtype=float)
    third = diags_array([-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(steps - 3, steps))
    normal = (eye_array(steps) + (2 * np.pi * cutoff * dt) ** -6 * (third.T @ third)).todia()
    return np.asarray(solveh_banded(normal.data[:2:-1], np.reshape(position, (steps, -1)))).reshape(np.shape(position))


def simulate(recipe: Recipe, map_folder: Path) -> Fleet:
    """The fleet of a recipe, in whole 0.1 mm: map, routes, SUMO, centres of the vehicles, smoothing, velocities."""
    with tempfile.TemporaryDirectory() as folder:
        network, routes, fcd = (Path(folder) / f for f in ("net.xml", "routes.xml", "fcd.xml"))
        _build_network(map_folder / recipe.map, recipe, network)
        _write_routes(recipe, *_read_streets(network), routes)
        _drive(recipe, network, routes, fcd)
        raw = read_fcd(fcd, vehicle_length=VEHICLE_LENGTH)
    ids, steps = sorted(raw.ids), max(recipe.lengths)
    position = raw.select(ids).position[:steps]
    if len(ids) < recipe.vehicles or len(position) < steps or np.isnan(position).any():
        allowed = f"must drive {recipe.vehicles} vehicles through all steps"
        hint = f"{len(ids)} departed; try another seed, fewer vehicles or smaller platoons."
        raise InputError("recipe", f"{recipe.name}, seed {recipe.seed}", allowed, hint)
    position = np.round(smooth(position, DT, CUTOFF), 4)
    for column, last in enumerate(recipe.lengths):
        position[last:, column] = np.nan
    t = np.arange(steps) / round(1 / DT)
    fleet = Fleet(tuple(ids), t, position, backward_difference(t, position, ids), name=recipe.name)
    acceleration = facts(fleet)["acceleration"]
    if acceleration > JUMP:
        raise InputError("acceleration", f"{acceleration} m/s^2", f"must stay below {JUMP} m/s^2", "Try another seed.")
    return fleet


def program(name: str) -> Path:
    """Path of one of SUMO's programs; MissingLibraryError if eclipse-sumo is not installed."""
    spec = importlib.util.find_spec("sumo")
    if spec is None or spec.origin is None:
        raise MissingLibraryError("eclipse-sumo", "making a fleet", "'coopoc[sumo]'")
    return Path(spec.origin).parent / "bin" / name


def _build_network(map_file: Path, recipe: Recipe, out: Path) -> None:
    """Write the SUMO network of an OpenDRIVE map, in the frame of the map, elevation kept.

    The map has signals but no programmes, and netconvert misreads the signals' places: lights are guessed, or left out.
    """
    if not map_file.is_file():
        hint = "Point --maps at the folder of CARLA's .xodr files."
        raise InputError("map", map_file, "must be an OpenDRIVE file", hint)
    options = {
        "opendrive": map_file,
        "output-file": out,
        "offset.disable-normalization": "true",
        "opendrive.curve-resolution": 0.5,
        "junctions.internal-link-detail": 20,
        "junctions.limit-turn-speed": TURN_ACCELERATION,
        "tls.discard-loaded": "true",
        "tls.guess": str(recipe.lights).lower(),
        "tls.default-type": "actuated",
        "precision": 6,
    }
    _run("netconvert", options)


def _read_streets(network: Path) -> tuple[Streets, dict[str, float]]:
    """Successors and length (m) of every edge from which every other one can be reached."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

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


def _write_routes(recipe: Recipe, streets: Streets, length: dict[str, float], out: Path) -> None:
    """Write one SUMO vehicle per line: a tour that is repeated, or a random walk that a platoon shares."""
    rng = np.random.default_rng(recipe.seed)
    distance = recipe.top_speed[1] * recipe.duration + 500.0
    lines, route = ["<routes>"], list[str]()
    for vehicle in range(recipe.vehicles):
        if vehicle < len(recipe.tours):
            route = recipe.tours[vehicle].split()
            route *= int(np.ceil(distance / sum(length[edge] for edge in route)))
        elif (vehicle - len(recipe.tours)) % recipe.platoon == 0:
            route = _walk(streets, length, distance, rng)
        name, fastest = f"{recipe.name}-{vehicle:02d}", rng.uniform(*recipe.top_speed)
        size = f'length="{VEHICLE_LENGTH}" maxSpeed="{fastest:.3f}" sigma="{recipe.dawdle}"'
        begin = f'depart="0" departPos="{recipe.start}" departLane="random"'
        lines.append(f'<vType id="{name}" {size} {DRIVER}/>')
        lines.append(f'<vehicle id="{name}" type="{name}" {begin}><route edges="{" ".join(route)}"/></vehicle>')
    out.write_text("\n".join([*lines, "</routes>\n"]))


def _walk(streets: Streets, length: dict[str, float], distance: float, rng: np.random.Generator) -> list[str]:
    edges = sorted(streets)
    share = np.array([length[e] for e in edges])
    route = [edges[rng.choice(len(edges), p=share / share.sum())]]
    while distance > 0:
        route.append(streets[route[-1]][rng.integers(len(streets[route[-1]]))])
        distance -= length[route[-1]]
    return route


def _drive(recipe: Recipe, network: Path, routes: Path, out: Path) -> None:
    """Run SUMO over the warm-up and the kept steps and write positions of the front bumper, angle and slope.

    Teleporting is switched off: a vehicle that is stuck stays stuck. Collisions are left to the car-following model.
    """
    options = {
        "net-file": network,
        "route-files": routes,
        "end": f"{recipe.duration:.3f}",
        "step-length": DT,
        "seed": recipe.seed,
        "precision": 6,
        "fcd-output": out,
        "fcd-output.attributes": "x,y,z,angle,slope,speed",
        "device.fcd.begin": WARMUP,
        "lanechange.duration": 3,
        "time-to-teleport": -1,
        "ignore-junction-blocker": 5,
        "collision.action": "none",
        "no-step-log": "true",
        "xml-validation": "never",
    }
    _run("sumo", options)


def _run(name: str, options: Mapping[str, object]) -> None:
    words = [f"--{key}={value}" for key, value in options.items()]
    done = subprocess.run([program(name), *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise InputError(name, done.stderr.strip()[-400:], "must run without an error", "Check the map and the recipe.")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recipe", choices=[*DATASETS], help="name of a bundled fleet")
    parser.add_argument("--maps", type=Path, required=True, help="folder with the .xodr files of CARLA")
    parser.add_argument("--out", type=Path, default=Path("fleets"), help="folder for the fleet and its card")
    given = parser.parse_args()
    print(json.dumps(make(given.recipe, given.maps, given.out), indent=1))
