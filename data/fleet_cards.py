"""Cards of generated fleets: where they come from, their size and statistics, as JSON and in words."""

from __future__ import annotations

from typing import Any

import numpy as np

from coopoc.world.fleet import Fleet

RADIUS, CAP = 30.0, 10
"""m and number of the neighbours that a card counts."""


def in_words(facts: dict[str, Any]) -> dict[str, str]:
    """Size and statistics of a fleet as texts, and of a card also where it comes from."""
    made = (
        {
            "map": "{map}, {map_licence}".format(**facts),
            "made by": "{command} (SUMO {sumo})".format(**facts),
        }
        if "map" in facts
        else {}
    )
    near = "mean {mean:g} within {radius:g} m (cap {cap:g}), some in {any:.0%} of the steps"
    return made | {
        "sha256": facts["sha256"],
        "size": "{vehicles} vehicles x {steps} steps of {dt:g} s".format(**facts),
        "speed": "{min:g}..{max:g} m/s, mean {mean:g}, standing {standing:.0%}".format(**facts["speed"]),
        "neighbours": near.format(**facts["neighbours"]),
        "height": "{:g}..{:g} m".format(*facts["height"]),
        "acceleration": "at most {acceleration:g} m/s^2".format(**facts),
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
    lengths = sorted(set(fleet.present.sum(axis=0).tolist()))
    return {
        "sha256": fleet.digest,
        "vehicles": len(fleet.ids),
        "steps": lengths[0] if len(lengths) == 1 else f"{lengths[0]}..{lengths[-1]}",
        "dt": fleet.dt,
        "speed": _rounded(min=speed.min(), mean=speed.mean(), max=speed.max(), standing=np.mean(speed < 0.1)),
        "neighbours": _rounded(radius=RADIUS, cap=CAP, mean=counts.mean(), any=np.mean(counts > 0)),
        "height": [round(float(z.min()), 3), round(float(z.max()), 3)],
        "acceleration": round(float(np.nanmax(change, initial=0.0)) / fleet.dt, 3),
    }


def _rounded(**values: Any) -> dict[str, float]:
    return {name: round(float(value), 3) + 0.0 for name, value in values.items()}
