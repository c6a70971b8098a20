"""Innovation gating: a redescending weight of the normalised innovation squared, release after lock-out, and return to
an earlier position; votes on a start.

A counter sums the gains that rejected measurements would have had; above PATIENCE gating is suspended. These
measurements then hold, together, more information than the prediction that contradicts them. A filter with a small
covariance rejects for long, one that has just begun does not.

A rejected fix does not show whether the receiver or the filter is wrong. So the filter keeps the position from before
the first fix that contradicted it, moved by the odometer alone. Once fixes agree with that position again, and no
longer with the estimate, the filter returns to it.

A start is one number: until a few fixes have agreed with it, it is left where more of them agree with
one another.

A number, or LANES runs side by side. Filters call it where a measurement becomes information; blocks of the
cooperative filter (`stars.gaussian.weight`) have a shape of their own.
"""

import math

from .compiling.compile import inside
from .compiling.small import (
    add,
    add_diagonal,
    apply,
    choose_each,
    from_upper,
    inner_product,
    inverse,
    normalised_square,
    scale,
    subtract,
    trace,
)
from .compiling.vectors import Lanes, choose

GATE, FIX_GATE = 9.0, 12.0
"""Squared normalised innovation of a number, and of a position, from which it weighs less."""
HARD_REJECT_FACTOR = 2.0
"""Multiple of the gate beyond which a measurement weighs nothing."""
PATIENCE = 5.0
"""Sum of the gains of rejected measurements above which gating is suspended."""
LEAK = 0.5
"""Share of its gain by which a measurement within the gate lowers that sum: a wrong filter does not reject every
one."""
INITIAL_LOCKOUT = 4.8
"""That sum at the start of a pose or of a relative vector: a wrong heading or a wrong first measurement may have placed
it, so the next ones that contradict it are believed. Of a position it is 0, since fixes err together."""
SLIP_M2 = 0.25
"""m^2, the most that slipping wheels, or a speed that was measured too low, add to the variance of an error on each
axis: a smaller innovation is no sign of a wrong fix, however precise fixes are."""
AWAY = 0.5
"""Sum of the gains of accepted fixes from which they, and not the remembered position, have placed the filter: that
position is then forgotten if it is less far away than it is uncertain."""
FIXES_TO_RETURN = 2.0
"""Rejected fixes that it takes to go back: least excess of the filter's squared normalised innovations, each at most
that of a fix that is just rejected, over those of the remembered position."""
NOT_REMEMBERED_M2 = 1e30
"""m^2, variance of a position that is not remembered."""
FORGET, KEEP, BEGIN, BACK, ANEW = -1.0, 0.0, 1.0, 2.0, 3.0
"""What `remember` returns, and that a start is left."""
CONFIRMED = 5.0
"""Fixes that agree with a start, itself included, from which the start counts as right."""
MOST = HARD_REJECT_FACTOR * FIX_GATE
"""Squared normalised distance of two fixes, up to which they agree."""
NO_FIX_M2 = 1e15
"""m^2, variance of no fix."""
Vector = tuple[float, ...]


@inside
def inflation(q: float, gate: float, hits: float) -> Lanes:
    """S' / S: 1 within the gate, q / gate beyond, infinite from HARD_REJECT_FACTOR gates on; 1 again from PATIENCE hits
    on.

    So the influence of an innovation falls as 1 / sqrt(q), and ends.
    """
    share = choose(q - HARD_REJECT_FACTOR * gate, math.inf, max(q / gate, 1.0))
    return choose(PATIENCE - hits, share, 1.0)


@inside
def count(q: float, gate: float, hits: float, gain: float) -> Lanes:
    """Next value of the lock-out counter: the gains of measurements beyond the gate, less LEAK of those within."""
    return choose(q - gate, hits + gain, max(hits - LEAK * gain, 0.0))


@inside
def remember(
    q: float, other: float, gate: float, gain: float, apart: float, spread: float, evidence: float, since: float
) -> Vector:
    """What becomes of the position that is remembered, and the next `evidence` and `since`.

    Args:
        q: squared normalised innovation of a fix; of none 0, and so the next two.
        other: the same at the position that is remembered.
        gate: of a fix.
        gain: that the fix would have had.
        apart: m^2, squared distance of the two positions.
        spread: m^2, trace of the covariance of the one that is remembered, NOT_REMEMBERED_M2 at least if none is.
        evidence: for it.
        since: sum of the gains of fixes since the last beyond the gate.
    """
    none, most = 0.0 * q, HARD_REJECT_FACTOR * gate
    since = choose(q - gate, none, since + gain)
    evidence = choose(other - gate, none, max(evidence + choose(q - most, most + none, q) - other, none))
    vague = spread - apart
    back = choose(vague, KEEP + none, choose(evidence - FIXES_TO_RETURN * most, BACK + none, KEEP + none))
    what = choose(vague, choose(since - AWAY, FORGET + none, back), back)
    begin = choose(q - gate, spread - 0.5 * NOT_REMEMBERED_M2, none)
    evidence = choose(begin, none, evidence)
    return choose(begin, BEGIN + none, choose(q - gate, back, what)), evidence, since


@inside
def vote(votes: Vector, moved: Vector, process: Vector, fix: Vector, variance: Vector) -> tuple[Vector, float]:
    """The next votes on a start, and above 0 where more fixes agree on another position: a filter begins anew at the
    newest. What else the filter knows, as neighbours, does not count: they stand beside a start that may be wrong.

    Args:
        votes: start m, the other position less that m, variance of either m^2, and fixes that agree with each.
        moved: m, by odometry.
        process: m^2, variance of that.
        fix: m, NaN for none.
        variance: m^2, NO_FIX_M2 at least for none.
    """
    at, apart, ours, theirs = add(votes[:3], moved), votes[3:6], votes[7], votes[8]
    spread = votes[6] + (process[0] + process[1] + process[2]) / 3.0
    o, gap = 0.0 * spread, subtract(fix, at)
    q, other = apart_by(gap, variance, spread), apart_by(subtract(gap, apart), variance, spread)
    has_fix = choose(NO_FIX_M2 - variance[0], o + 1.0, o)
    agrees, far = choose(MOST - q, has_fix, o), choose(q - MOST, has_fix, o)
    begins = choose(0.5 - ours, agrees + far, o)
    new = choose(other - MOST, far, o)
    ours, theirs = ours + choose(begins, o + 1.0, agrees), choose(begins, o, choose(new, o + 1.0, theirs + far))
    left = choose(CONFIRMED - votes[7], theirs - ours, o)
    left = choose(begins, o, choose(far, left, o))
    anew = choose(begins, begins, left)
    apart = choose_each(left, subtract(at, fix), choose_each(new, gap, apart))
    ours, theirs = choose(left, theirs, ours), choose(left, ours, theirs)
    return (*choose_each(anew, fix, at), *apart, choose(anew, o, spread), ours, theirs), left


@inside
def apart_by(gap: Vector, variance: Vector, spread: float) -> float:
    """Squared normalised distance of two fixes, one of them moved."""
    s = spread + SLIP_M2
    return normalised_square(gap, add(scale(variance, 2.0), (s, s, s)))  # type: ignore[no-any-return]


@inside
def gain_of(cov: Vector, variance: Vector) -> float:
    """Gain of a position, the mean over the axes: tr P / (tr P + tr R)."""
    own = trace(cov)
    return own / (own + (variance[0] + variance[1] + variance[2]))  # type: ignore[no-any-return]


@inside
def distance(innovation: Vector, cov: Vector) -> Lanes:
    """Squared normalised innovation of a position."""
    return inner_product(innovation, apply(inverse(add_diagonal(cov, (SLIP_M2, SLIP_M2, SLIP_M2))), innovation))


@inside
def gate_fix(gap: Vector, cov: Vector, variance: Vector, gate: float, hits: float) -> tuple[float, float]:
    """Factor of the variance of a fix that is `gap` m away from a position of covariance `cov`, and the next hits."""
    q = distance(gap, add_diagonal(cov, variance))
    return inflation(q, gate, hits), count(q, gate, hits, gain_of(cov, variance))


@inside
def gated_update(
    cov: Vector, moved: Vector, h: Vector, innovation: float, variance: float, hits: float
) -> tuple[Vector, Vector, float, float]:
    """Kalman update of a vector's covariance and shift by one gated number, innovation = h v + noise.

    Returns:
        Covariance, shift, the factor of the noise's variance by which S is inflated, and hits.
    """
    g = apply(cov, h)
    s, left = inner_product(h, g) + variance, innovation - inner_product(h, moved)
    q = left * left / s
    f = inflation(q, GATE, hits)
    factor = choose(q - GATE, 1.0 + (f - 1.0) * s / variance, 1.0)
    gain = scale(g, 1.0 / (s * f))
    a, b, c = gain
    less = from_upper((a * g[0], a * g[1], a * g[2], b * g[1], b * g[2], c * g[2]))
    return subtract(cov, less), add(moved, scale(gain, left)), factor, count(q, GATE, hits, 1.0 - variance / s)
