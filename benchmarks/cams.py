"""What the encoding of CAMs costs a filter: bytes on air, and metres lost to their quantisation.

python benchmarks/cams.py            # a minute on one core; the tables of docs/cam.md
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

import coopoc as co
from coopoc.studies.heading_error import convoy
from coopoc.world import cam

RUNS = 10
NOISES = {"1.5 m, 4°": co.Sensors(), "1 cm, 0.1°": co.Sensors((0.01,) * 3, range_std=0.05, azimuth_std=0.002)}


def sizes() -> None:
    """Bytes of a message and around it."""
    state = cam.to_elements(np.zeros(3), np.array(0.0), np.array(10.0), np.array(0.0), (47.0, 8.0, 400.0))
    for path in (0, 10, 23):
        print(f"CAM, path history of {path} points: {len(cam.encode(state, (1.5, 1.5, 1.5), path=path))} B")
    print(f"headers {cam.HEADERS} B, security {cam.DIGEST} B with a digest, {cam.CERTIFICATE} B with the certificate")
    for rate in (1.0, 2.2, 10.0):
        print(f"mean on air at {rate:g} Hz: {cam.mean_size(rate):.0f} B, {rate * cam.mean_size(rate):.0f} B/s")


def without_stated(recording: co.Recording, ego: int) -> co.Recording:
    """The values of CAMs under the recording's own standard deviations."""
    return replace(co.cam_received(recording, ego), sensors=recording.sensors)


def losses() -> None:
    """RT-LE with numbers as they are and as CAMs carry them."""
    ways: dict[str, Callable[[co.Recording, int], co.Recording]] = {
        "exact": lambda recording, _: recording,
        "values of CAMs": without_stated,
        "and their confidences": co.cam_received,
    }
    town, winding = co.load_fleet("town10"), convoy(10.0, 60.0)
    for words, noise in NOISES.items():
        for channel, v2x in (("every step", co.V2X(6)), ("CAM, 2.2 Hz", co.V2X.cam(6))):
            for method, fleet, egos in (
                (co.JointFilter(), town, (0, 12, 24, 36, 48)),
                (co.PoseFilter(), winding, (4, 5)),
            ):
                posed = fleet is winding
                acting = replace(noise, heading_std=0.02) if posed else noise
                seen = co.observe(fleet, acting, v2x, runs=RUNS, observers=egos, frame="body" if posed else "world")
                found = {
                    way: np.mean([co.rt_le(method(change(seen, ego), [ego]), fleet).mean() for ego in egos])
                    for way, change in ways.items()
                }
                numbers = ", ".join(f"{way} {value:.4f} m" for way, value in found.items())
                print(f"{words}, {channel}, {method.name}: {numbers}")


if __name__ == "__main__":
    sizes()
    losses()
