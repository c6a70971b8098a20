"""Noise of a pose filter that is learned: the standard deviations under which true poses are most likely."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from coopoc import Fleet, InputError, PoseFilter, Recording, Sensors, Track, pose_nees
from coopoc.arrays import Floats, whole
from coopoc.evaluate.metrics import pose_covariance
from coopoc.world.sensors import ANGULAR

LEARNABLE = "velocity_std_ratio velocity_floor yaw_rate_std range_std azimuth_std speed_scale_std yaw_rate_bias_std"
"""Numbers of Sensors that are learned where they are positive."""
MAX_STDS = {"velocity_std_ratio": 1.0, "speed_scale_std": 1.0, **dict.fromkeys(ANGULAR, np.pi)}
"""What Sensors allow: above it a measurement means nothing, and the score is flat."""
SIMPLEX_STEP = 0.5
"""Of the first simplex, in logarithms."""


class PoseTask(NamedTuple):
    """A drive with its truth, the vehicles and the filter that follows them, and the first step that counts."""

    recording: Recording
    truth: Fleet
    egos: Sequence[str]
    method: PoseFilter
    first: int


def averaged(several: Sequence[Sensors]) -> tuple[Sensors, Floats]:
    """The first of some with the mean logarithms of what all have learned, and these logarithms (N, numbers): a
    federation of one round."""
    names = [name for name in LEARNABLE.split() if all(getattr(one, name) > 0 for one in several)]
    logs = np.log([[getattr(one, name) for name in names] for one in several])
    return replace(several[0], **dict(zip(names, np.exp(logs.mean(axis=0)).tolist(), strict=True))), logs


def log_score(track: Track, fleet: Fleet) -> Floats:
    """Log density (R, T, E) of the true (x, y, heading) under an estimate, but for a constant; NaN without truth.

    -(e^T P^-1 e + log det P) / 2 (Gneiting and Raftery, JASA 102(477), 2007, section 4.1).

    Args:
        track: of a pose filter.
        fleet: the truth.
    """
    return np.asarray(-0.5 * (pose_nees(track, fleet) + np.linalg.slogdet(pose_covariance(track))[1]))


def fit_pose_noise(tasks: Sequence[PoseTask], start: Sensors, evaluations: int = 150) -> Sensors:
    """Sensors whose noise maximises the mean log score of the poses over tasks, by Nelder and Mead's simplex.

    Args:
        tasks: to learn from.
        start: first guess, whose zeros stay.
        evaluations: of all tasks.

    Raises:
        InputError: no task.

    References:
        Greenberg, Yannay, Mannor, Optimization or architecture: how to hack Kalman filtering, NeurIPS 2023 (noise
        learned end to end in place of estimated from residuals).
    """
    if not tasks:
        raise InputError("tasks", 0, "must be one or more", "Give drives with their truth.")
    evaluations = whole("evaluations", evaluations, 1, hint="150 are some minutes.")
    names = [name for name in LEARNABLE.split() if getattr(start, name) > 0]
    first = np.log([getattr(start, name) for name in names])

    def sensors(x: Floats) -> Sensors:
        stds = dict(zip(names, np.exp(x).tolist(), strict=True))
        return replace(start, **{name: min(std, MAX_STDS.get(name, np.inf)) for name, std in stds.items()})

    def loss(x: Floats) -> float:
        assumed = sensors(x)
        scores = [
            np.nanmean(
                log_score(replace(one.method, assumed=assumed)(one.recording, one.egos), one.truth)[:, one.first :]
            )
            for one in tasks
        ]
        return -float(np.mean(scores))

    simplex = np.vstack([first, first + SIMPLEX_STEP * np.eye(len(first))])
    optimum = minimize(loss, first, method="Nelder-Mead", options={"maxfev": evaluations, "initial_simplex": simplex})
    return sensors(optimum.x)
