"""Live estimation: GTSAM's iSAM2 follows the measurements, and `solve` checks where it has led."""

from collections import ChainMap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Floats, checked, instance, named
from ..errors import InputError, shown
from .assess.assess import assess
from .backends.gtsam import estimate, forms, graph_of, tangent, values, which_turn
from .model.factor import Factor, fused, unchecked
from .model.problem import Problem, index_of, indices, points, rows, several
from .solution import Solution
from .solve import solve
from .starts.initial import initial_guess

LOOSE = 1e6
"""m, standard deviation of a prior that iSAM2 alone has on each new point: so vague that measurements decide wherever
the first guess was."""
VAGUE = 1e-6
"""Information of the prior of one that its first measurements leave free, as a range does, as a share of what they tell
of its best known direction: with less of it, GTSAM's Cholesky takes a pivot for zero."""


class Incremental:
    """An estimate that follows measurements; build it with `incremental`.

    Args:
        problem: at the beginning.
        isam: the gtsam.ISAM2 behind it; its keys are the indices of `names`.

    Attributes:
        names: of the nodes so far, in the order in which they came.
    """

    def __init__(self, problem: Problem, isam: Any) -> None:
        self.names, self.isam, self._problem, self._factors = list(problem.names), isam, problem, list(problem.factors)
        self._place, self._poses = {name: k for k, name in enumerate(self.names)}, {*problem.poses}
        self._step(problem, range(len(self.names)), initial_guess(problem))

    def add(
        self, factors: Iterable[Factor | Sequence[Any]] = (), values: Mapping[str, ArrayLike] | None = None
    ) -> None:
        """One step of iSAM2 with new measurements, and first guesses of the nodes that are new.

        Args:
            factors: (kind, nodes, z, std) as `Problem.add` takes them, such as ("range", ("x7", "dock"), 4.2, 0.1); or
                Factors, whose nodes are indices of `names`, the new ones last.
            values: name -> (d,) m of a point, or `pose(...)` (ambient,) of a pose.

        Raises:
            InputError: a name that is known already or unknown, a measurement that GTSAM has no factor for, a new pose
                that nothing holds; the estimate is as before.
        """
        space, first = self._problem.space, len(self.names)
        new = named("values", values or {}, "Give names of nodes.")
        d, x, late_poses = space.dimension, np.zeros((len(new), space.ambient)), set()
        for k, (name, value) in enumerate(new.items()):
            if name in self._place:
                raise InputError("values", repr(name), "must be a new node", "Give guesses of new nodes alone.")
            vector = checked("values", value).ravel()
            if len(vector) not in (d, space.ambient):
                allowed = f"must be {d} numbers of a point or {space.ambient} of a pose"
                raise InputError("values", f"{name}: {len(vector)} numbers", allowed, "Make poses with coopoc.pose.")
            if turned := len(vector) > d:
                late_poses.add(first + k)
            x[k] = vector if turned else space.join(vector)
        points(space, len(x), "values", x)
        every, fresh = [*self.names, *new], {name: first + k for k, name in enumerate(new)}
        index_of_name = ChainMap(fresh, self._place)

        def index(node: Any) -> int:
            return index_of(node, index_of_name, every)

        made = []
        for each in several(factors):
            if not isinstance(each, Factor):
                if isinstance(each, str) or not isinstance(each, Sequence) or not 3 <= len(each) <= 4:
                    allowed = "must be Factors, or tuples (kind, nodes, z, std)"
                    raise InputError("factors", shown(each), allowed, 'Give [("range", ("x7", "dock"), 4.2, 0.1)].')
                kind, nodes, z, *std = each
                at = indices(index, kind, nodes)
                each = Factor(kind, at, rows(kind, z, len(at)), *std)
            made.append(each)
        used = sorted({*range(first, len(every)), *(k for f in made for k in f.nodes.ravel().tolist())})
        names = [every[index(k)] for k in used]
        poses = [k for k, node in enumerate(used) if node in self._poses or node in late_poses]
        local = [unchecked(f, nodes=np.searchsorted(used, f.nodes)) for f in made]
        part = self._problem.replace_unchecked(names=tuple(names), factors=local, poses=tuple(poses), fixed=(), x0=None)
        part.__dict__["space"] = space
        for factor in local:
            part._check(factor)
        self._step(part, used, x)
        self._poses |= late_poses
        self._place.update(fresh)
        self.names = every
        self._factors += made

    def _step(self, part: Problem, keys: Sequence[int], x: Floats) -> None:
        """iSAM2's step with the factors of a problem, whose nodes have these keys; the last ones, at x, are new."""
        import gtsam

        stated, old = forms(part), len(keys) - len(x)
        if None in stated:
            lacking, allowed = repr(part.factors[stated.index(None)]), "must be one that GTSAM has a factor for"
            hint = "relative_pose_log takes any covariance and loss; solve() takes all."
            raise InputError("factors", lacking, allowed, hint)
        points = sorted({*range(old, len(keys))} - {*part.poses})
        if free := ", ".join(self._free(part, keys, x, points)[:5]):
            raise InputError("factors", f"leave {free} free", "must hold every new pose", "Add a relative pose.")
        graph, guess = graph_of(part, stated, keys), values(part.space, which_turn(part)[old:], x, *keys[old:][:1])
        if points:
            at, d, dof = self._at(keys, x), part.dimension, part.space.dof
            J = part.whiten(at)[1].tocsc()
        for k in points:
            own = J[:, k * dof : k * dof + d]
            least, *_, most = np.linalg.eigvalsh(np.nan_to_num((own.T @ own).toarray())).tolist()
            information = max(VAGUE * most * (least <= VAGUE * most), LOOSE**-2)
            vague = gtsam.noiseModel.Isotropic.Precision(d, information)
            graph.add(gtsam.__dict__[f"PriorFactorPoint{d}"](keys[k], at[k, :d], vague))
        for again in (False, True):
            count = self.isam.getFactorsUnsafe().size()
            try:
                self.isam.update(graph, guess)
                break
            except RuntimeError as error:
                self._restore(count, keys[old:])
                if again:
                    said = shown(" ".join(str(error).split()), 200)
                    raise InputError("factors", said, "must be a step that iSAM2 can take", "Measure more.") from None

    def _at(self, keys: Sequence[int], x: Floats) -> Floats:
        """(n, ambient) nodes with these keys, the last of which are new."""
        return np.reshape([*map(self.__getitem__, keys[: len(keys) - len(x)]), *x], (len(keys), -1))

    def _restore(self, count: int, new: Iterable[int]) -> None:
        """iSAM2 anew from its first `count` factors, without new nodes, by QR, which takes no small pivot for zero: a
        step that failed has left it between."""
        import gtsam

        graph, old = gtsam.NonlinearFactorGraph(), self.isam.getFactorsUnsafe()
        guess, params = gtsam.Values(self.isam.getLinearizationPoint()), self.isam.params()
        for k in filter(old.exists, range(count)):
            graph.add(old.at(k))
        for key in filter(guess.exists, new):
            guess.erase(key)
        params.setFactorization("QR")
        self.isam = gtsam.ISAM2(params)
        self.isam.update(graph, guess)

    def _free(self, part: Problem, keys: Sequence[int], x: Floats, points: list[int]) -> list[str]:
        """New poses that the factors of a step leave free where older nodes are known, and new points to LOOSE: only
        of those that no whole relative poses hold the null space is looked at."""
        d, older = part.dimension, range(len(keys) - len(x))
        held = {*older, *part.fixed}
        for factor in part.factors:
            if factor.measurement.compares_poses:
                for nodes in factor.nodes[factor.measured == factor.size].tolist():
                    held.update(nodes if len(nodes) == 1 or not held.isdisjoint(nodes) else [])
        loose = {part.names[k] for k in {*part.poses} - held}
        if loose:
            at = self._at(keys, x)
            vague = (
                [Factor("position", np.array(points)[:, None], at[points, :d], std=np.full(d, LOOSE))] if points else []
            )
            old_fixed = part.replace_unchecked(fixed=(*part.fixed, *older), factors=(*part.factors, *vague))
            loose.intersection_update(assess(old_fixed, at, covariance=False).unobservable)
        return sorted(loose)

    def __contains__(self, node: str) -> bool:
        return node in self._place

    @property
    def x(self) -> Floats:
        """(n, ambient) iSAM2's estimate of all nodes."""
        posed = [k in self._poses for k in range(len(self.names))]
        return estimate(self._problem.space, posed, self.isam.calculateEstimate())

    def __getitem__(self, node: str | int) -> Floats:
        """(ambient,) iSAM2's estimate of a node, in a time that does not grow with the others."""
        k, space = index_of(node, self._place, self.names), self._problem.space
        turned, d = k in self._poses, space.dimension
        value = getattr(self.isam, f"calculateEstimate{'Pose' if turned else 'Point'}{d}")(k)
        if not turned:
            return space.join(np.asarray(value))
        matrix = value.matrix()
        return space.join(matrix[:d, d], matrix[:d, :d])

    def marginal(self, node: str | int) -> Floats:
        """(dof, dof) m^2, rad^2 covariance of a node at iSAM2's linearisation, as `Solution.covariance` has it."""
        k = index_of(node, self._place, self.names)
        turn = tangent(self._problem.space, [k in self._poses], self[node][None])[0]
        return np.asarray(turn @ self.isam.marginalCovariance(k) @ turn.T)

    @property
    def problem(self) -> Problem:
        """All measurements so far, from iSAM2's estimate."""
        x, fixed, poses = self.x, list(self._problem.fixed), tuple(sorted(self._poses))
        x[fixed] = initial_guess(self._problem)[fixed]
        return replace(self._problem, names=tuple(self.names), factors=fused(self._factors), x0=x, poses=poses)

    def update(self, throw: bool = False, **options: Any) -> Solution:
        """`solve` of all measurements so far from iSAM2's estimate, with its statuses and notes.

        It takes the time of a few steps of the whole problem; extras["isam2_off"] is the farthest (m) that iSAM2's
        estimate was from the answer. Arguments and errors as `solve`.
        """
        problem = self.problem
        solution, d = solve(problem, throw=throw, **options), problem.dimension
        off = np.linalg.norm((solution.x - np.asarray(problem.x0))[:, :d], axis=1).max(initial=0.0)
        return replace(solution, extras=solution.extras | {"isam2_off": float(off)})


def incremental(problem: Problem, params: Any = None) -> Incremental:
    """A problem that grows live: GTSAM's iSAM2 takes a step with all that is added.

    Robust losses are those of `solve`; where GTSAM has no factor of a measurement, or with constraints, it is refused.

    Args:
        problem: the first nodes, with an x0 where there are poses.
        params: gtsam.ISAM2Params; None: GTSAM's own.

    References:
        Kaess et al., iSAM2: incremental smoothing and mapping using the Bayes tree, IJRR 2012.

    Raises:
        InputError: constraints, poses without an x0, a measurement that GTSAM has no factor for.

    >>> live = incremental(Problem(("a",), dimension=2).add("position", "a", [0, 0], std=0.1))
    >>> live.add([("displacement", ("a", "b"), [5, 0], 0.1)], {"b": [4, 0]})
    >>> live["b"].round(3), live.marginal("b").round(3)[0, 0], live.update().status.name
    (array([5., 0.]), np.float64(0.02), 'SOLVED')
    """
    instance("problem", problem, Problem)
    import gtsam

    if problem.constraints:
        hint = "Leave them out, or solve() with them."
        raise InputError("problem", f"with {len(problem.constraints)} constraints", "must have none", hint)
    params = instance("params", gtsam.ISAM2Params() if params is None else params, gtsam.ISAM2Params)
    return Incremental(problem, gtsam.ISAM2(params))
