"""Consistency: the arrays of a Recording fit each other, so that compiled code reads no index outside them."""

from __future__ import annotations

import numpy as np

from ..arrays import Floats, Ints, refuse
from ..errors import InputError
from .links import Links


def check_measurements(gnss: Floats, velocity: Floats, relative: Floats) -> None:
    """InputError unless every number is finite or stands for a missing measurement.

    Args:
        gnss: (R, T, N, 3) m, NaN on all axes for a missing fix.
        velocity: (R, T, N, 3) m/s, NaN on all axes and in all runs for an absent vehicle.
        relative: (R, L, 3) m, rad, rad, NaN where a component was not measured.
    """
    if not len(gnss):
        raise InputError("gnss", "no run", "must have at least one", "Use observe(..., runs=1).")
    for name, values in (("gnss", gnss), ("velocity", velocity), ("relative", relative)):
        if _finite(values):
            continue
        refuse(name, values, np.isinf(values), "must be finite, or NaN where missing", "Replace it by NaN.")
        missing = np.isnan(values)
        if name != "relative":
            partly = missing != missing[..., :1]
            refuse(name, values, partly, "must be NaN on all axes or on none", "Set all three to NaN.")
        if name == "velocity":
            refuse(name, values, missing != missing[:1], "must be NaN in all runs or in none", "Absence is no noise.")
    refuse(
        "relative",
        relative[..., 0],
        relative[..., 0] <= 0,
        "must be a range > 0 m",
        "Make it NaN: no direction is seen in one place.",
    )


def check_landmarks(landmarks: tuple[int, ...], gnss: Floats, velocity: Floats) -> None:
    """InputError unless landmarks stand at one position throughout.

    Args:
        landmarks: columns.
        gnss: (R, T, N, 3) m.
        velocity: (R, T, N, 3) m/s.
    """
    mine = list(landmarks)
    place, moves = gnss[:, :, mine], velocity[:, :, mine]
    allowed, hint = "must be one position throughout, with a velocity of 0", "A vehicle is no landmark."
    refuse("landmarks", place, ~(place == place[:1, :1]) | (moves != 0), allowed, hint)


def check_links(
    links: Links, observers: tuple[int, ...], velocity: Floats, arrival: Ints, most: int, counted: Ints
) -> None:
    """InputError unless links join present vehicles, at most `most` per step and observer, and messages take time.

    Args:
        links: L directed links.
        observers: columns that may observe.
        velocity: (R, T, N, 3) m/s, NaN where absent.
        arrival: (R, L) step of arrival, -1 for never.
        most: largest number of neighbours.
        counted: indices of the links that count among them.
    """
    _, steps, vehicles, _ = velocity.shape
    columns = {"links.observer": links.observer, "links.neighbour": links.neighbour, "observers": np.array(observers)}
    for name, values in columns.items():
        refuse(name, values, (values < 0) | (values >= vehicles), f"must be in 0..{vehicles - 1}", "Name a column.")
    refuse("links.step", links.step, links.step >= steps, f"must be in 0..{steps - 1}", "Drop the links after the end.")
    observes = np.zeros(vehicles, dtype=bool)
    observes[list(observers)] = True
    refuse("links.observer", links.observer, ~observes[links.observer], "must be among the observers", "Add it there.")
    absent = np.isnan(velocity[0, :, :, 0])
    for name in ("observer", "neighbour"):
        column = getattr(links, name)
        gone = absent[links.step, column]
        refuse(
            f"links.{name}", column, gone, "must be present at the link's step", "Drop the links of absent vehicles."
        )
    many, first = np.zeros(len(counted), dtype=bool), max(len(counted) - most, 0)
    step, observer = links.step[counted], links.observer[counted]
    many[most:] = (step[most:] == step[:first]) & (observer[most:] == observer[:first])
    refuse("links.observer", observer, many, f"must have at most max_neighbours = {most} a step", "Raise it.")
    early = (arrival < links.step) & (arrival != -1)
    refuse("arrival", arrival, early, "must be -1 (lost) or a step no earlier than the link's", "Count steps from 0.")


def _finite(values: Floats) -> bool:
    """Whether all are finite: a sum needs no array of its own; one that overflows is looked at again."""
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.isfinite(values.sum()))
