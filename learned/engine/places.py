"""Numbers of the layers, of the fields of the tape and of their columns, for the compiled kernels."""

from __future__ import annotations

import numpy as np

from .arithmetic import PAD

SIZE = 3
"""Components of state and measurement, m = n = 3."""
CELLS = SIZE * SIZE
"""Entries of each covariance-like GRU state."""
SHORTEST = 1e-12
"""Length in m up to which a vector has no direction: its feature is zero and has no gradient."""
LOG_FLOOR = 0.01
"""Added to a length in m before its logarithm is taken."""
(
    UPDATE,
    EVOLUTION,
    OBSERVATION,
    PROCESS_X,
    PROCESS_H,
    PRIOR_X,
    PRIOR_H,
    EXPECTED,
    INNOVATION_X,
    INNOVATION_H,
    HIDDEN,
    GAIN,
    BACK,
    POSTERIOR,
) = np.arange(14)
"""The layers; of a GRU, X reads its input and H its state. NumPy's integers, because numba compiles a function anew for
each constant of Python's."""
(
    FEATURES,
    LENGTHS,
    CORRECTED,
    PRIOR_IN,
    INNOVATION_IN,
    PROCESS_OLD,
    PRIOR_OLD,
    INNOVATION_OLD,
    PROCESS_GATES,
    PRIOR_GATES,
    INNOVATION_GATES,
    CORE,
    HIDDEN_OUT,
    POSTERIOR_OUT,
) = np.arange(14)
"""The fields of the tape. LENGTHS: of the four changes, and the innovation itself. CORRECTED: what `update` gives.
PRIOR_IN: what `evolution` gives, the new process state. INNOVATION_IN: what `observation` gives, `prior_to_innovation`.
CORE: what `posterior_hidden` gives, the new prior and innovation states, the gain; layers read windows of it."""
GATES_FROM_OLD = PROCESS_GATES - PROCESS_OLD
"""From the field of a GRU's previous state to that of its gates."""
CHANGES = np.array([[0, 6], [3, 7], [8, 11], [12, 15]])
"""Columns of FEATURES where the direction of a change (of the fix, innovation, evolution, update) begins and where the
logarithm of its length stands."""
FIRST, CORE_PRIOR, CORE_INNOVATION, CORE_GAIN = np.arange(0, 36, 9)
"""Columns of CORE."""
SECOND = CORE_PRIOR
"""Where the second half of a layer's inputs begins that reads two parts of CORE."""
RESIDUAL, KEEP, FRESH, KEPT = 4, 16, 32, 48
"""Columns: of LENGTHS, where the innovation stands; of a GRU's gates, where z, n and the part of n that r scales do."""
GATES = np.int64(3 * PAD)
"""Columns of what a GRU's X or H gives, 27, with room for windows of PAD columns."""
