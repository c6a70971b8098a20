"""Loop closures by gating and consensus: candidates join known inliers where these predict them, as a start of GNC."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Bools, Floats, Ints
from ...errors import InputError
from ..algebra.sparse import pairs_of, sparse
from ..descent.levenberg_marquardt import arrive
from ..model.derivatives import linearise
from ..model.factor import taken
from ..model.problem import Problem, restricted, rows_among
from ..model.space import carried
from ..starts.graph_starts import parts
from ..starts.initial import along_poses, initial_guess
from .graduated import Inner, Marked

MAX_JOINS = 2
"""Times that a candidate may join: one that a wrong neighbour has displaced returns once that is gone."""
NONLINEAR_FACTOR = 10.0
"""Times its bound up to which a d^2 is checked by a solve: predictions along a drive are linear, its arc is not."""
MAX_RESOLVES = 10
"""Solves of these at most, the least certain predictions first."""
HYPOTHESES = 20
"""Placements of a pair of bodies, spread over its candidates, and as many of those that contradict the best: where
60 % of the candidates are wrong, 20 of them hold no right one in 4 of 100,000 cases."""
MIN_AGREEING = 2
"""Candidates that must agree, the placement's own included: one alone proves nothing."""
WORLD_BODY = -1
"""The body that known inliers join to the world: to fixed nodes, or to nodes with measurements of their own."""
HINT = 'Name fewer measurements as candidates, or use start="any".'


def known_start(marked: Marked, inner: Inner) -> "Decided":
    """Where known inliers lead: candidates join where the others predict them, first within what known inliers hold
    together, then between.

    A candidate fits where d^2 = r^T (J P J^T + cov)^-1 r is within its bound, P the covariance of its nodes given all
    that has joined. Of those that fit the half that is predicted best, by log det(J P J^T + cov), joins in each round,
    so that a loop is judged by what little the odometry of its own length has drifted. One whose residual leaves the
    bound leaves, and when it leaves again stays rejected. Of a group the d^2 are added, as if independent. Where none
    fits, the least certain are solved for: the cost must grow by no more than half the bound.

    A component without a gauge, such as a robot that only others observe, is a body in a frame of its own. Some of the
    candidates between two bodies each propose a placement; the one that predicts most of the other candidates is taken,
    the pair with most agreement first, and the rounds go on.

    Args:
        marked: the problem and its candidates.
        inner: solves a weighted problem.

    Raises:
        InputError: known inliers that do not hold a body in itself, or candidates that do not decide where it is.

    References:
        Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4: the
        gate of a predicted measurement. Olson, Agarwal, IJRR 2013, and Mangelson et al., ICRA 2018, on graphs.
        Fischler, Bolles, Random Sample Consensus, 1981.
    """
    decided = Decided(marked)
    while True:
        body = decided.bodies()
        decided.grow(body, inner)
        if (body == WORLD_BODY).all():
            return decided
        decided.join(decided.bodies())


class Placement(NamedTuple):
    """A hypothesis of how two bodies stand to each other.

    Attributes:
        bodies: WORLD_BODY or the first node of one, and the first node of the other, which moves.
        group: of candidates that places it.
        move: (2, ambient) a pose of the other before and after.
        fits: (G,) candidates between them that agree, itself included.
        misfit: sum of their d^2.
    """

    bodies: tuple[int, int]
    group: int
    move: Floats
    fits: Bools
    misfit: float

    @property
    def rank(self) -> tuple[int, float]:
        """How many candidates agree, and how well."""
        return int(self.fits.sum()), -self.misfit


class Decided:
    """What has been decided.

    Attributes:
        x: (n, ambient), each free body in a frame of its own.
        weight: (G,) of the candidates that have joined.
        left: (G,) how often each has left.
        joined: for each body that candidates joined to another, how many agreed.
    """

    def __init__(self, marked: Marked) -> None:
        self.problem, self.marked, self.bound = marked.problem, marked, marked.bound
        self.weight, self.left = np.zeros(len(self.bound)), np.zeros(len(self.bound), dtype=np.int64)
        self.joined = tuple[dict[str, Any], ...]()
        self.x = along_poses(marked.reweigh(self.weight, initial_guess(self.problem)))

    def bodies(self) -> Ints:
        """(n,) the body of each node, WORLD_BODY or its first pose (if it has none, its first node)."""
        problem = self.problem
        measured = [f.nodes[f.informative] for f in self.marked.reweigh(self.weight, self.x).factors]
        part = parts(len(problem.names), *measured)
        alone = [nodes[:, 0] for nodes in measured if nodes.shape[1] == 1]
        nodes = np.concatenate([problem.poses, np.setdiff1d(np.arange(len(part)), problem.poses)]).astype(np.int64)
        first = nodes[np.unique(part[nodes], return_index=True)[1]]
        first[part[np.concatenate([problem.fixed, *alone]).astype(np.int64)]] = WORLD_BODY
        return first[part]

    def ends(self, body: Ints) -> Ints:
        """(M, 2) bodies that each candidate joins, ascending; WORLD_BODY is one of those of a measurement of a single
        node."""
        end_of = np.full((len(self.marked.row), 2), WORLD_BODY)
        for k in np.unique(self.marked.factor):
            here = self.marked.factor == k
            nodes = self.problem.factors[k].nodes[self.marked.row[here], :2]
            end_of[here, 2 - nodes.shape[1] :] = body[nodes]
        return np.sort(end_of, axis=1)

    def grow(self, body: Ints, inner: Inner) -> None:
        """Rounds of the problem with the bodies pinned, until no more candidates join within them."""
        marked = replace(self.marked, problem=pinned(self.problem, body))
        bound, weight, left, ends = self.bound, self.weight, self.left, self.ends(body)
        judged = marked.sums(ends[:, 0] != ends[:, 1]) == 0
        sparse(marked.problem)  # is kept as long as the problem is, so that all rounds share its analysis
        most_joins = 1
        for _ in range(100):  # about 15 are needed: half of those that fit join in each
            self.x = inner(marked.reweigh(weight, self.x))
            leaving = judged & (weight > 0) & (marked.squares(self.x) > bound)
            left[leaving], weight[leaving] = left[leaving] + 1, 0.0
            distance, volume = predicted(marked, weight, self.x)
            others = judged & (weight == 0) & (left < most_joins)
            fits = others & (distance <= bound)
            if fits.any():
                weight[fits & (volume <= np.median(volume[fits]))] = 1.0
            elif most_joins < MAX_JOINS:
                most_joins = MAX_JOINS
            else:
                some = np.flatnonzero(others & (distance <= NONLINEAR_FACTOR * bound))
                some = some[np.argsort(-volume[some], kind="stable")][:MAX_RESOLVES]
                if not any(self._explained(marked, group) for group in some.tolist()):
                    break

    def _explained(self, marked: Marked, group: int) -> bool:
        """Whether twice the cost grows by no more than the bound where a group joins, which it then does.

        Where the model is linear that growth is d^2. Far along a drive whose heading has become uncertain it is less.
        """
        costs = []
        for joins in (0.0, 1.0):
            self.weight[group] = joins
            system = sparse(marked.reweigh(self.weight, self.x))
            costs.append(system.cost(arrive(system, self.x, 20, 1e-3).x if joins else self.x))
        good = 2.0 * (costs[1] - costs[0]) <= self.bound[group]
        self.weight[group] = float(good)
        return bool(good)

    def join(self, body: Ints) -> None:
        """Take the placement with which most candidates agree, over all pairs of bodies."""
        problem, marked, between = self.problem, self.marked, self.ends(body)
        first = np.unique(marked.group, return_index=True)[1]
        own = between[first]  # of each group
        poses = np.array([factor.kind.startswith("relative_pose") for factor in problem.factors])
        alike = marked.sums((between != own[marked.group]).any(axis=1)) == 0
        groups = np.flatnonzero(
            alike & poses[marked.factor[first]] & (own[:, 0] != own[:, 1]) & (self.left < MAX_JOINS)
        )
        pairs, which, count = np.unique(own[groups], axis=0, return_inverse=True, return_counts=True)
        best, joined, undecided = None, dict[str, Any](), list[str]()
        for p in np.argsort(-count, kind="stable").tolist():
            if best is not None and count[p] <= best.rank[0]:
                break
            leader, rival = self._vote(body, (int(pairs[p, 0]), int(pairs[p, 1])), groups[which.ravel() == p])
            to, of = ("world" if k == WORLD_BODY else problem.names[k] for k in leader.bodies)
            row = {"body": of, "to": to, "agree": leader.rank[0], "rival": rival, "candidates": int(count[p])}
            if leader.rank[0] < MIN_AGREEING or leader.rank[0] <= rival:
                sentence = "of {candidates} between {body} and {to} {agree} agree, {rival} otherwise"
                undecided.append(sentence.format(**row))
            elif best is None or leader.rank > best.rank:
                best, joined = leader, row
        if best is None:
            free = [problem.names[k] for k in np.unique(body[body != WORLD_BODY])]
            what = "; ".join(undecided[:3]) or f"nothing between {', '.join(free[:3])} and the others"
            allowed = "must join what known inliers leave free, two and more that agree"
            raise InputError("candidates", what, allowed, HINT)
        self.x, self.weight[best.group] = self._placed(body, best.bodies[1], best.move), 1.0
        self.joined = *self.joined, joined

    def _placed(self, body: Ints, moving: int, move: Floats) -> Floats:
        """(n, ambient) nodes with a body moved."""
        x = self.x.copy()
        x[body == moving] = carried(self.problem.space, x[body == moving], *move)
        return x

    def _vote(self, body: Ints, bodies: tuple[int, int], groups: Ints) -> tuple[Placement, int]:
        """The placement of a pair with which most of its candidates (groups of relative poses) agree, and how many
        agree on the best other one."""
        problem, marked, used = self.problem, self.marked, np.isin(body, bodies)
        rows = rows_among(problem, used)
        part = restricted(pinned(problem, body[body == bodies[0]]), used, self.x, rows)
        number, space, tried = np.cumsum([len(own) > 0 for own in rows]) - 1, problem.space, list[Placement]()
        kept = np.flatnonzero([r in rows[k] for k, r in zip(marked.factor, marked.row, strict=True)])
        rank = [np.searchsorted(rows[k], r) for k, r in zip(marked.factor[kept], marked.row[kept], strict=True)]
        inside = Marked(part, number[marked.factor[kept]], np.array(rank, np.int64), marked.group[kept], self.bound)
        sparse(part)  # is kept as long as the part is, so that all placements share its analysis
        origin = space.join(np.zeros(space.dimension))
        for _ in range(2):  # spread over all, then over what the best leaves
            best = max(tried, key=lambda each: each.rank, default=None)
            done = [] if best is None else [*np.flatnonzero(best.fits), *(each.group for each in tried)]
            left = np.setdiff1d(groups, done)
            chosen = np.linspace(0, len(left) - 1, min(HYPOTHESES, len(left))).round().astype(np.int64)
            for group in left[np.unique(chosen)].tolist():
                first, weight = int(np.flatnonzero(marked.group == group)[0]), self.weight.copy()
                factor, row = problem.factors[marked.factor[first]], marked.row[first]
                (i, j), z = factor.nodes[row], factor.z[row]
                if body[j] == bodies[1]:
                    move = np.stack([self.x[j], carried(space, z, origin, self.x[i])])
                else:
                    move = np.stack([self.x[i], carried(space, origin, z, self.x[j])])
                weight[group] = 1.0
                distance, _ = predicted(inside, weight, self._placed(body, bodies[1], move)[used])
                fits = np.zeros(len(self.bound), dtype=bool)
                fits[groups] = distance[groups] <= self.bound[groups]
                fits[group] = True
                tried.append(Placement(bodies, group, move, fits, float(distance[fits].sum())))
        best = max(tried, key=lambda each: each.rank)
        others = (int((each.fits & ~best.fits).sum()) for each in tried if not best.fits[each.group])
        return best, max(others, default=0)


def pinned(problem: Problem, body: Ints) -> Problem:
    """The problem with the first node of each free body fixed; itself if there is none."""
    first = np.unique(body[body != WORLD_BODY]).tolist()
    return problem.replace_unchecked(fixed=(*problem.fixed, *first)) if first else problem


def predicted(marked: Marked, weight: Floats, x: Floats) -> tuple[Floats, Floats]:
    """d^2 and log det(J P J^T + cov), in units of cov, of each group (G,), given what has a weight (G,) at x.

    Raises:
        InputError: that leaves nodes free.
    """
    problem, system = marked.problem, sparse(marked.reweigh(weight, x))
    if not system.cholesky.factor(system.quadratic(x, "gauss-newton")[2]):
        raise InputError("candidates", repr(problem), "must leave known inliers that determine all nodes", HINT)
    distance, volume = np.zeros(len(marked.row)), np.zeros(len(marked.row))
    for k in np.unique(marked.factor):
        here = marked.factor == k
        factor = taken(problem.factors[k], marked.row[here])
        with np.errstate(all="ignore"):
            linear = linearise(problem.space, [factor], None, x)
        J, r = np.concatenate(linear.jacobian[0], axis=2), linear.residual[0]
        # an angle between nodes that coincide has no derivative
        lost = ~np.isfinite(r).all(axis=1) | ~np.isfinite(J).all(axis=(1, 2))
        r, J = np.where(lost[:, None], 0.0, r), np.where(lost[:, None, None], 0.0, J)
        free, *pairs = pairs_of(system.entries.number[factor.nodes].reshape(len(J), -1))
        P = np.zeros(free.shape)
        P[free] = system.cholesky.inverse(*pairs)
        S = J @ P @ np.swapaxes(J, 1, 2) + np.eye(factor.size)
        lost |= ~np.isfinite(S).all(axis=(1, 2))
        variance, axes = np.linalg.eigh(np.where(lost[:, None, None], np.eye(factor.size), S))
        variance = np.maximum(variance, 1.0)  # as it is but for rounding, of nodes that are nearly free
        distance[here] = np.where(lost, np.inf, (np.einsum("mkj,mk->mj", axes, r) ** 2 / variance).sum(axis=1))
        volume[here] = np.log(variance).sum(axis=1)
    return marked.sums(distance), marked.sums(volume)
