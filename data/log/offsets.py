"""Ranges of a log less what each pair measures too long: radios whose delays are not calibrated."""

from dataclasses import replace

import numpy as np

from .estimates import against_truth, offsets, on_time
from .read import Log
from .residuals import filtered

SHOWING_SHARE = 0.4
"""Share of a log that shows by what its ranges are too long."""


def less_offsets(log: Log) -> Log:
    """The log with each pair's ranges less what they are too long by in the median over its first part, against the
    truth where there is one, else against the filters of each vehicle alone; nothing is taken off where that part shows
    none for sure. The summary names pairs and offsets.

    Raises:
        InputError: as `check`.
    """
    rec, until, by = log.recording, SHOWING_SHARE * float(np.ptp(log.recording.t)), "filters of each vehicle alone show"
    c = on_time(filtered(log.part(until=until)))
    if c.log.truth is not None and not c.ahead.any():
        c, by = replace(against_truth(c), variance=0 * c.variance), "the truth shows"
        rec = replace(rec, sensors=replace(rec.sensors, range_offset_std=0.0))
    relative, ends = rec.relative.copy(), np.sort([rec.links.observer, rec.links.neighbour], axis=0)
    known_offsets = offsets(c, 0, rec.sensors.range_std)
    for one, other in np.unique(ends, axis=1).T:
        pair = f"{rec.ids[one]} and {rec.ids[other]}"
        offset, error = known_offsets.get(pair, (0.0, np.inf))
        sure = abs(offset) > 2 * error
        text = (
            f"ranges are less what {by} in the first {until:.3g} s"
            if sure
            else "ranges are left as they are, too few or not off for sure"
        )
        log.summary.assume(f"{text}: {{}}", f"{offset:+.3g} +- {error:.2g} m of {pair}")
        relative[:, (ends[0] == one) & (ends[1] == other), 0] -= offset * sure
    notes = dict.fromkeys((*rec.notes, *log.summary.sentences))
    return replace(log, recording=replace(rec, relative=relative, notes=tuple(notes)))
