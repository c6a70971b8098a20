"""The pose smoother: poses of the whole fleet over the last seconds, by GTSAM's incremental smoother (iSAM2)."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ...arrays import Floats, number
from ...optimize.backend import require_backend
from ...optimize.incremental import Estimates, FixedLag
from ...optimize.model.space import log
from ...short_repr import short_repr
from ...world.recording import Recording, check_recording
from ...world.sensors import Sensors
from ...world.v2x import Message
from ..track import Track, check_options
from ..whole_fleet import CENTRE, centre
from .pose_factors import PLANE, PoseRun, node, pose_subgraph
from .pose_inputs import SPREAD, UPLOAD, check_spread, first_poses, fleet_members, pose_egos


@dataclass(frozen=True, eq=False)
class PoseSmoother:
    """Most probable poses (x, y, heading) of all vehicles in the last `lag` seconds, given all that was ever measured.

    Each step of a recording in body frames is a part of a problem (`pose_subgraph`) for FixedLag, which adds it to
    GTSAM's Bayes tree; the newest poses are the estimate. All is in the plane: heights stay those of the start. It
    loops over the runs.

    Args:
        lag: s; infinity forgets nothing.
        threshold: m or rad, a move that asks for a fresh linearisation.
        passes: Gauss-Newton steps per step of the drive.
        begin: (N, 4) or (R, N, 4) m and rad, poses at the first step; None or NaN: the first fix and compass.
        spread: (4,) standard deviations of these.
        assumed: noise, default that of the recording.

    Raises:
        InputError: a lag < 0, a threshold <= 0, passes < 1. MissingLibraryError: no gtsam.

    References:
        Kaess et al., iSAM2, IJRR 2012.

    >>> from coopoc import Fleet, Sensors, observe
    >>> fleet = Fleet(("a",), [0, 1], [[[0, 0, 0]], [[9, 0, 0]]], np.full((2, 1, 3), [9.0, 0, 0]))
    >>> track = PoseSmoother(lag=2.0)(observe(fleet, Sensors(), runs=3, frame="body"))
    >>> track.x.shape, track.heading.shape
    ((3, 2, 1, 3), (3, 2, 1))
    """

    lag: float = 5.0
    threshold: float = 0.01
    passes: int = 1
    begin: Floats | None = None
    spread: tuple[float, ...] = SPREAD
    assumed: Sensors | None = None
    name: str = "pose-smoother"
    cooperative: bool = True
    message: Message = UPLOAD

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_options(self)
        number("lag", self.lag, 0.0, np.inf, allowed=">= 0 s", hint="5 is the default.")
        check_spread(self.spread)
        require_backend("gtsam")
        FixedLag(self.lag, self.threshold, self.passes)  # refuses the others

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos.

        Raises:
            InputError: a recording in the world frame, an ego that is unknown, absent at times or a landmark, or a
                vehicle whose first pose is not known.
        """
        began, recording = time.perf_counter(), check_recording(recording, body=True)
        columns = pose_egos(recording, egos)
        first = first_poses(recording, self.begin, fleet_members(recording))
        shape = (recording.runs, len(recording.t), len(columns))
        x, cov, heading, of_heading = (np.zeros((*shape, *more)) for more in ((3,), (3, 3), (), (4,)))
        height = np.where(np.isnan(first[..., 2]), recording.gnss[:, 0, :, 2], first[..., 2])
        x[..., 2], cov[..., 2, 2] = height[:, None, columns], self.spread[2] ** 2
        for run in range(recording.runs):
            for t, found in enumerate(self.estimates(recording, run, first)):
                place = [found.names.index(node(recording, column, t)) for column in columns]
                at, full = found.x[place], found.covariance[place]
                x[run, t, :, :2], cov[run, t, :, :2, :2] = at[:, :2], full[:, :2, :2]
                heading[run, t] = log(PLANE.rotation(at))[:, 0]
                of_heading[run, t][:, [0, 1, 3]] = full[:, 2]
        met = centre(recording, self.message)
        notes = (CENTRE, "in the plane: heights are those of the start", "gtsam loops over the runs")
        return Track(
            recording.t,
            tuple(columns),
            x,
            cov,
            met.received_bytes[:, columns],
            met.sent_bytes[:, columns],
            time.perf_counter() - began,
            notes=notes,
            heading=heading,
            heading_covariance=of_heading,
        )

    def estimates(self, recording: Recording, run: int = 0, begin: Floats | None = None) -> Iterator[Estimates]:
        """Step by step the poses of all vehicles that are there, as nodes "id@step".

        Args:
            recording: in body frames.
            run: of it.
            begin: (R, N, 4) first poses; None: those of the smoother.
        """
        if begin is None:
            begin = first_poses(recording, self.begin, fleet_members(recording))
        drive = PoseRun(
            recording, run, self.assumed or recording.sensors, begin[run], np.array(self.spread, dtype=float)
        )
        smoother, landmarks = FixedLag(self.lag, self.threshold, self.passes), dict[str, Floats]()
        known = dict[str, Floats]()
        for step, t in enumerate(recording.t.tolist()):
            piece = pose_subgraph(drive, step, known | landmarks)
            poses = [node(recording, column, step) for column in np.flatnonzero(drive.present[step]).tolist()]
            assert piece.x0 is not None
            landmarks |= dict(zip(piece.names[len(piece.poses) :], piece.x0[len(piece.poses) :], strict=True))
            found = smoother.update(piece, dict.fromkeys([*poses, *landmarks], t), poses)
            known = dict(zip(found.names, found.x, strict=True))
            yield found
