"""How two bodies stand to each other: each candidate between them is a hypothesis, and the others vote."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Bools, Floats, Ints
from ..algebra.sparse import sparse
from ..model.part import restricted, rows_among
from ..model.problem import Problem
from ..model.space import carried
from .bodies import HELD, pinned
from .outliers import Marked
from .predictions import predicted

TRIED = 20
"""Hypotheses of a pair of bodies, spread over its candidates, and as many of those that contradict the best: where
60 % of the candidates are wrong, 20 hypotheses hold no right one in 4 of 100,000 cases."""
AGREEING = 2
"""Candidates that must agree, the hypothesis included: one alone proves nothing."""


class State(NamedTuple):
    """What has been decided: nodes x (1, n, ambient), each free body in a frame of its own; weight (1, G) of candidates
    that have joined; left (G,) how often each has left; body (n,) of each node, see `bodies.py`."""

    x: Floats
    weight: Floats
    left: Ints
    body: Ints


@dataclass(frozen=True, eq=False)
class Joint:
    """A hypothesis of how two bodies stand to each other.

    Args:
        bodies: HELD or the first node of one, and the first node of the other, which moves.
        group: of candidates that places it.
        move: (2, ambient) a pose of the other before and after.
        fits: (G,) candidates between them that agree, itself included.
        misfit: sum of their d^2.
        count: candidates between them.
        rival: most that agree with a hypothesis that does not fit, and not with this one.
    """

    bodies: tuple[int, int]
    group: int
    move: Floats
    fits: Bools
    misfit: float
    count: int
    rival: int = 0

    @property
    def agree(self) -> int:
        """How many candidates agree."""
        return int(self.fits.sum())

    @property
    def decided(self) -> bool:
        """Whether candidates agree, and more than on anything else."""
        return self.agree >= AGREEING and self.agree > self.rival

    def placed(self, problem: Problem, state: State) -> Floats:
        """(1, n, ambient) nodes with the second body moved."""
        x, moving = state.x.copy(), state.body == self.bodies[1]
        x[0, moving] = carried(problem.space, x[0, moving], *self.move)
        return x

    def described(self, problem: Problem) -> dict[str, Any]:
        """For `Solution.extras`; bodies by the names of their first nodes."""
        to, body = ("world" if k == HELD else problem.names[k] for k in self.bodies)
        return {"body": body, "to": to, "agree": self.agree, "rival": self.rival, "candidates": self.count}


class Pair:
    """Two bodies, the part of the problem that they are, and the candidates between them.

    Args:
        problem: a single one.
        marked: the candidates.
        bound: (1, G) c^2.
        state: so far.
        bodies: HELD or the first node of one, and the first node of the other.
        groups: of relative poses between them.
    """

    def __init__(
        self, problem: Problem, marked: Marked, bound: Floats, state: State, bodies: tuple[int, int], groups: Ints
    ) -> None:
        self._problem, self._marked, self._bound, self._state = problem, marked, bound[0], state
        self._bodies, self._groups, self._used = bodies, groups, np.isin(state.body, bodies)
        rows = rows_among(problem, self._used)
        self._part = restricted(pinned(problem, state.body[state.body == bodies[0]]), self._used, state.x[0], rows)
        self._inside = marked.among(rows)
        sparse(self._part, least=0)  # is kept as long as the part is, so that all hypotheses share its analysis

    def vote(self) -> Joint:
        """The hypothesis with which most candidates agree, and its best rival."""
        tried = self._spread(self._groups)
        best = max(tried, key=lambda joint: (joint.agree, -joint.misfit))
        others = np.setdiff1d(self._groups, [*np.flatnonzero(best.fits), *(joint.group for joint in tried)])
        tried += self._spread(others)
        best = max(tried, key=lambda joint: (joint.agree, -joint.misfit))
        rivals = [joint.fits & ~best.fits for joint in tried if not best.fits[joint.group]]
        return replace(best, rival=max((int(fits.sum()) for fits in rivals), default=0))

    def _spread(self, groups: Ints) -> list[Joint]:
        """Hypotheses that are spread over some groups."""
        chosen = np.unique(np.linspace(0, len(groups) - 1, min(TRIED, len(groups))).round().astype(np.int64))
        return [self._joint(group) for group in groups[chosen].tolist()]

    def _joint(self, group: int) -> Joint:
        """The hypothesis of a group: the second body as its first relative pose has it, and what then fits."""
        first, weight = int(np.flatnonzero(self._marked.group == group)[0]), self._state.weight.copy()
        factor, row = self._problem.factors[self._marked.factor[first]], self._marked.row[first]
        (i, j), z, x, space = factor.nodes[row], factor.z[row], self._state.x[0], self._problem.space
        origin = space.join(np.zeros(space.dimension))
        if self._state.body[j] == self._bodies[1]:
            move = np.stack([x[j], carried(space, z, origin, x[i])])
        else:
            move = np.stack([x[i], carried(space, origin, z, x[j])])
        guess = Joint(self._bodies, group, move, np.zeros(len(self._bound), dtype=bool), 0.0, len(self._groups))
        weight[0, group] = 1.0
        at = guess.placed(self._problem, self._state)[:, self._used]
        distance, _ = predicted(self._part, self._inside, weight, at)
        fits = guess.fits.copy()
        fits[self._groups] = distance[self._groups] <= self._bound[self._groups]
        fits[group] = True
        return replace(guess, fits=fits, misfit=float(distance[fits].sum()))
