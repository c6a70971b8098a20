"""Solution: the estimate, its covariance and the status of the solve."""

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np

from ..arrays import Floats
from ..text import short_repr
from .model.problem import no_such_node
from .model.space import Space


class Status(Enum):
    """Outcome of a solve; the value is a sentence.

    >>> print(Status.SOLVED.value)
    At a minimum: one more step would move no point by over 1e-6 m, or lower the cost by less than 1e-10 of it.
    """

    SOLVED = (
        "At a minimum: one more step would move no point by over 1e-6 m, or lower the cost by less than 1e-10 of it."
    )
    MAX_ITERATIONS = "Stopped at the limit of iterations before a minimum: raise max_iterations or give a better x0."
    SADDLE = "At a stationary point that is no minimum: give an x0 to the side of it, where the cost falls."
    RANK_DEFICIENT = "Some points can move without changing the cost: measure them, or add a position factor."
    INFEASIBLE = "No point was found that satisfies the constraints: relax what extras['violated'] names, or move x0."
    FAILED = "The backend stopped before a minimum: give a better x0, or try another backend."


@dataclass(frozen=True, eq=False)
class Solution:
    """The answer of one backend, with all that can be checked recomputed by `solve`.

    Args:
        x: (n, ambient), see Space.
        covariance: (n, dof, dof) m^2, rad^2 marginals of (J^T J)^-1 at x, position in the world's directions, then
            rotation in the body's; equalities taken as exact, inequalities as absent; NaN if rank deficient or not
            asked for.
        cost: 1/2 sum of rho of the squared whitened residuals.
        gradient_norm: |J^T r| at x, with constraints that of the Lagrangian.
        status: how it ended.
        iterations: of the backend, and of the search for a start: extras["start_iterations"] of them.
        build_seconds: to prepare the solver and the start.
        solve_seconds: to run it, and of the search for a start: extras["start_seconds"] of them.
        check_seconds: to compute what is here from x.
        load_seconds: beside these, what this thread has waited for libraries and machine code until now.
        compile_seconds: beside these, what it has waited for kernels to compile, once per machine.
        backend: its name.
        names: of the nodes.
        shown: the node that `print` shows.
        space: of the problem.
        unobservable: names of the nodes that can move without changing the cost.
        violation: largest of a constraint, in its unit.
        expected: cost at the minimum under the noise that is stated, half of the numbers measured beyond the unknowns.
        notes: what the answer rests on that may be wrong: a cost that this noise does not explain, measurements that a
            robust loss rejects, a start from the truth, a backend that was chosen.
        extras: the backend's own numbers.
    """

    x: Floats
    covariance: Floats
    cost: float
    gradient_norm: float
    status: Status
    iterations: int
    build_seconds: float
    solve_seconds: float
    backend: str
    names: tuple[str, ...]
    shown: int = 0
    unobservable: tuple[str, ...] = ()
    space: Space = Space()
    violation: float = 0.0
    check_seconds: float = 0.0
    load_seconds: float = 0.0
    compile_seconds: float = 0.0
    expected: float = np.nan
    notes: tuple[str, ...] = ()
    extras: dict[str, Any] = field(default_factory=dict)

    __repr__ = short_repr

    @property
    def seconds(self) -> float:
        """What solving took: build, search for a start, solve and checks.

        >>> x = np.zeros((1, 3))
        >>> Solution(x, x[..., None], 0.0, 0.0, Status.SOLVED, 1, 0.5, 1.0, "mine", ("a",)).seconds
        1.5
        """
        return self.build_seconds + self.solve_seconds + self.check_seconds

    @property
    def position(self) -> Floats:
        """(n, d) m."""
        return self.space.position(self.x)

    @property
    def rotation(self) -> Floats:
        """(n, d, d) body to world, the identity for points."""
        return self.space.rotation(self.x)

    def __getitem__(self, point: str) -> Floats:
        """(ambient,) estimate of a node by name; InputError that lists the names if there is none."""
        if not isinstance(point, str) or point not in self.names:
            raise no_such_node(point, self.names, "See solution.names.")
        return np.asarray(self.x[self.names.index(point)])

    def __str__(self) -> str:
        at = ", ".join(f"{v:.2f}" for v in self.position[self.shown])
        variance = np.diag(self.covariance[self.shown])[: self.space.dimension]
        std = f" +- ({', '.join(f'{v:.2f}' for v in np.sqrt(variance))})" if np.isfinite(variance).all() else ""
        return (
            f"{self.status.name} in {self.iterations} iterations, {1e3 * self.seconds:.1f} ms; cost {self.cost:.4g} "
            f"(expected {self.expected:.4g}), gradient {self.gradient_norm:.0e}; {self.names[self.shown]} ({at}){std} m"
            + "".join(f"; {note}" for note in self.notes)
        )


class SolveError(RuntimeError):
    """A solve that did not reach a minimum; `solution` holds what there is."""

    def __init__(self, solution: Solution) -> None:
        self.solution = solution
        violated = f" Violated: {solution.extras['violated']}." if "violated" in solution.extras else ""
        super().__init__(f"{solution.backend}: {solution.status.value}{violated} ({solution})")

    def __reduce__(self) -> "tuple[type[SolveError], tuple[Solution]]":
        return type(self), (self.solution,)
