"""What the encoding of CAMs and CPMs costs a filter: bytes on air, and metres lost to their quantisation.

python benchmarks/encoded_messages.py            # two minutes on one core; the tables of docs/encoded_messages.md
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

import coopoc as co
from coopoc.studies.heading_error import convoy
from coopoc.world import cam, cpm
from coopoc.world.encoded_channels import CERTIFICATE, DIGEST, HEADERS, ORIGIN, STD, cam_size, cpm_size

RUNS = 10
NOISES = {"1.5 m, 4°": co.Sensors(), "1 cm, 0.1°": co.Sensors((0.01,) * 3, range_std=0.05, azimuth_std=0.002)}
Received = Callable[[co.Recording, int], co.Recording]


def sizes() -> None:
    """Bytes of a message and around it."""
    state = cam.to_elements(np.zeros(3), np.array(0.0), np.array(10.0), np.array(0.0), ORIGIN)
    for path in (0, 10, 23):
        print(f"CAM, path history of {path} points: {len(cam.encode(state, STD, path=path))} B")
    print(f"headers {HEADERS} B, security {DIGEST} B with a digest, {CERTIFICATE} B with the certificate")
    for rate in (1.0, 2.2, 10.0):
        print(f"CAM, mean on air at {rate:g} Hz: {cam_size(rate):.0f} B, {rate * cam_size(rate):.0f} B/s")
    for count in range(11):
        vectors, std = np.ones((count, 3)), np.full((count, 3), 0.5)
        elements = cpm.to_elements(np.zeros(3), np.array(0.0), np.arange(count), vectors, std, ORIGIN)
        bare, full = (len(cpm.encode(elements, STD, described=described)) for described in (False, True))
        air = ", ".join(f"{cpm_size(5.0, count, described):.0f} B" for described in (False, True))
        print(f"CPM of {count} objects: {bare} B, described {full} B; mean on air at 5 Hz: {air}")


def losses(
    name: str, received: Received, v2x: co.V2X, cases: list[tuple[co.Method, co.Fleet, tuple[int, ...]]]
) -> None:
    """RT-LE with numbers as they are, as messages carry them, and with the confidences that the messages state.

    Args:
        name: of the messages.
        received: changes a recording for an ego.
        v2x: their channel, beside one at every step.
        cases: method, fleet and egos.
    """
    ways: dict[str, Received] = {
        "exact": lambda recording, _: recording,
        "as received": lambda recording, ego: replace(received(recording, ego), sensors=recording.sensors),
        "and their confidences": received,
    }
    for words, noise in NOISES.items():
        for channel in (co.V2X(6), v2x):
            for method, fleet, egos in cases:
                posed = isinstance(method, co.PoseFilter)
                acting = replace(noise, heading_std=0.02) if posed else noise
                observers = None if name == "CPM" else egos
                frame = "body" if posed else "world"
                seen = co.observe(fleet, acting, channel, runs=RUNS, observers=observers, frame=frame)
                found = {
                    way: np.mean([co.rt_le(method(change(seen, ego), [ego]), fleet).mean() for ego in egos])
                    for way, change in ways.items()
                }
                numbers = ", ".join(f"{way} {value:.4f} m" for way, value in found.items())
                print(f"{name}, {words}, {channel.rate or 'every step'}, {method.name}: {numbers}", flush=True)


if __name__ == "__main__":
    sizes()
    winding = convoy(10.0, 60.0)
    one_star = [(co.JointFilter(), co.load_fleet("town10"), (0, 12, 24, 36, 48)), (co.PoseFilter(), winding, (4, 5))]
    losses("CAM", co.cam_received, co.V2X.cam(6), one_star)
    whole_fleet = [(co.CentralFilter(), winding, (4, 5)), (co.PoseFilter(unit="fleet"), winding, (4, 5))]
    losses("CPM", co.cpm_received, co.V2X.cpm(6), whole_fleet)
