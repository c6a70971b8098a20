"""Backend: the protocol of a solver, what it can solve as data, and the backends by name."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.util import find_spec
from typing import Any, Literal

from ..arrays import TINY, Floats, instance, number, whole
from ..errors import InputError, MissingLibraryError, dependencies, suggestion, unknown
from ..plugins import find, names
from .model.problem import Problem

Options = dict[str, Any]
MAX_ITERATIONS = 500
"""About 6 are needed with angles, some 50 for range-only problems of flat geometry."""
SOLVER_STEP_TOLERANCE = 1e-8
"""m or rad, largest move of a node in the last step."""


@dataclass(frozen=True, eq=False)
class SolverResult:
    """Result of a solver, which `solve` verifies.

    Args:
        x: (n, ambient) nodes, see Space.
        iterations: how many it took.
        infeasible: True if the solver found that no point satisfies the constraints.
        extras: numbers of its own, for `Solution.extras`.
    """

    x: Floats
    iterations: int
    infeasible: bool = False
    extras: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Capabilities:
    """Which problems a backend can solve, as data: `solve` and its errors read it.

    Args:
        kinds: of measurement; None: all that are registered, those of other distributions too.
        losses: robust losses; None: all.
        constraints: "none", "linear" (on kinds whose formula is linear) or "all".
    """

    kinds: tuple[str, ...] | None = None
    losses: tuple[str, ...] | None = None
    constraints: Literal["none", "linear", "all"] = "none"

    def lacking(self, problem: Problem) -> list[str]:
        """The needs of the problem that these capabilities lack, in words; empty if the problem can be solved.

        >>> problem = Problem(("a",)).add("position", "a", [0, 0, 0], std=1.0).constrain("position", "a", lower=0.0)
        >>> Capabilities().lacking(problem), Capabilities(constraints="linear").lacking(problem)
        (['a constraint on position'], [])
        """
        kinds, losses = set(), set()
        if self.kinds is not None:
            kinds = {f.kind for f in problem.factors} - {*self.kinds}
        if self.losses is not None:
            losses = {f.loss.name for f in problem.factors if f.loss is not None} - {*self.losses}
        held = {"none": (), "linear": (True,), "all": (True, False)}[self.constraints]
        barred = [c for c in problem.constraints if c.measurement.linear not in held]
        return [
            *(f"kind {kind}" for kind in sorted(kinds)),
            *(f"loss {loss}" for loss in sorted(losses)),
            *(f"a constraint on {kind}" for kind in sorted({c.kind for c in barred})),
        ]


@dataclass(frozen=True)
class Backend:
    """A solver by name, and what it can solve.

    Args:
        name: as in `solve(problem, name)`.
        solver: `solver(problem, start (n, ambient), **options)` returns its result.
        library: that it imports, None if it needs none but those of coopoc.
        capabilities: which problems it can solve.
    """

    name: str
    solver: Callable[..., SolverResult]
    library: str | None = None
    capabilities: Capabilities = Capabilities()

    @property
    def installed(self) -> bool:
        """True if its library is there."""
        return self.library is None or find_spec(self.library) is not None

    def check(self, problem: Problem, options: Options) -> None:
        """InputError for an unknown option, or a problem beyond the capabilities; it names the backends that can."""
        for name in options:
            allowed = list(inspect.signature(self.solver).parameters)[2:]
            if name not in allowed:
                hint = suggestion(name, allowed, "Leave it out.")
                raise InputError(name, options[name], f"is no option of {self.name}, which has {allowed}", hint)
        if "max_iterations" in options:
            whole("max_iterations", options["max_iterations"], hint="Leave it out for 500.")
        if "tolerance" in options:
            hint = "Leave it out for 1e-8."
            number("tolerance", options["tolerance"], TINY, allowed="a number > 0 (m)", hint=hint)
        if lacking := self.capabilities.lacking(problem):
            able = [b.name for b in backends().values() if not b.capabilities.lacking(problem)]
            allowed_ = f"cannot be solved by {self.name}, only by {able}" if able else "cannot be solved by any backend"
            raise InputError("problem", f"with {', '.join(lacking)}", allowed_, "Name one that can, or change it.")

    def run(self, problem: Problem, start: Floats, options: Options) -> SolverResult:
        """The solver's result; the start where nothing can move."""
        return self.solver(problem, start, **options) if problem.movable.any() else SolverResult(start, 0)


def backends() -> dict[str, Backend]:
    """The backends by name, those of other distributions too: the entry points of group "coopoc.backends".

    >>> backends()["gauss-newton"].installed
    True
    """
    return {name: _registered(name) for name in names("coopoc.backends")}


def require_backend(backend: str | Backend) -> Backend:
    """The backend of a name, or of "folder/mine.py:BACKEND"; a Backend itself is returned.

    Raises:
        InputError: no such backend (lists the names and the nearest), or the object is no Backend.
        MissingLibraryError: its library is not installed; carries the line that installs it.
    """
    if isinstance(backend, str):
        backend = (_registered.__wrapped__ if ".py" in backend else _registered)(backend)  # a file may change
    elif not isinstance(backend, Backend):
        raise unknown("backend", backend, backends())
    if not backend.installed:
        library = str(backend.library)
        raise MissingLibraryError(library, f"backend {backend.name!r}", dependencies().get(library, library))
    return backend


@lru_cache(maxsize=64)
def _registered(name: str) -> Backend:
    """The backend of a name; kept, since reading the entry points takes longer than a small solve."""
    return instance(f"backend {name!r}", find("coopoc.backends", name), Backend, "Give coopoc.Backend(name, solver).")
