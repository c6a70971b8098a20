"""Candidates that known inliers predict: a start of GNC that no outlier has pulled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...arrays import Floats
from ...errors import InputError
from ..algebra.sparse import sparse
from ..descent.trust_region import arrive
from ..initialisation.initial import initial_guess
from ..initialisation.walk import along_poses
from ..model.problem import Problem
from .bodies import HELD, bodies, ends, pinned, within
from .hypotheses import Joint, Pair, State
from .outliers import Marked, reweigh, squares
from .predictions import HINT, predicted

ROUNDS = 100
"""About 15 are needed: half of those that fit join in each."""
CHANCES = 2
"""Times that a candidate may join: one that a wrong neighbour has pushed out comes back once that is gone."""
CURVED = 10.0
"""Times its bound up to which a d^2 is checked by a solve: predictions along a drive are linear, and its arc is not."""
TRIED = 10
"""Of these, the least certain predictions first."""
STEPS = 20
"""Of such a solve; a loop that fits needs fewer."""
TOLERANCE = 1e-3
"""m or rad, a step that ends it."""
Inner = Callable[[Problem], Floats]
"""Solves a weighted problem: x (1, n, ambient)."""


@dataclass(frozen=True, eq=False)
class Known:
    """Where the known inliers lead.

    Args:
        x: (1, n, ambient) nodes.
        weight: (1, G) of the candidates.
        rounds: that it took.
        joined: for each body that candidates joined to another, how many agreed.
    """

    x: Floats
    weight: Floats
    rounds: int
    joined: tuple[dict[str, Any], ...]


def compatible(problem: Problem, marked: Marked, bound: Floats, inner: Inner) -> Known:
    """Candidates join where the others predict them: first within what known inliers hold together, then between.

    A candidate fits where d^2 = r^T (J P J^T + cov)^-1 r is within its bound, P the covariance of its nodes given all
    that has joined. Of those that fit the half that is predicted best, by log det(J P J^T + cov), joins in each round,
    so that a loop is judged by what little the odometry of its own length has drifted. One whose residual leaves the
    bound leaves, and when it leaves again stays rejected. Of a group the d^2 are added, as if independent. Where none
    fits, the least certain are solved for: the cost must grow by no more than half the bound.

    A body that known inliers leave free, such as a robot that only others see, is solved in a frame of its own. Each of
    some candidates between two bodies then places one of them; the placement that predicts most of the other candidates
    is taken, the pair with most agreement first, and the rounds go on.

    Args:
        problem: a single one.
        marked: the candidates.
        bound: (1, G) c^2.
        inner: solves.

    Raises:
        InputError: known inliers that do not hold a body in itself, or candidates that do not decide where it is.

    References:
        Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4: the
        gate of a predicted measurement. Olson, Agarwal, IJRR 2013, and Mangelson et al., ICRA 2018, on graphs.
        Fischler, Bolles, Random Sample Consensus, 1981.
    """
    weight, left = np.zeros((1, bound.shape[1])), np.zeros(bound.shape[1], dtype=np.int64)
    x = along_poses(reweigh(problem, marked, weight, initial_guess(problem)).pick(0))
    rounds, joined = 0, list[dict[str, Any]]()
    while True:
        body = bodies(problem, marked, weight, x)
        whole = pinned(problem, body)
        x, spent = _rounds(whole, marked, bound, inner, State(x, weight, left, body))
        rounds += spent
        if whole is problem:
            return Known(x, weight, rounds, tuple(joined))
        state = State(x, weight, left, bodies(problem, marked, weight, x))
        joint = _next(problem, marked, bound, state)
        x, weight[0, joint.group] = joint.placed(problem, state), 1.0
        joined.append(joint.described(problem))


def _rounds(problem: Problem, marked: Marked, bound: Floats, inner: Inner, state: State) -> tuple[Floats, int]:
    """Nodes and rounds within the bodies; weight and how often each left change in place."""
    x, weight, left, body = state
    judged = within(marked, ends(problem, marked, body), bound.shape[1])
    sparse(problem, least=0)  # is kept as long as the problem is, so that all rounds share its analysis
    chances, rounds = 1, 0
    while rounds < ROUNDS:
        x, rounds = inner(reweigh(problem, marked, weight, x)), rounds + 1
        leaving = judged & (weight[0] > 0) & (squares(problem, marked, x)[0] > bound[0])
        left[leaving], weight[0, leaving] = left[leaving] + 1, 0.0
        distance, spread = predicted(problem, marked, weight, x)
        others = judged & (weight[0] == 0) & (left < chances)
        fits = others & (distance <= bound[0])
        if fits.any():
            weight[0, fits & (spread <= np.median(spread[fits]))] = 1.0
        elif chances < CHANCES:
            chances = CHANCES
        else:
            some = np.flatnonzero(others & (distance <= CURVED * bound[0]))
            some = some[np.argsort(-spread[some], kind="stable")][:TRIED]
            if not any(_explained(problem, marked, bound, x, weight, group) for group in some.tolist()):
                break
    return x, rounds


def _explained(problem: Problem, marked: Marked, bound: Floats, x: Floats, weight: Floats, group: int) -> bool:
    """Whether twice the cost grows by no more than the bound where a group joins, which it then does.

    Where the model is linear that growth is d^2. Far along a drive whose heading has become uncertain it is less.
    """
    costs = []
    for joins in (0.0, 1.0):
        weight[0, group] = joins
        system = sparse(reweigh(problem, marked, weight, x).pick(0), least=0)
        assert system is not None
        costs.append(system.cost(arrive(system, x[0], STEPS, TOLERANCE).x if joins else x[0]))
    good = 2.0 * (costs[1] - costs[0]) <= bound[0, group]
    weight[0, group] = float(good)
    return bool(good)


def _next(problem: Problem, marked: Marked, bound: Floats, state: State) -> Joint:
    """The decided hypothesis with which most candidates agree, over all pairs of bodies; InputError if none is."""
    between, first = ends(problem, marked, state.body), np.unique(marked.group, return_index=True)[1]
    own = between[first]  # of each group
    poses = np.array([factor.kind.startswith("relative_pose") for factor in problem.factors])
    alike = np.bincount(marked.group, (between != own[marked.group]).any(axis=1)) == 0
    groups = np.flatnonzero(alike & poses[marked.factor[first]] & (own[:, 0] != own[:, 1]) & (state.left < CHANCES))
    pairs, which, count = np.unique(own[groups], axis=0, return_inverse=True, return_counts=True)
    best: Joint | None = None
    undecided: list[str] = []
    for p in np.argsort(-count, kind="stable").tolist():
        if best is not None and count[p] <= best.agree:
            break
        bodies_ = int(pairs[p, 0]), int(pairs[p, 1])
        joint = Pair(problem, marked, bound, state, bodies_, groups[which.ravel() == p]).vote()
        if not joint.decided:
            undecided.append(
                "of {candidates} between {body} and {to} {agree} agree, {rival} otherwise".format(
                    **joint.described(problem)
                )
            )
        elif best is None or joint.agree > best.agree:
            best = joint
    if best is None:
        free = [problem.names[k] for k in np.unique(state.body[state.body != HELD])]
        what = "; ".join(undecided[:3]) or f"nothing between {', '.join(free[:3])} and the others"
        allowed = "must join what known inliers leave free, two and more that agree"
        raise InputError("candidates", what, allowed, HINT)
    return best
