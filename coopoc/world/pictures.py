"""What pictures of positions share: axes in metres, covariance ellipses, pairs of points."""

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arrays import Floats
from ..errors import InputError, shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#5B3A1E", "#4D4D4D")
"""Okabe and Ito's, then brown and grey; what is beyond them begins again."""
INK, PALE = "#2B2F36", "#C3CBD6"
SHARE_95 = 5.991464547107979
"""Quantile of chi-square with two degrees of freedom: squared radius of a 95 % ellipse in standard deviations."""


def axes(ax: "Axes | None") -> "Axes":
    """The axes themselves, or new ones, with east and north in metres on one scale.

    Raises:
        InputError: no axes of matplotlib.
    """
    from matplotlib.axes import Axes as Known
    from matplotlib.figure import Figure

    class Picture(Figure):
        """A figure that notebooks show without pyplot."""

        def _repr_png_(self) -> bytes:
            out = io.BytesIO()
            self.savefig(out, format="png")
            return out.getvalue()

    if ax is None:
        ax = Picture(figsize=(6.4, 5.2), dpi=150, layout="constrained").add_subplot()
    if not isinstance(ax, Known):
        raise InputError("ax", shown(ax), "must be axes of matplotlib", "Take them from plt.subplots().")
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="East [m]", ylabel="North [m]")
    ax.grid(True, color="#EDF0F4")
    ax.set_axisbelow(True)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    return ax


def finish(ax: "Axes") -> "Axes":
    """With a legend of what has a label."""
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="best", fontsize=8, frameon=False)
    return ax


def ellipses(ax: "Axes", center: Floats, covariance: Floats, color: str, label: str | None = None) -> None:
    """95 % ellipses of positions in the plane; none where the covariance is not finite.

    Args:
        ax: to draw into.
        center: (n, 2) m.
        covariance: (n, 2, 2) m^2.
        color: of line and face.
        label: of the first one in the legend.
    """
    from matplotlib.patches import Ellipse

    fine = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(center).all(axis=1)
    for k in np.flatnonzero(fine).tolist():
        values, axis = np.linalg.eigh(covariance[k])
        width, height = 2.0 * np.sqrt(SHARE_95 * np.maximum(values, 0.0))
        angle = float(np.degrees(np.arctan2(axis[1, 0], axis[0, 0])))
        look: dict[str, Any] = {"facecolor": color, "edgecolor": color, "alpha": 0.22, "linewidth": 0.8}
        ax.add_patch(Ellipse(tuple(center[k]), width, height, angle=angle, label=label, **look))
        label = None
    ax.autoscale_view()


def pairs(
    ax: "Axes", first: Floats, second: Floats, color: str = PALE, label: str | None = None, width: float = 0.9
) -> None:
    """Lines between points (n, 2) and points (n, 2) m."""
    from matplotlib.collections import LineCollection

    lines = np.stack([first, second], axis=1)
    lines = lines[np.isfinite(lines).all(axis=(1, 2))]
    dense = float(np.clip(np.sqrt(300 / max(len(lines), 1)), 0.08, 1.0))  # of thousands each is nearly transparent
    ax.add_collection(LineCollection(list(lines), colors=color, linewidths=width, alpha=dense, zorder=2.5, label=label))
    ax.autoscale_view()
