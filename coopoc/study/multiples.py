"""Methods against a reference: how many times its error each has, one panel per case, one dot per training seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.ticker import FixedLocator, NullFormatter, StrMethodFormatter

from ..errors import InputError
from .marks import series
from .plot import Plot, canvas
from .style import NEUTRAL, look

NEAR, BOTH, FAR = (0.9, 1.0, 1.1, 1.2, 1.3, 1.5, 1.7, 2.0), (0.8, 1.0, 1.25, 1.6, 2.0), (0.5, 1.0, 2.0, 5.0, 10.0)
"""Ticks of an axis from about 1 to 2, of one that begins well below 1, and of a longer one."""


def multiples(
    found: Mapping[tuple[str, str], Mapping[str, Sequence[float]]],
    caption: str,
    target: Mapping[str, float] | None = None,
) -> Plot:
    """Plot value / reference of each method in each case as dots; a line marks 1, a band ends at the case's target.

    Args:
        found: (method, noise model) -> case -> multiples, one per training seed.
        caption: under the figure.
        target: case -> upper end of the band.

    Raises:
        InputError: nothing to draw.
    """
    cases = list(dict.fromkeys(name for each in found.values() for name in each))
    if not cases:
        raise InputError("found", "no multiples", "must hold at least one", "Run the study, or a case of it.")
    width, height = 1.9 + 1.75 * len(cases), 0.9 + 0.21 * len(found)
    with canvas(1, len(cases), width=width, height=height, sharex=True, sharey=True, squeeze=False) as (
        figure,
        axes,
    ):
        for panel, case in zip(axes[0], cases, strict=True):
            panel.axvspan(1.0, (target or {}).get(case, 1.0), color=NEUTRAL, alpha=0.35, linewidth=0)
            panel.axvline(1.0, color="black", linewidth=0.9)
            for row, ((method, noise_model), each) in enumerate(found.items()):
                values = np.array(each.get(case, ()), dtype=float)
                shown = look(method)
                panel.plot(
                    values,
                    np.full(len(values), row),
                    linestyle="none",
                    marker=shown.marker,
                    color=shown.color,
                    markersize=4,
                    alpha=0.8,
                    markeredgewidth=0.6,
                    gid=series(method, noise_model),
                )
            panel.set(title=case, xscale="log", xlabel="× reference")
            low, high = panel.get_xlim()
            panel.xaxis.set_major_locator(FixedLocator(FAR if high > 2.1 else BOTH if low < 0.85 else NEAR))
            panel.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            panel.xaxis.set_minor_formatter(NullFormatter())
        labels = [f"{look(method).label}{_of(noise_model)}" for method, noise_model in found]
        axes[0, 0].set(yticks=range(len(found)), yticklabels=labels, ylim=(len(found) - 0.4, -0.6))
    return Plot(figure, caption)


def _of(noise_model: str) -> str:
    return "" if noise_model in ("trained", "none") else f", {noise_model}"
