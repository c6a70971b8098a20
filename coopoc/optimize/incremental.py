"""Live estimation: GTSAM's iSAM2 follows the measurements, and `solve` checks where it has led."""

from collections import ChainMap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..arrays import Floats, checked, instance, number
from ..errors import InputError, require
from .backends.gtsam import estimate, forms, graph_of, tangent, values, which_turn
from .model.factor import Factor, fused, stacked, unchecked
from .model.problem import Problem, index_of, indices, points, rows
from .solution import Solution
from .solve import solve
from .starts.initial import initial_guess

LOOSE = 100.0
"""m, standard deviation of a prior that iSAM2 alone has on each new point, which one range leaves free; with less
information GTSAM takes a pivot for zero."""


class Incremental:
    """An estimate that follows measurements; build it with `incremental`.

    Args:
        problem: at the beginning.
        isam: the gtsam.ISAM2 behind it, or its IncrementalFixedLagSmoother; its keys are the indices of `names`.
        lag: steps after which the latter forgets a node that no measurement uses any more, 0 for never.

    Attributes:
        names: of the nodes so far, in the order in which they came.
    """

    def __init__(self, problem: Problem, isam: Any, lag: int) -> None:
        self.names, self.isam, self._problem, self._factors = list(problem.names), isam, problem, list(problem.factors)
        self.lag, self._steps = lag, 0
        self._place, self._poses = {name: k for k, name in enumerate(self.names)}, {*problem.poses}
        self._step(problem, range(len(self.names)), 0, initial_guess(problem), which_turn(problem))

    def add(
        self,
        factors: Iterable[Factor | Sequence[Any]] = (),
        values: Mapping[str, npt.ArrayLike] | None = None,
    ) -> None:
        """One step of iSAM2 with new measurements, and first guesses of the nodes that are new.

        Args:
            factors: (kind, nodes, z, std) as `Problem.add` takes them, such as ("range", ("x7", "dock"), 4.2, 0.1); or
                Factors, whose nodes are indices of `names`, the new ones last.
            values: name -> (d,) m of a point, or `pose(...)` (ambient,) of a pose.

        Raises:
            InputError: a name that is known already or unknown, a measurement that GTSAM has no factor for.
        """
        space, first, new = self._problem.space, len(self.names), dict(values or {})
        d, x, turns = space.dimension, np.zeros((len(new), space.ambient)), list[bool]()
        for k, (name, value) in enumerate(new.items()):
            if name in self._place:
                raise InputError("values", repr(name), "must be a new node", "Give guesses of new nodes alone.")
            vector = checked("values", value).ravel()
            if len(vector) not in (d, space.ambient):
                allowed = f"must be {d} numbers of a point or {space.ambient} of a pose"
                raise InputError("values", f"{name}: {len(vector)} numbers", allowed, "Make poses with coopoc.pose.")
            turns.append(space.has_rotation and len(vector) > d)
            x[k] = vector if turns[-1] else space.join(vector[None, :d])[0]
        points(space, len(x), "values", x)
        every, fresh = [*self.names, *new], {name: first + k for k, name in enumerate(new)}
        place = ChainMap(fresh, self._place)

        def index(node: Any) -> int:
            known_index = index_of(node, place, every)
            return known_index if known_index >= first else self._index(known_index)

        made = list[Factor]()
        for each in factors:
            if not isinstance(each, Factor):
                kind, nodes, z, *std = each
                at = indices(index, kind, nodes)
                each = Factor(kind, at, rows(kind, z, len(at)), *std)
            made.append(each)
        used = np.unique(stacked(f.nodes.ravel() for f in made)).tolist()
        names = [every[index(k)] for k in used]
        late_poses = {first + k for k, turned in enumerate(turns) if turned}
        poses = [k for k, node in enumerate(used) if node in self._poses or node in late_poses]
        local = [unchecked(f, nodes=np.searchsorted(used, f.nodes)) for f in made]
        part = Problem(tuple(names), local, dimension=d, poses=tuple(poses))
        part.__dict__["space"] = space
        self._step(part, used, first, x, turns)
        self._poses |= late_poses
        self._place.update(fresh)
        self.names = every
        self._factors += made

    def _step(self, part: Problem, keys: Sequence[int], first: int, x: Floats, turns: Sequence[bool]) -> None:
        """iSAM2's step with the factors of a problem, whose nodes have these keys, and new nodes from `first` on."""
        import gtsam

        parts, d = forms(part), part.dimension
        for factor, form in zip(part.factors, parts, strict=True):
            if form is None:
                hint = "relative_pose_log takes any covariance and loss; solve() takes all."
                raise InputError("factors", repr(factor), "must be one that GTSAM has a factor for", hint)
        graph, guess = graph_of(part, parts, keys), values(part.space, turns, x, first)
        loose = gtsam.noiseModel.Isotropic.Sigma(d, LOOSE)
        for k in np.flatnonzero(~np.array(turns, dtype=bool)).tolist():
            graph.add(gtsam.__dict__[f"PriorFactorPoint{d}"](first + k, x[k, :d], loose))
        if self.lag:
            now = float(self._steps)
            self.isam.update(graph, guess, {**dict.fromkeys(keys, now), **dict.fromkeys(guess.keys(), now)})
        else:
            self.isam.update(graph, guess)
        self._steps += 1

    def __contains__(self, node: str) -> bool:
        return node in self._place

    @property
    def x(self) -> Floats:
        """(n, ambient) iSAM2's estimate of all nodes; InputError with a lag."""
        if self.lag:
            raise InputError("lag", self.lag, "must be 0 for all nodes at once", "Read the late ones by name.")
        posed = [k in self._poses for k in range(len(self.names))]
        return estimate(self._problem.space, posed, self.isam.calculateEstimate())

    def __getitem__(self, node: str | int) -> Floats:
        """(ambient,) iSAM2's estimate of a node, in a time that does not grow with the others."""
        import gtsam

        k, value = self._index(node), gtsam.Values()
        turned = k in self._poses
        name = f"{'Pose' if turned else 'Point'}{self._problem.dimension}"
        value.insert(0, getattr(self.isam, f"calculateEstimate{name}")(k))
        return np.asarray(estimate(self._problem.space, [turned], value)[0])

    def marginal(self, node: str | int) -> Floats:
        """(dof, dof) m^2, rad^2 covariance of a node at iSAM2's linearisation, as `Solution.covariance` has it."""
        k = self._index(node)
        turn = tangent(self._problem.space, [k in self._poses], self[node][None])[0]
        return np.asarray(turn @ self.isam.marginalCovariance(k) @ turn.T)

    def _index(self, node: str | int) -> int:
        index = index_of(node, self._place, self.names)
        if self.lag and not self.isam.getLinearizationPoint().exists(index):
            raise InputError("node", node, f"is forgotten, {self.lag} steps after it was used", "Take a longer lag.")
        return index

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


def incremental(
    problem: Problem,
    relinearizeThreshold: float = 0.1,
    relinearizeSkip: int = 10,
    wildfireThreshold: float = 1e-3,
    lag: int = 0,
) -> Incremental:
    """A problem that grows live: GTSAM's iSAM2 takes a step with all that is added.

    Robust losses are those of `solve`; where GTSAM has no factor of a measurement, or with constraints, it is refused.

    Args:
        problem: the first nodes, with an x0 where there are poses.
        relinearizeThreshold: m or rad by which a node may be from where it was linearised.
        relinearizeSkip: steps from one check of this to the next.
        wildfireThreshold: m or rad, change below which it spreads no further.
        lag: steps after which a node that is used no more is forgotten, its information kept (GTSAM's
            IncrementalFixedLagSmoother); then there is no `update`. 0 for never.

    References:
        Kaess et al., iSAM2: incremental smoothing and mapping using the Bayes tree, IJRR 2012.

    Raises:
        InputError: constraints, poses without an x0, a measurement that GTSAM has no factor for.
        MissingLibraryError: gtsam is not installed.

    >>> live = incremental(Problem(("a",), dimension=2).add("position", "a", [0, 0], std=0.1))
    >>> live.add([("displacement", ("a", "b"), [5, 0], 0.1)], {"b": [4, 0]})
    >>> live["b"].round(3), live.marginal("b").round(3)[0, 0], live.update().status.name
    (array([5., 0.]), np.float64(0.02), 'SOLVED')
    """
    instance("problem", problem, Problem)
    require("gtsam", "incremental")
    import gtsam

    if problem.constraints:
        hint = "Leave them out, or solve() with them."
        raise InputError("problem", f"with {len(problem.constraints)} constraints", "must have none", hint)
    params = gtsam.ISAM2Params()
    number("relinearizeThreshold", relinearizeThreshold, 0.0, allowed="a number >= 0", hint="GTSAM's own is 0.1.")
    number("relinearizeSkip", relinearizeSkip, 1, kind=int, allowed="a whole number >= 1", hint="GTSAM's own is 10.")
    number("wildfireThreshold", wildfireThreshold, 0.0, allowed="a number >= 0", hint="GTSAM's own is 1e-3.")
    params.setRelinearizeThreshold(relinearizeThreshold)
    params.relinearizeSkip = relinearizeSkip
    params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(wildfireThreshold))
    number("lag", lag, 0, kind=int, allowed="a whole number >= 0", hint="0 forgets nothing.")
    return Incremental(problem, gtsam.IncrementalFixedLagSmoother(lag, params) if lag else gtsam.ISAM2(params), lag)
