"""FixedLag: a problem that grows piece by piece and forgets what is older than its lag, by GTSAM's ISAM2."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np

from ..arrays import Floats, Ints, instance, listed, named, number
from ..errors import InputError
from ..plugins import suggestion
from ..short_repr import short_repr
from .algebra.sparse import sparse
from .backend import require_backend
from .backends.gtsam_factors import estimate, forms, graph_of, linearised, tangent, values, which_turn
from .descent.levenberg_marquardt import TOLERANCE, arrive
from .model.factor import Factor
from .model.problem import Problem
from .model.space import Space
from .starts.initial import initial_guess


@dataclass(frozen=True, eq=False)
class Estimates:
    """Some nodes at one moment, each as a Solution has it.

    Args:
        names: of n nodes.
        x: (n, ambient), see Space.
        covariance: (n, dof, dof) m^2, rad^2 marginals.
    """

    names: tuple[str, ...]
    x: Floats
    covariance: Floats

    __repr__ = short_repr


class FixedLag:
    """The most probable nodes of the last `lag` seconds, given all that was ever measured.

    `update` adds a piece of the problem: new nodes, and factors among them and those of the window. What GTSAM has with
    exactly our objective (see backends/gtsam_factors.py) it linearises afresh where a node has moved by more than
    `threshold`. All else, such as range and angles in the world frame, is linearised once, robust weights included, at
    the most probable geometry given the piece and the marginals of the nodes before it: after the converted
    measurement, which makes a poor prior harmless, one exact step. Nodes that fall out of
    the lag are marginalised (Kaess et al., iSAM2, IJRR 2012; gtsam.IncrementalFixedLagSmoother); an infinite lag
    forgets nothing.

    Args:
        lag: s; a node whose stamp is older than the newest one minus the lag leaves. Of steps of dt take (k + 1/2) dt,
            so that rounding does not decide.
        threshold: m or rad, a move that asks for a fresh linearisation; where all is linear take infinity, which saves
            the search for them.
        passes: Gauss-Newton steps per update; more only matter for GTSAM's own nonlinear factors.

    Raises:
        InputError: lag < 0, threshold <= 0, passes < 1. MissingLibraryError: no gtsam.

    >>> smoother = FixedLag(lag=1.0)
    >>> piece = Problem(("v0@0", "v0@1")).add("position", "v0@0", [0, 0, 0], std=1.0)
    >>> piece = piece.add("displacement", ("v0@0", "v0@1"), [5, 0, 0], std=1.0)
    >>> smoother.update(piece, {"v0@0": 0.0, "v0@1": 0.5}).x.round(6).tolist()
    [[5.0, 0.0, 0.0]]
    """

    def __init__(self, lag: float, threshold: float = 0.01, passes: int = 1) -> None:
        hint = "Such as FixedLag(lag=1.0)."
        lag = number("lag", lag, 0.0, np.inf, allowed=">= 0 s", hint=hint)
        threshold = number("threshold", threshold, 1e-300, np.inf, allowed="> 0 m or rad", hint=hint)
        passes = number("passes", passes, 1, 10**6, kind=int, allowed=">= 1", hint=hint)
        require_backend("gtsam")
        import gtsam

        params = gtsam.ISAM2Params()
        params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
        params.setRelinearizeThreshold(threshold)
        params.relinearizeSkip = 1
        params.enableRelinearization = bool(np.isfinite(threshold))
        self.lag, self.passes = lag, passes
        self.stamps: dict[str, float] = {}
        """Moment of each node of the window, s."""
        self._smoother: Any = gtsam.IncrementalFixedLagSmoother(lag, params)
        self._nodes: dict[str, tuple[int, bool]] = {}
        self._dimension = 3
        self._count = count()

    def update(self, piece: Problem, stamps: Mapping[str, float], wanted: Sequence[str] | None = None) -> Estimates:
        """The nodes `wanted` after a piece was added.

        Args:
            piece: a single problem; a name that the window has is its node, any other is a new one. Poses need an x0;
                that of nodes of the window is not looked at. separator is not looked at.
            stamps: s, moment of each new node. One of a node of the window moves it there: a landmark that is seen
                again stays.
            wanted: names of the window, default those that have the newest stamp.

        Raises:
            InputError: a piece with realisations, fixed nodes or constraints, a new node without a stamp or
                older than the window, a node that changes its kind, nodes that the measurements leave free.
        """
        instance("piece", piece, Problem)
        given = named("stamps", stamps, 'Give a moment of each new node, as {"v0@0": 0.0}.')
        stamps = {name: number("stamps", at, -np.inf, np.inf, allowed="seconds") for name, at in given.items()}
        posed = which_turn(piece)
        self._check(piece, stamps, posed)
        parts = forms(piece)
        rest = [f for f, form in enumerate(parts) if isinstance(form, str)]
        x, new = self._geometry(piece, rest), [k for k, name in enumerate(piece.names) if name not in self.stamps]
        self._dimension = piece.dimension
        for k in new:
            self._nodes[piece.names[k]] = next(self._count), posed[k]
        keys = [self._nodes[name][0] for name in piece.names]
        graph = graph_of(piece, parts, keys)
        for factor in linearised(piece, rest, x, keys) if rest else ():
            graph.add(factor)
        entering = values(piece.space, [posed[k] for k in new], x[new], [keys[k] for k in new])
        try:
            self._smoother.update(graph, entering, {self._nodes[name][0]: at for name, at in stamps.items()})
            for _ in range(self.passes - 1):
                self._smoother.update()
        except RuntimeError as singular:
            hint = "Add a position factor, or more measurements. The smoother cannot be used any more."
            raise InputError("piece", str(singular)[:60], "must leave no node free", hint) from singular
        self.stamps |= stamps
        last = max(self.stamps.values()) - self.lag
        for name in [name for name, at in self.stamps.items() if at < last]:
            del self.stamps[name], self._nodes[name]
        return self.estimate(wanted)

    def estimate(self, wanted: Sequence[str] | None = None) -> Estimates:
        """The nodes `wanted` of the window, by name; default those that have the newest stamp."""
        if wanted is None:
            newest = max(self.stamps.values())
            wanted = [name for name, at in self.stamps.items() if at == newest]
        names = tuple(listed("wanted", wanted, "Give a list of names."))
        for name in names:
            if not isinstance(name, str) or name not in self.stamps:
                hint = suggestion(name, self.stamps, "See stamps.")
                raise InputError("wanted", repr(name), f"must be in the window of {len(self.stamps)}", hint)
        return self._read(names, Space(self._dimension, any(self._nodes[name][1] for name in names)))

    def _read(self, names: tuple[str, ...], space: Space) -> Estimates:
        keys, posed = zip(*(self._nodes[name] for name in names), strict=True) if names else ((), ())
        x = estimate(space, posed, self._smoother.calculateEstimate(list(keys)), keys)
        turn = tangent(space, posed, x)
        cov = [T @ self._smoother.marginalCovariance(key) @ T.T for T, key in zip(turn, keys, strict=True)]
        return Estimates(names, x, np.array(cov).reshape(len(x), space.dof, space.dof))

    def _check(self, piece: Problem, stamps: Mapping[str, float], posed: Sequence[bool]) -> None:
        """InputError as `update`."""
        for field, given in (("batch", piece.batch), ("fixed", piece.fixed), ("constraints", piece.constraints)):
            if given:
                hint = "Pick one realisation; hold a node with a position or pose factor of small std."
                raise InputError("piece", f"with {field} {given}", f"must have no {field}", hint)
        if self.stamps and self._dimension != piece.dimension:
            hint = "Use one smoother per dimension."
            raise InputError("piece", f"of dimension {piece.dimension}", "must have that of the others", hint)
        inside, newest = {*piece.names, *self.stamps}, max([*self.stamps.values(), *stamps.values()], default=0.0)
        for name, at in stamps.items():
            if name not in inside or not newest - self.lag <= at < np.inf:
                hint = "Stamp the nodes of the piece, in seconds, none earlier than the newest minus the lag."
                raise InputError("stamps", f"{name!r}: {at}", "must be moments of nodes within the lag", hint)
        for name, turns in zip(piece.names, posed, strict=True):
            if name not in self.stamps and name not in stamps:
                hint = "Give a new node its moment; a node that has left the window cannot be measured any more."
                raise InputError("stamps", f"none of {name!r}", "must have every new node", hint)
            if name in self.stamps and self._nodes[name][1] != turns:
                raise InputError("piece", repr(name), "must stay the point or pose that it was", "Name it in poses.")

    def _geometry(self, piece: Problem, rest: Sequence[int]) -> Floats:
        """(n, ambient) where the piece is linearised: its most probable nodes given the marginals of the window, by one
        Gauss-Newton step; where GTSAM has every factor its own start will do."""
        x0 = None if piece.x0 is None else np.array(piece.x0)
        if x0 is not None and not rest:
            return x0
        old = np.array([i for i, name in enumerate(piece.names) if name in self.stamps], dtype=np.int64)
        if len(old):
            was = self._read(tuple(piece.names[i] for i in old), piece.space)
            if x0 is not None:
                x0[old] = was.x
            piece = replace(piece, x0=x0, factors=(*piece.factors, *priors(piece, old, was)))
        x = initial_guess(piece)[0]
        return arrive(sparse(piece), x, 1, TOLERANCE).x if rest else x


def priors(piece: Problem, old: Ints, was: Estimates) -> list[Factor]:
    """Marginals of the window as prior factors on nodes of a piece, one by one."""
    space, d = piece.space, piece.dimension
    turns = np.isin(old, piece.poses)
    found = []
    if not turns.all():
        points = ~turns
        found.append(Factor("position", old[points, None], was.x[points, :d], cov=was.covariance[points, :d, :d]))
    if turns.any():
        body = np.broadcast_to(np.eye(space.dof), (int(turns.sum()), space.dof, space.dof)).copy()
        body[:, :d, :d] = space.rotation(was.x[turns])
        cov = np.swapaxes(body, -1, -2) @ was.covariance[turns] @ body
        found.append(Factor("pose", old[turns, None], was.x[turns], cov=cov))
    return found
