"""The drives of the clients in a figure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from coopoc.study.plot import Plot, canvas
from coopoc.study.style import CLIENTS

from . import weights

if TYPE_CHECKING:
    from coopoc import Results


def clients(results: Results) -> Plot:
    """The path of each client on one scale, with its number of steps and its range of speeds (paper, Fig. 2)."""
    drives: Any = weights.drives(str(results.settings["clients"]))
    truth, shown = getattr(drives, "truth", drives), list(zip(range(1, 7), drives.ids, CLIENTS, strict=False))
    same = {"squeeze": False, "sharex": True, "sharey": True}
    with canvas(1, len(shown), width=2.0 * len(shown) + 0.4, height=2.6, **same) as (figure, (panels,)):
        for panel, (number, name, color) in zip(panels, shown, strict=True):
            column = truth.index(name)
            there = truth.present[:, column]
            x, speed = truth.position[there, column], np.linalg.norm(truth.velocity[there, column], axis=1)
            panel.plot(*x[:, :2].T, color=color)
            panel.plot(*x[0, :2], "ko", ms=3)
            panel.set_title(f"Client {number}: {len(x)} steps\n{speed.min():.1f} to {speed.max():.1f} m/s")
            panel.set(xlabel="East [m]", aspect="equal")
        panels[0].set_ylabel("North [m]")
    return Plot(figure, f"Paths of the clients of {truth.name} from the dot on, steps of {truth.dt:g} s; their speeds.")
