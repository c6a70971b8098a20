"""Pictures of recordings, tracks and solutions in the plane: axes in metres, covariance ellipses, pairs of points."""

import io
from typing import TYPE_CHECKING

import numpy as np

from ..arrays import Floats, instance, whole
from ..errors import InputError, shown
from ..methods.track import Track
from ..text import picture
from ..world.fleet import Fleet, same_drive
from ..world.recording import Recording

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..optimize.model.problem import Problem
    from ..optimize.solution import Solution

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#5B3A1E", "#4D4D4D")
"""Okabe and Ito's, then brown and grey; what is beyond them begins again."""
INK, PALE = "#2B2F36", "#C3CBD6"
NARROW = 8.0
"""Length over width of a picture, from which each axis has a scale of its own."""
SHARE_95 = 5.991464547107979
"""Quantile of chi-square with two degrees of freedom: squared radius of a 95 % ellipse in standard deviations."""


def plot_recording(recording: Recording, ax: "Axes | None" = None, *, run: int = 0, step: int | None = None) -> "Axes":
    """Fixes of one run, vehicle by vehicle, and at one step who measures whom.

    Args:
        recording: any.
        ax: of matplotlib; None makes a figure, `plot_recording(...).figure.savefig(...)` writes it.
        run: 0..R-1.
        step: 0..T-1; None: the middle.

    Raises:
        InputError: a run or a step that is not there.

    >>> from coopoc import Fleet, Sensors, observe
    >>> fleet = Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> plot_recording(observe(fleet, Sensors()), step=1).get_xlabel()
    'East [m]'
    """
    runs, last = instance("recording", recording, Recording).runs, len(recording.t) - 1
    run = whole("run", run, 0, runs - 1)
    step = whole("step", last // 2 if step is None else step, 0, last)
    ax, fixes, few = axes(ax), recording.gnss[run, :, :, :2], len(recording.ids) <= len(COLORS)
    for k, name in enumerate(recording.ids):
        color = COLORS[k % len(COLORS)]
        ax.plot(*fixes[:, k].T, ".", ms=1.6, color=color, alpha=0.6, label=picture(name) if few else None, zorder=2)
    here = recording.links.step == step
    observer, neighbour = recording.links.observer[here], recording.links.neighbour[here]
    pairs(ax, fixes[step, observer], fixes[step, neighbour], INK)
    ax.plot(*fixes[step].T, "o", ms=4.5, mfc="white", mec=INK, zorder=3, label=f"t = {recording.t[step]:g} s")
    return finish(ax)


def plot_track(
    track: Track, ax: "Axes | None" = None, *, fleet: Fleet | None = None, run: int = 0, every: int | None = None
) -> "Axes":
    """Estimated paths of one run with 95 % ellipses, named where they are few, and the truth if a fleet is given.

    Args:
        track: of any method.
        ax: as in `plot_recording`.
        fleet: that was observed, on the steps of the track.
        run: 0..R-1.
        every: steps from one ellipse to the next; None: a fortieth of the drive.

    Raises:
        InputError: a run that is not there, or a fleet of other steps.

    >>> import coopoc as co
    >>> fleet = co.Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    >>> len(plot_track(co.Kalman()(co.observe(fleet, co.Sensors())), fleet=fleet).lines)
    2
    """
    run = whole("run", run, 0, len(instance("track", track, Track).x) - 1)
    every = whole("every", max(len(track.t) // 40, 1) if every is None else every, 1)
    if fleet is not None:
        same_drive(instance("fleet", fleet, Fleet), (track.ids or fleet.ids)[: len(fleet.ids)], track.t)
    ax, few = axes(ax), len(track.egos) <= len(COLORS)
    for k, ego in enumerate(track.egos):
        color = COLORS[k % len(COLORS)]
        if fleet is not None:
            label = "truth" if k == 0 else None
            ax.plot(*fleet.position[:, ego, :2].T, color=PALE, lw=4, zorder=1, label=label)
        name = f"vehicle {ego}" if fleet is None else fleet.ids[ego]
        ax.plot(*track.x[run, :, k, :2].T, color=color, lw=1.2, zorder=2, label=picture(name) if few else None)
        if track.covariance is not None:
            ellipses(ax, track.x[run, ::every, k, :2], track.covariance[run, ::every, k, :2, :2], color)
    return finish(ax)


def plot_solution(solution: "Solution", ax: "Axes | None" = None, *, problem: "Problem | None" = None) -> "Axes":
    """Nodes in the plane, 95 % ellipses and names where they are few; with the problem its factors and headings.

    Args:
        solution: of points or poses.
        ax: as in `plot_recording`.
        problem: that was solved.

    Raises:
        InputError: another problem.

    >>> from coopoc import Problem, solve
    >>> problem = Problem(("a", "b")).add("position", ["a", "b"], [[0, 0, 0], [9, 0, 0]], std=1.0)
    >>> plot_solution(solve(problem), problem=problem).get_ylabel()
    'North [m]'
    >>> problem = problem.add("range", ("a", "b"), 9.0, std=1.0).add("displacement", ("a", "b"), [9, 0, 0], std=1.0)
    >>> [float(lines.get_linewidth()[0]) for lines in plot_solution(solve(problem), problem=problem).collections]
    [2.4, 1.2]
    """
    from ..optimize.model.problem import Problem
    from ..optimize.solution import Solution

    few = len(instance("solution", solution, Solution).names) <= 30
    ax, at = axes(ax), solution.position[:, :2]
    if problem is not None:
        if instance("problem", problem, Problem).names != solution.names:
            raise InputError("problem", repr(problem), "must be the one that was solved", "Give it to both.")
        between = [factor for factor in problem.factors if factor.nodes.shape[1] == 2]
        kinds = list(dict.fromkeys(factor.kind for factor in between))
        for k, kind in enumerate(kinds):  # the first are the widest: of one pair all show
            a, b = np.concatenate([factor.nodes for factor in between if factor.kind == kind]).T
            pairs(ax, at[a], at[b], COLORS[(k + 1) % len(COLORS)], kind.replace("_", " "), 1.2 * (len(kinds) - k))
        if few and problem.poses:
            poses = list(problem.poses)
            heading = solution.rotation[poses][:, :2, 0]
            ax.quiver(*at[poses].T, *heading.T, color=INK, angles="xy", width=0.004, zorder=4)
    if few:
        ellipses(ax, at, solution.covariance[:, :2, :2], COLORS[0], "95 %")
        for name, position in zip(solution.names, at.tolist(), strict=True):
            ax.annotate(picture(name), position, xytext=(5, 5), textcoords="offset points", fontsize=8, color=INK)
    ax.plot(*at.T, "o", ms=4 if few else 1.5, color=COLORS[0], zorder=3)
    return finish(ax)


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
    """With a legend beside it, one entry for each label, and a scale of its own for each axis where one for both would
    make a line of all."""
    short, far = sorted((ax.dataLim.width, ax.dataLim.height))
    if 0.0 < NARROW * short < far:
        ax.set_aspect("auto")
        ax.set_title("The axes have different scales.", fontsize=8, color=INK)
    handles, labels = ax.get_legend_handles_labels()
    if entries := dict(zip(labels, handles, strict=True)):
        ax.legend(entries.values(), entries, loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, frameon=False)
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

    for k in np.flatnonzero(np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(center).all(1)).tolist():
        values, axis = np.linalg.eigh(covariance[k])
        width, height = 2.0 * np.sqrt(SHARE_95 * np.maximum(values, 0.0))
        angle = float(np.degrees(np.arctan2(axis[1, 0], axis[0, 0])))
        look = {"facecolor": color, "edgecolor": color, "alpha": 0.22, "linewidth": 0.8}
        ax.add_patch(Ellipse(tuple(center[k]), width, height, angle=angle, label=label, **look))
        label = None
    ax.autoscale_view()


def pairs(ax: "Axes", first: Floats, second: Floats, color: str, label: str | None = None, width: float = 0.9) -> None:
    """Lines between points (n, 2) and points (n, 2) m."""
    from matplotlib.collections import LineCollection

    lines = np.stack([first, second], 1)
    lines = lines[np.isfinite(lines).all(axis=(1, 2))]
    dense = float(np.clip(np.sqrt(300 / max(len(lines), 1)), 0.08, 1.0))  # of thousands each is nearly transparent
    ax.add_collection(LineCollection(list(lines), colors=color, linewidths=width, alpha=dense, zorder=2.5, label=label))
    ax.autoscale_view()
