"""Channels by name, and the losses that they draw."""

import numpy as np

from ..arrays import Bools, Floats, instance
from ..plugins import called
from .v2x import V2X


def lost(draws: Floats, loss: float, burst: float) -> Bools:
    """Gilbert-Elliott losses: a two-state chain with stationary share `loss` and mean bad run `burst`.

    P(good -> bad) = loss / (burst (1 - loss)), P(bad -> good) = 1 / burst; burst <= 1/(1 - loss) is independent loss.

    Args:
        draws: (R, M) uniforms in [0, 1), one per message in sending order.

    Returns:
        (R, M) True where lost.

    >>> bool(lost(np.full((1, 4), 0.5), 0.2, 1.0).any())
    False
    """
    if loss in (0.0, 1.0):
        return np.full(draws.shape, bool(loss))
    mean_run = max(burst, 1.0 / (1.0 - loss))
    to_bad, stay_bad = loss / (mean_run * (1.0 - loss)), 1.0 - 1.0 / mean_run
    bad = np.empty(draws.shape, bool)
    state = draws[:, 0] < loss if draws.shape[1] else np.zeros(len(draws), bool)
    for k in range(draws.shape[1]):
        if k:
            state = draws[:, k] < np.where(state, stay_bad, to_bad)
        bad[:, k] = state
    return bad


CHANNELS = {"ideal": V2X, "cam": V2X.cam, "bsm": V2X.bsm, "cpm": V2X.cpm}
"""Largest number of neighbours -> V2X. "ideal" counts payload only."""


def channel(name: str, max_neighbours: int = 6) -> V2X:
    """The channel of a name.

    Args:
        name: one of CHANNELS, an entry point in `coopoc.channels`, or "mine.py:NAME", a function of the number K.
        max_neighbours: K.

    Raises:
        InputError: an unknown name, or a function that returns no V2X.

    >>> channel("bsm", 4).rate
    10.0
    """
    hint = "Give a function of the number of neighbours that returns V2X(max_neighbours, ...)."
    return instance(f"what channel {name!r} returns", called("coopoc.channels", name, hint, max_neighbours), V2X, hint)
