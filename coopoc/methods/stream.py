"""Streaming: a solo filter that is fed one step at a time, with missing and delayed fixes and whatever dt there is."""

import numpy as np
import numpy.typing as npt

from ..arrays import Floats
from ..kernels.dead_reckoning import ESTIMATE, NO_FIX_YET
from ..kernels.motion import MotionNoise
from ..kernels.odometry_fault import new_state
from ..kernels.solo import STATE, FixNoise, stream_step
from .motion_history import MotionHistory, three


class FilterStream:
    """A compiled solo filter, step by step: `step` takes the new measurements and returns the estimate.

    Args:
        motion: noise of the motion.
        fixes: noise of the fixes.
        x0: (3,) m, a position known before the first step; None starts at the first fix.
        history: s, how old a delayed fix may be.
    """

    def __init__(self, motion: MotionNoise, fixes: FixNoise, x0: npt.ArrayLike | None, history: float) -> None:
        self.history = MotionHistory(history)
        self._state, self._given, self._noise = (
            np.full((3, len(STATE)), np.nan),
            np.zeros(8),
            np.hstack((*motion, *fixes)),
        )
        self._odometry = new_state(motion) if fixes.gate > 0.0 else np.empty((0, 0))
        if x0 is not None:
            self._state[:] = STATE
            self._state[:, 0] = three("x0", x0)

    def step(
        self, gnss: npt.ArrayLike | None, velocity: npt.ArrayLike, dt: float, fix_age: float = 0.0
    ) -> tuple[Floats, Floats | None]:
        """Position (3,) m and covariance (3, 3) m^2 now; NaN and None before the first fix.

        A fix that was true `fix_age` seconds ago is moved by the dead-reckoned motion since, and its covariance grows
        by the noise of that motion. The filter's own prediction has made the same error of motion, and so have other
        delayed fixes: that correlation is ignored (docs/streaming.md gives its cost).

        Args:
            gnss: (3,) m; None or NaN for no fix.
            velocity: (3,) m/s, the mean over the step.
            dt: s since the last step.
            fix_age: s, of the fix; without a fix it means nothing.

        Raises:
            InputError: another shape, dt <= 0, a number that is not finite, a fix older than the history; the filter is
                then as it was before.
        """
        self.history.write(self._given, gnss, velocity, dt, fix_age)
        answer = np.empty(12)
        outcome = stream_step(self._given, self._state, self.history.reserve(), self._odometry, self._noise, answer)
        if outcome == NO_FIX_YET:
            return np.full(3, np.nan), None
        if outcome != ESTIMATE:
            self.history.check(gnss, velocity, dt, fix_age)
        return answer[:3], answer[3:].reshape(3, 3)
