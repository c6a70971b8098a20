"""Token bucket at a receiver: which messages pass a cap on bytes, nearest first or round robin."""

from __future__ import annotations

import numpy as np

from ..arrays import Ints
from .recording import Recording


def within_cap(arrival: Ints, size: Ints, start: Ints, sender: Ints, recording: Recording) -> Ints:
    """Arrivals (R, M) with -1 for messages that a token bucket rejects.

    The bucket holds what one second brings, or the largest message if that is more; it is full at the first step, as in
    RFC 2697 (section 3), and it fills by `bytes_per_second` times dt a step. A message that arrives is accepted if
    there are tokens for all of it. Of those that arrive together the nearest sender's is first, or in round robin that
    of the sender whose last accepted message is oldest.

    Args:
        arrival: (R, M) steps at one receiver, by sending step and then nearest first; those of one sending step arrive
            together.
        size: (M,) bytes on air.
        start: (T+1,) start[t]:start[t+1] are sent at step t.
        sender: (M,) columns.
        recording: its V2X has the cap and the schedule.
    """
    cap = recording.v2x.bytes_per_second
    if not np.isfinite(cap) or not size.any():
        return arrival
    depth = float(max(cap, int(size.max()))) if cap else 0.0
    accepted, last_accepted = np.full_like(arrival, -1), np.full((len(arrival), len(recording.ids)), -1)
    tokens, last = np.full(len(arrival), depth), 0
    for t, span in enumerate(map(slice, start[:-1].tolist(), start[1:].tolist())):
        left = arrival[:, span] >= 0
        if not left.any():
            continue
        now = int(arrival[:, span].max())
        tokens, last = np.minimum(tokens + cap * recording.dt * (now - last), depth), now
        while (fits := left & (size[span] <= tokens[:, None] + 1e-9)).any():
            run = np.flatnonzero(fits.any(axis=1))
            waited = 0 if recording.v2x.schedule == "nearest" else t - last_accepted[:, sender[span]]
            best = np.where(fits, waited, -1)[run].argmax(axis=1)
            message = span.start + best
            last_accepted[run, sender[message]] = t
            left[run, best] = False
            accepted[run, message] = arrival[run, message]
            tokens[run] -= size[message]
    return accepted
