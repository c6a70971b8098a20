"""What the check of a log could not see, and of whom."""

from collections.abc import Mapping

import numpy as np

from .estimates import LEAST_COUNT, LEAST_DRIFT, LEAST_LAG, LEAST_SCALE, LEAST_TURN, SURE_ERRORS
from .residuals import Check

PERHAPS = 2.0
"""Standard errors from which an error may be one."""


def unseen(c: Check) -> list[str]:
    """What the check could not see, and of whom."""
    sentences, every = [], [row["vehicle"] for row in c.vehicles]
    if c.log.truth is None:
        sentences.append("errors that all sensors share, and a clock that is wrong for all alike: there is no truth")
    if not every:
        sentences.append("errors of fixes, none of which changes while nothing moves")
    turns = ("turned", LEAST_TURN, "rad, of the direction of the odometry")
    if c.log.recording.body is not None:
        turns = ("yaw_rate_bias", LEAST_DRIFT, "rad/s, of the yaw rates")
    for name, least, what in (("speed_excess", LEAST_SCALE, "as a share, of the speeds"), turns):
        errors = {row["vehicle"]: SURE_ERRORS * row.get(f"{name}_error", np.inf) for row in c.vehicles}
        if blind := _below(errors, 2 * least):
            sentences.append(f"errors, {what} of {blind}")
        for row in c.vehicles:
            value, error = row.get(name, 0.0), row.get(f"{name}_error", np.inf)
            if max(least, PERHAPS * error) < abs(value) <= SURE_ERRORS * error:
                sentences.append(
                    f"whether an error of {value:.2g} +- {error:.2g} ({what} of {row['vehicle']}) is more than chance"
                )
    late = {row["vehicle"]: row.get("late_s_error", np.inf) for row in c.vehicles}
    if blind := _below(
        {who: SURE_ERRORS * min(late[who], c.unsure[c.world.ids.index(who)]) for who in every}, 2 * LEAST_LAG
    ):
        sentences.append(f"errors, s, of the clocks of {blind}")
    fixes = np.isfinite(c.fix[..., 0]).sum(axis=0)
    if few := [who for who in every if fixes[c.world.ids.index(who)] < LEAST_COUNT]:
        sentences.append(f"late fixes of {', '.join(few)}, and whether their deviations are right: too few fixes")
    sensors = c.world.sensors
    stated = {"fixes": sensors.gnss_std[0]} | {f"{row['measurement']}s": row["stated_std"] for row in c.measurements}
    if near := [f"{name} ({std:.2g})" for name, std in stated.items() if 0.7 < std < 1.4]:
        sentences.append(f"whether deviations of {', '.join(near)} are variances: both are near 1")
    return sentences


def _below(errors: Mapping[str, float], enough: float) -> str:
    """Names of what is not known as well as enough, with what stays hidden."""
    blind = {name: error for name, error in errors.items() if error > enough}
    return ", ".join(f"{name} (below {error:.2g})" if np.isfinite(error) else name for name, error in blind.items())
