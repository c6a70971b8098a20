"""Track: a method's estimates of its egos, and their bytes. Method: the protocol that all methods follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np

from ..arrays import Floats, checked, instance, number
from ..errors import InputError, shown
from ..short_repr import short_repr
from ..world.axes import texts
from ..world.fleet import Fleet
from ..world.recording import Recording
from ..world.v2x import Message

if TYPE_CHECKING:
    from matplotlib.axes import Axes

UNSOUND = (
    "covariances are not positive semidefinite: the assumed standard deviations lie too far apart for double "
    "precision; raise the smallest"
)
"""What a note says of covariances that are no covariances."""


@dataclass(frozen=True, eq=False)
class Track:
    """Estimates of E egos over T steps in R runs.

    Args:
        t: (T,) s.
        egos: (E,) columns of the Recording.
        x: (R, T, E, 3) m.
        covariance: (R, T, E, 3, 3) m^2, or None if the method claims none.
        received_bytes: (R, E) bytes over the drive, payload and overhead.
        sent_bytes: (R, E) bytes over the drive, payload and overhead.
        seconds: wall time of the method.
        neighbours: (R, L, 3) m estimate of each link's neighbour at the link's step, NaN where there is none; or None.
            The links are those of the egos, `recording.links.of(ego)` ego by ego, and no others of the fleet.
        notes: labels for tables and figures, such as "reconstruction".
        heading: (R, T, E) rad in [-pi, pi), or None of a method that does not estimate it.
        heading_covariance: (R, T, E, 4) of the heading with x, y, z and itself, m rad and rad^2; None as above.
        extras: other numbers by name, (R, T, E), or (R, L) by link; states with their standard deviations under the
            name and "_std".
    """

    t: Floats
    egos: tuple[int, ...]
    x: Floats
    covariance: Floats | None
    received_bytes: Floats
    sent_bytes: Floats
    seconds: float
    neighbours: Floats | None = None
    notes: tuple[str, ...] = ()
    heading: Floats | None = None
    heading_covariance: Floats | None = None
    extras: Mapping[str, Floats] = field(default_factory=dict)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        egos = checked("egos", self.egos, "(E,)", (-1,), int)
        object.__setattr__(self, "egos", tuple(egos.tolist()))
        t, x = checked("t", self.t, "(T,)", (-1,)), checked("x", self.x, "(R, T, E, 3)", (-1, -1, -1, 3))
        runs, steps = x.shape[:2]
        shapes: dict[str, tuple[str, tuple[int, ...]]] = {
            "t": ("(T,)", (steps,)),
            "x": ("(R, T, E, 3)", (runs, len(t), len(egos), 3)),
            "covariance": ("(R, T, E, 3, 3)", (*x.shape, 3)),
            "received_bytes": ("(R, E)", (runs, len(egos))),
            "sent_bytes": ("(R, E)", (runs, len(egos))),
            "neighbours": ("(R, L, 3)", (runs, -1, 3)),
            "heading": ("(R, T, E)", x.shape[:3]),
            "heading_covariance": ("(R, T, E, 4)", (*x.shape[:3], 4)),
        }
        optional = ("covariance", "neighbours", "heading", "heading_covariance")
        for name, (axes, shape) in shapes.items():
            if name not in optional or getattr(self, name) is not None:
                object.__setattr__(self, name, checked(name, getattr(self, name), axes, shape))
        object.__setattr__(self, "seconds", number("seconds", self.seconds))
        object.__setattr__(self, "notes", texts("notes", self.notes))
        if not isinstance(self.extras, Mapping):
            raise InputError("extras", shown(self.extras), "must be name -> (R, T, E)", "Give {} for none.")
        by_link = None if self.neighbours is None else self.neighbours.shape[:2]
        extras = {
            name: checked(f"extras[{name}]", v, "(R, L)" if np.ndim(v) == 2 else "(R, T, E)", by_link)
            if np.ndim(v) == 2 and by_link
            else checked(f"extras[{name}]", v, "(R, T, E)", x.shape[:3])
            for name, v in self.extras.items()
        }
        object.__setattr__(self, "extras", extras)
        if not np.isfinite(self.x).all():
            run, step, ego = np.argwhere(~np.isfinite(self.x).all(axis=-1))[0]
            raise InputError(
                "x",
                f"not finite in run {run} at step {step} of ego {self.egos[ego]}",
                "an estimate must be finite",
                "The method diverged: lower its gain, or check the assumed standard deviations.",
            )
        if self.covariance is not None:
            self._note_unsound(self.covariance.reshape(-1, 3, 3))

    def _note_unsound(self, covariance: Floats) -> None:
        from ..kernels.scores import unsound

        if (found := unsound(covariance)) and not any(UNSOUND in note for note in self.notes):
            note = f"{found} of {len(covariance)} {UNSOUND}"
            object.__setattr__(self, "notes", (*self.notes, note))

    def plot(
        self, ax: Axes | None = None, *, fleet: Fleet | None = None, run: int = 0, every: int | None = None
    ) -> Axes:
        """Estimated paths of one run with 95 % ellipses, and the truth if a fleet is given.

        Args:
            ax: of matplotlib; None makes a figure, `plot().figure.savefig(...)` writes it.
            fleet: that was observed, on the steps of the track.
            run: 0..R-1.
            every: steps from one ellipse to the next; None: a fortieth of the drive.

        Raises:
            InputError: a run that is not there, or a fleet of other steps.

        >>> import coopoc as co
        >>> fleet = co.Fleet(("a",), [0, 0.1], np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
        >>> len(co.Kalman()(co.observe(fleet, co.Sensors())).plot(fleet=fleet).lines)
        2
        """
        from ..escapes import picture
        from ..world.pictures import COLORS, PALE, axes, ellipses, finish

        run = number("run", run, 0, len(self.x) - 1, kind=int, allowed=f"in 0..{len(self.x) - 1}")
        fair = max(len(self.t) // 40, 1)
        every = number("every", fair if every is None else every, 1, kind=int, allowed=">= 1 step")
        if fleet is not None and instance("fleet", fleet, Fleet).position.shape[0] != len(self.t):
            raise InputError(
                "fleet", repr(fleet), f"must have {len(self.t)} steps", "Give the fleet that was observed."
            )
        ax = axes(ax)
        for k, ego in enumerate(self.egos):
            color = COLORS[k % len(COLORS)]
            if fleet is not None:
                label = "truth" if k == 0 else None
                ax.plot(*fleet.position[:, ego, :2].T, color=PALE, lw=4, zorder=1, label=label)
            name = f"vehicle {ego}" if fleet is None else fleet.ids[ego]
            ax.plot(*self.x[run, :, k, :2].T, color=color, lw=1.2, zorder=2, label=picture(name))
            if self.covariance is not None:
                ellipses(ax, self.x[run, ::every, k, :2], self.covariance[run, ::every, k, :2, :2], color)
        return finish(ax)


@runtime_checkable
class Method(Protocol):
    """A frozen dataclass that is callable: recording, egos -> Track."""

    @property
    def name(self) -> str:
        """Name in tables, figures and the command line."""

    @property
    def cooperative(self) -> bool:
        """True if it uses other vehicles while it decides."""

    @property
    def message(self) -> Message:
        """The message that each vehicle broadcasts."""

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Estimates of the egos."""
