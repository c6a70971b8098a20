"""Notes on what contradicts a track's estimates: fixes, odometry, messages and measurements of neighbours."""

from collections.abc import Sequence

import numpy as np

from ..arrays import Floats, Ints
from ..kernels.covariances import DOUBT, JUDGED_IN_A_ROW, mark_estimates, mark_neighbours
from ..world.recording import Recording
from .noise_model import NoiseModel
from .odometry_fault import NOTE, failed, faults, when

JUDGED_SECONDS = 1.0
"""Least s between two fixes that are judged together; between two numbers of a neighbour twice as much."""
DOUBTS = (
    "fixes, {}: far from its estimates; it is lost, or rejects them",
    "covariances, {}: contradicted by fixes",
    f"{NOTE} contradicted by fixes; it fails, or they drift",
)
NEIGHBOUR_DOUBTS = "messages, {} and {}: far from estimates", "relative measurements, {} and {}: far from estimates"


def doubts(
    recording: Recording,
    columns: Sequence[int],
    x: Floats,
    cov: Floats | None = None,
    noise_model: NoiseModel | str = "nominal",
    neighbours: Floats | None = None,
    earlier: Sequence[str] = (),
) -> tuple[str, ...]:
    """Notes on what contradicts the estimates of vehicles in any run, and when.

    A note needs JUDGED_IN_A_ROW successive measurements:

    - fixes all beyond their gate: the filter rejects its receiver, or is lost;
    - fixes whose mean, or mean square, is farther off than chance allows: the covariance is wrong;
    - fixes that show that the odometry fails, which the method has not noted yet;
    - messages, or relative measurements, of a neighbour that are all beyond HARD_REJECT_FACTOR gates.

    Args:
        recording: of all vehicles, with the noise that methods know.
        columns: (E,) of the vehicles.
        x: (R, T, E, 3) m.
        cov: (R, T, E, 3, 3) m^2; None if none is claimed.
        noise_model: of the method; covariances and neighbours are not judged where it states no noise.
        neighbours: (R, L, 3) m as of Track; None for none.
        earlier: notes that the track has already.

    >>> from coopoc import Fleet, Sensors, observe
    >>> fleet = Fleet(("a",), np.arange(9), np.zeros((9, 1, 3)), np.zeros((9, 1, 3)))
    >>> doubts(observe(fleet, Sensors()), [0], np.full((1, 9, 1, 3), 1e3))
    ('fixes, a: far from its estimates; it is lost, or rejects them (0 to 4 s)',)
    """
    stated = noise_model.sensors if isinstance(noise_model, NoiseModel) else noise_model != "identity"
    sensors, links, steps, notes = recording.sensors, recording.links, len(recording.t), [*recording.unlikely]
    egos, claimed = np.asarray(columns, int), cov if cov is not None and stated else np.zeros((0,) * 5)
    fix = np.square([sensors.gnss_std, (sensors.gnss_drift_std, sensors.gnss_common_std, sensors.gnss_bias[1])])
    fix[1] = fix[1].sum()
    every = max(min(round(JUDGED_SECONDS / recording.dt), steps // JUDGED_IN_A_ROW), 1)
    marks = np.zeros((3, len(egos), steps), int)
    fixes = np.stack(np.broadcast_arrays(recording.fix_scale**2 * fix[0], fix[1]), 2)
    doubtful = mark_estimates(recording.gnss, x, claimed, egos, fixes, every, marks)
    doubtful += DOUBT * (neighbours is not None)
    noted = [any(note.startswith(NOTE.format(recording.ids[ego])) for note in earlier) for ego in columns]
    looked_at = egos[(doubtful > DOUBT / 3.0).any(0) & ~np.array(noted)]
    if recording.body is None and len(looked_at):
        corrections = faults(recording, looked_at, NoiseModel.nominal(sensors))
        marks[2] = 0 if corrections is None else failed(corrections, recording.dt)[:, egos].T

    def add(text: str, marked: Ints, *names: int) -> None:
        if marked.any():
            notes.append(f"{text.format(*(recording.ids[name] for name in names))} {when(recording.t, marked > 0)}")

    first = 0
    for k, ego in enumerate(columns):
        for text, marked in zip(DOUBTS, marks[:, k], strict=True):
            add(text, marked, ego)
        if neighbours is not None and len(claimed):
            own, far = links.of(ego), np.zeros((2, len(recording.ids), steps), int)
            theirs, first = neighbours[:, first : first + len(own)], first + len(own)
            rows = np.stack([own, links.step[own], links.neighbour[own]], 1)
            std = np.array([sensors.range_std, sensors.world_azimuth_std, sensors.inclination_std])
            star = recording.gnss, recording.relative, x[:, :, k], claimed[:, :, k], theirs, rows
            mark_neighbours(*star, fixes, std, 2 * every, far)
            for kind, j in np.argwhere(far.any(2)).tolist():
                add(NEIGHBOUR_DOUBTS[kind], far[kind, j], ego, j)
    return tuple(notes)
