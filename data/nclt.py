"""Drives of the NCLT Segway as KalmanNet4SensorFusion publishes them (tensors of torch) as rows of a log."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from coopoc.errors import InputError, MissingLibraryError, said

from .log.units import Rows, Summary, of_kinds

FILE_NAMES = ("train.pt", "val.pt", "test.pt")
"""Of its files."""
FIELDS = {"filtered_gps": 2, "filtered_wheel": 2, "imu_sensor": 3, "theta_gt": 1, "ground_truth": 2}
"""Field of a drive, a row for each second -> columns that are read."""


def read_nclt(path: Path, summary: Summary, **_: Any) -> Rows:
    """Rows of two vehicles for each drive: fixes (x, y), speed as the mean of both wheels, the truth, and the heading:
    that of the inertial unit, or the true one, DATE and DATE-true-heading. Every drive begins at 0 s.

    Args:
        path: of the file.
        summary: takes what is assumed.

    Raises:
        InputError: another file, a field that is missing or of another shape.
        MissingLibraryError: torch is not installed.

    References:
        Song et al., KalmanNet for sensor fusion, IEEE Signal Processing Letters, 2024 (their files); Carlevaris-Bianco,
        Ushani, Eustice, University of Michigan North Campus long-term vision and lidar dataset, IJRR 35(9), 2016.
    """
    try:
        import torch
    except ImportError:
        raise MissingLibraryError("torch", "reading tensors", "'coopoc[learned]'") from None
    parts = []
    try:
        for drive in torch.load(path, map_location="cpu", weights_only=True):
            arrays = {name: np.asarray(drive[name], float)[:, :n] for name, n in FIELDS.items()}
            date, (x, y), (true_x, true_y) = drive["data_date"], arrays["filtered_gps"].T, arrays["ground_truth"].T
            speed = arrays["filtered_wheel"].mean(1)
            table = pd.DataFrame({"t": np.arange(len(x)), "x": x, "y": y, "speed": speed})
            truth = table[["t"]].assign(x=true_x, y=true_y, true=1.0)
            headings = {date: arrays["imu_sensor"][:, 2], f"{date}-true-heading": arrays["theta_gt"][:, 0]}
            for name, heading in headings.items():
                parts += [table.assign(heading=heading, vehicle=name), truth.assign(vehicle=name)]
        frame = pd.concat(parts, ignore_index=True)
    except Exception as error:  # of torch, NumPy and pandas: another file meets them all
        raise InputError(
            path.name,
            said(error),
            f"must be a list of drives with {', '.join(FIELDS)} and data_date",
            "Take the file as it was published.",
        ) from None
    summary.assume("speed: the mean of both wheels; each drive twice, with its own and with its true heading")
    return of_kinds(frame.sort_values("t", kind="stable"), path.name)
