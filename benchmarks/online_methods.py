"""Online cooperative methods on one drive against the bounds: error, consistency, bytes and time, as one table.

Run:  python benchmarks/online_methods.py                         (town10, K = 10, 3 runs, 3 egos: some minutes)
      python benchmarks/online_methods.py --runs 10 --neighbours 2 --steps 300

White noise of the paper's second scenario, nominal noise model, ideal channel. NEES of 3 is consistent; inside is the
share of steps whose run-averaged NEES lies in its 99 % band. Milliseconds are per step, run and ego (whole-fleet
methods: per step, run and vehicle), on whatever this machine was doing.
"""

import argparse

import numpy as np
from tabulate import tabulate

import coopoc as co
from coopoc.evaluate.metrics import share_of_average
from coopoc.methods.catalogue import METHODS, needs_whole_fleet

ORDER = (
    "gnss",
    "kalman",
    "ci",
    "split-ci",
    "msmv-r",
    "joint",
    "cooperative-filter",
    "batch-smoother",
)
SENSORS = co.Sensors.paper_scenario2()


def row(name: str, fleet: co.Fleet, recording: co.Recording, egos: tuple[int, ...]) -> list[object]:
    """One method: RT-LE, NEES, share inside its band, bytes per second, milliseconds."""
    track = METHODS[name]("nominal")(recording, egos)
    duration = len(track.t) * recording.dt
    served = len(fleet.ids) if needs_whole_fleet(name) else len(egos)
    claims = track.covariance is not None
    return [
        name,
        float(co.rt_le(track, fleet).mean()),
        float(np.nanmean(co.nees(track, fleet))) if claims else None,
        float(share_of_average(co.nees(track, fleet).mean(axis=0), recording.runs).mean()) if claims else None,
        float(track.received_bytes.mean() / duration),
        float(track.sent_bytes.mean() / duration),
        1e3 * track.seconds / len(track.t) / recording.runs / served,
    ]


def bounds(fleet: co.Fleet, egos: tuple[int, ...], v2x: co.V2X) -> list[list[object]]:
    """RT-LE that no unbiased estimate of the same information beats."""
    found: list[list[object]] = []
    for smoothing in (False, True):
        kind = "smoothing" if smoothing else "filtering"
        for words, channel in (("solo", None), ("star", v2x)):
            each = [
                co.bound_rt_le(co.posterior_bound(fleet, SENSORS, ego, channel, smoothing=smoothing)) for ego in egos
            ]
            found.append([f"bound, {words}, {kind}", float(np.mean(each))])
        whole = co.fleet_bound(fleet, SENSORS, v2x, smoothing=smoothing)
        found.append([f"bound, whole fleet, {kind}", float(np.mean([co.bound_rt_le(whole[:, ego]) for ego in egos]))])
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--neighbours", type=int, default=10)
    parser.add_argument("--steps", type=int, default=900)
    parser.add_argument("--methods", default=",".join(ORDER))
    given = parser.parse_args()
    fleet, egos = co.load_fleet("town10").between(0, given.steps), (0, 12, 24)
    v2x = co.V2X(max_neighbours=given.neighbours)
    recording = co.observe(fleet, SENSORS, v2x, runs=given.runs, seed=0)
    rows = [row(name, fleet, recording, egos) for name in given.methods.split(",")] + bounds(fleet, egos, v2x)
    header = ["method", "RT-LE [m]", "NEES", "inside", "received [B/s]", "sent [B/s]", "ms"]
    print(tabulate(rows, header, tablefmt="github", floatfmt=("", ".3f", ".2f", ".2f", ".0f", ".0f", ".3f")))


if __name__ == "__main__":
    main()
