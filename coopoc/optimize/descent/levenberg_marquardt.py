"""Levenberg-Marquardt by sparse Cholesky factors, or by quadratic programmes, with exact Hessians at the end."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Floats
from ...kernels.compiling.waiting import clock
from ...workers import progress_bar
from ..algebra.sparse import Sparse
from ..model.derivatives import Model

Step = Callable[[Floats, Floats, Floats], tuple[Floats, float] | None]
"""(x (n, ambient), the Hessian's values, gradient (m,)) -> dx (m,) and what bounds push along it, y . C dx; None where
the Hessian is not positive definite."""

LEAST_DAMPING = 1e-9
"""Damping below which none is left: far below any diagonal it changes no digit of a step."""
HIDDEN = 1e-9
"""Predicted decrease, as a share of the cost, below which rounding hides the actual one."""
MISMATCH = 0.2
"""Distance of the gain ratio, actual over predicted decrease, from 1 that is evidence against J^T J."""
NONQUADRATIC = 0.5
"""Distance of the gain ratio from 1 at which a step has left the region where the quadratic model holds."""
HESSIAN_AFTER_STEPS = 2
"""Steps of evidence against J^T J after which the exact Hessian takes over."""
GROWTH, DECAY = 10.0, 5.0
"""Factors by which damping grows after a refused step and falls after a good one; two that share no power find the
middle where a step overshoots."""
FIRST_DAMPING = 1e-8
"""Damping once some is needed, relative to the diagonal: the smooth modes of a chain of thousands of poses, which need
it first, have that share of a pose's information."""
ROUNDED_SHARE = 1e-18
"""Predicted decrease, as a share of the cost or of 1, that ends the loop: some 1e-8 standard deviations to go, before
the step that is taken."""
LEAST_INFORMATION = 1e-9
"""1/m^2 or 1/rad^2: the scale of what no measurement holds."""
HESSIAN_SHARE = 1e-3
"""Share of the cost from which on the exact Hessian makes the last steps."""
NEXT_STEP, NEXT_TOLERANCES = 1e-7, 10.0
"""m or rad, and tolerances, that Newton's next step may have if it shrinks as the last did: it shrinks by the square.
"""
HIDDEN_STEPS = 12
"""In a row, that end the loop: damping has fallen from FIRST_DAMPING to none, or the matrix is singular without."""
SLOW, SADDLE = 1e-2, 1e-4
"""Predicted decrease, as a share of the cost, up to which positions are solved anew where a step gains little, and that
of the last step up to which an exact Hessian that is not positive definite is damped: J^T J leads to the saddle."""


class Arrival(NamedTuple):
    """Result of Levenberg-Marquardt.

    Attributes:
        x: (n, ambient).
        iterations: factorisations.
        converged: the last step was below the tolerance, or its predicted decrease is rounding.
        record: (iterations, 3) the cost before each, its damping, and its gain ratio (NaN where the matrix was not
            positive definite).
    """

    x: Floats
    iterations: int
    converged: bool
    record: Floats


def arrive(
    system: Sparse,
    x: Floats,
    max_iterations: int,
    tolerance: float,
    step: Step | None = None,
    bounded: bool = False,
    smooth: bool = False,
) -> Arrival:
    """Minimise by Levenberg-Marquardt from x (n, ambient): (H + mu D) dx = -g, D the diagonal of J^T J, which scales by
    the geometry.

    H = J^T J, until two gain ratios were off by more than a fifth, or the end is near, by HESSIAN_SHARE; then the exact
    Hessian, with which the last steps converge quadratically however large the residuals are. Where that is not
    positive definite J^T J takes over for some steps, or, where these promise next to nothing, it is damped. mu is the
    multiplier of a trust region |D^1/2 dx|: it grows where the gain ratio is below 1/4 and falls where it is above 3/4.
    Where the steps are `bounded`, the last one is below the tolerance. A `smooth` descent ends with the first step
    whose gain ratio is not within 1/2 .. 3/2. An undamped step that raises the cost is taken with the next one where
    both lower it by what the first promised: far ends of a long drive turn too far to be moved by straight lines. Where
    only coordinates are measured, the positions of a step that gains little are solved anew for its rotations.

    References:
        More, The Levenberg-Marquardt algorithm, 1978; Nocedal and Wright, Numerical Optimization, section 10.3;
        Chamberlain et al., The watchdog technique, 1982.
    """
    mu, against, cholesky = 0.0, 0, system.cholesky

    step = step or (lambda _, values, gradient: (-cholesky.solve(gradient), 0.0) if cholesky.factor(values) else None)
    model: Model = "gauss-newton"
    steered = smooth or bounded
    flat = not steered and {"distance", "angle"}.isdisjoint(
        c for t in system.layout.terms for c in t.kind.measurement.components
    )
    record, most = list[tuple[float, float, float]](), FIRST_DAMPING if smooth else 1e12
    hold = LEAST_INFORMATION if bounded else 1.0  # what nothing measures stays where it is
    next_step = min(NEXT_STEP, NEXT_TOLERANCES * tolerance)
    converged, still, before, predicted = False, 0, 0.0, np.inf
    cost, gradient, values = system.quadratic(x, model)
    with progress("solve") as counted, np.errstate(over="ignore", invalid="ignore"):
        while len(record) < max_iterations and not converged and mu < most:  # beyond it no step can help
            counted(cost)
            if model == "gauss-newton":
                scale = values[system.entries.diagonal]
            damping = mu * np.maximum(scale, LEAST_INFORMATION) + (scale == 0.0) * hold
            whole = values.copy()
            whole[system.entries.diagonal] += damping
            taken = step(x, whole, gradient)
            if taken is None:
                record.append((cost, mu, np.nan))
                if model == "newton" and predicted > SADDLE * cost:
                    against, model = -HESSIAN_AFTER_STEPS, "gauss-newton"
                    cost, gradient, values = system.quadratic(x, model)
                else:
                    mu = _grown(mu)
                continue
            dx, push = taken
            predicted = 0.5 * float(damping @ (dx * dx) - gradient @ dx + push)
            there = system.retract(x, dx)
            near = predicted <= HESSIAN_SHARE * cost and against >= 0
            used: Model = "newton" if near else model
            trial = system.quadratic(there, used)
            if flat and HIDDEN * cost < predicted <= SLOW * cost and cost - trial[0] <= 0.75 * predicted:
                moved = system.settled(there, system.space.dimension)
                if (better := system.quadratic(moved, used))[0] < trial[0]:
                    there, trial = moved, better
            after = trial[0]
            length = float(abs(dx).max(initial=0.0))
            small = length <= tolerance
            hidden = predicted <= HIDDEN * cost and (after <= cost * (1.0 + 1e-13) or (small and bounded))
            gain = 1.0 if hidden else (cost - after) / abs(predicted)
            still = still + 1 if hidden else 0
            record.append((cost, mu, gain))
            swift = model == "newton" and not mu and abs(gain - 1.0) < MISMATCH and length**2 <= next_step * before
            converged = (hidden and small) or (
                not bounded and (swift or predicted <= ROUNDED_SHARE * max(cost, 1.0) or still > HIDDEN_STEPS)
            )
            before = length
            if not gain > 0.0:
                if not (mu or steered or model == "newton"):
                    there = system.settled(there, system.space.dof)
                    trial = system.quadratic(there, model)
                    if (kept := (cost - trial[0]) / predicted) > 1.0 - MISMATCH:
                        record.append((after, mu, kept))
                        x, (cost, gradient, values) = there, trial
                        continue
                mu = _grown(mu)
                continue
            x = there
            if gain > 0.75:
                mu = mu / DECAY if mu > LEAST_DAMPING else 0.0
            elif gain < 0.25:
                mu = _grown(mu)
            if smooth and abs(gain - 1.0) >= NONQUADRATIC:
                break
            if model == "gauss-newton":
                against = against + 1 if against < 0 or abs(gain - 1.0) > MISMATCH else max(against - 1, 0)
                against = HESSIAN_AFTER_STEPS if near else against
                model = "newton" if against >= HESSIAN_AFTER_STEPS else model
            if not converged:
                cost, gradient, values = trial if model == used else system.quadratic(x, model)
    return Arrival(x, len(record), bool(converged), np.array(record).reshape(-1, 3))


def _grown(mu: float) -> float:
    return GROWTH * mu if mu > 0.0 else FIRST_DAMPING


DELAY = 2.0
"""s before the bar is shown: most solves are over by then, and a bar takes longer to make than a small one."""


@contextmanager
def progress(name: str) -> Iterator[Callable[[float], None]]:
    """A function that counts a step and takes its cost.

    >>> with progress("solve") as step:
    ...     step(1.5)
    """
    began, count, bars = clock(), 0, list[Any]()

    def step(cost: float) -> None:
        nonlocal count
        count += 1
        if not bars and clock() - began > DELAY:
            bars.append(progress_bar(desc=name, unit=" steps", initial=count - 1))
        for bar in bars:
            bar.set_postfix_str(f"cost {cost:.6g}", refresh=False)
            bar.update()

    try:
        yield step
    finally:
        for bar in bars:
            bar.close()
