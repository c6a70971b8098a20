"""Cards of generated fleets in words; `examples/make_fleet.py` writes them."""

from __future__ import annotations

from typing import Any


def in_words(facts: dict[str, Any]) -> dict[str, str]:
    """Where a generated fleet comes from, its size and statistics, as texts."""
    near = "mean {mean:g} within {radius:g} m (cap {cap:g}), some in {any:.0%} of the steps"
    return {
        "map": "{map}, {map_licence}".format(**facts),
        "made by": "{command} (SUMO {sumo})".format(**facts),
        "sha256": facts["sha256"],
        "size": "{vehicles} vehicles x {steps} steps of {dt:g} s".format(**facts),
        "speed": "{min:g}..{max:g} m/s, mean {mean:g}, standing {standing:.0%}".format(**facts["speed"]),
        **{f"speed of {k}": "{:g}..{:g} m/s".format(*ends) for k, ends in enumerate(facts.get("speeds", ()), start=1)},
        "neighbours": near.format(**facts["neighbours"]),
        "height": "{:g}..{:g} m".format(*facts["height"]),
        "acceleration": "at most {acceleration:g} m/s^2".format(**facts),
    }
