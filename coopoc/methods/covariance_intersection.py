"""CovarianceIntersection: each neighbour's solo estimate, seen from the ego, fused without assuming independence."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Bools, Floats
from ..errors import InputError
from ..kernels.compile import use_kernels
from ..world.inbox import Inbox
from ..world.recording import Recording
from ..world.spherical import spherical, to_vector
from ..world.v2x import ESTIMATE_AND_COV, Message
from .egos import Estimate, follow_egos
from .intersection import Belief, Criterion, intersect
from .kalman import solo_filter
from .knowledge import Knowledge, resolve
from .star import ACCELERATION_STD, measured_arrays, sighting_noise
from .track import Track


@dataclass(frozen=True, eq=False)
class CovarianceIntersection:
    """Filter of the ego that fuses pseudo-fixes y_j = p_j - rho(r_ij), C_j = P_j + J C_r J^T, by (split) CI.

    A neighbour sends p_j, P_j of its *solo* filter, which is consistent by itself; a recursive scheme in which
    neighbours cooperate too would need everyone's links. The errors of p_j at different steps are correlated, and so
    is the ego's error with all that it has fused: CI and split CI need not know how much. Three errors are
    independent of these and enter as such: the ego's own fix in both forms and, in split CI alone, the ego's motion
    and each relative measurement, so that only P_j is discounted. Neighbours' solo errors are taken as independent of
    each other, which a GNSS error common to all would break. Because a used message may be used again, the newest one
    serves, brought forward with its velocity, until it is too old (methods.md section 5.3).

    CI gains little where a neighbour knows the ego worse than the ego does: w is then 1.

    Args:
        knowledge: "identity", "nominal" or a Knowledge. split: False for plain CI. criterion: of the weight.

    >>> CovarianceIntersection().message.payload
    56
    """

    knowledge: Knowledge | str = "nominal"
    split: bool = False
    criterion: Criterion = "trace"
    name: str = "ci"
    cooperative: bool = True
    message: Message = ESTIMATE_AND_COV

    def __post_init__(self) -> None:
        if self.criterion not in ("trace", "det"):
            raise InputError("criterion", repr(self.criterion), "must be 'trace' or 'det'", "Pick one.")

    def __call__(self, recording: Recording, egos: Sequence[int | str] = (0,)) -> Track:
        """Track of the egos and of what their neighbours say of themselves; InputError if one is unknown or absent."""
        known = resolve(self.knowledge, recording)
        if use_kernels():
            return follow_egos(self, recording, egos, self._compiled(recording, recording.columns(egos), known))
        variance = known.process_variance(recording)
        solo = solo_filter(recording.gnss, recording.velocity, variance, known.gnss_variance, recording.dt)
        said = Said(recording, known, *solo, np.broadcast_to(variance, recording.gnss.shape))
        return follow_egos(self, recording, egos, lambda ego, box: self._follow(said, ego, box))

    def _compiled(
        self, recording: Recording, egos: Sequence[int], known: Knowledge
    ) -> Callable[[int, Inbox], Iterator[Estimate]]:
        """What `_follow` yields, as one estimate of all steps from compiled code, for those in the stars only."""
        from ..kernels.intersection import follow

        links = recording.links
        who = np.union1d(egos, links.neighbour[np.isin(links.observer, egos)])
        variance, fix_variance = known.process_variance(recording, who.tolist()), known.gnss_variance
        gnss, velocity = recording.gnss[:, :, who], recording.velocity[:, :, who]
        solo = solo_filter(gnss, velocity, variance, fix_variance, recording.dt)
        assumed = (np.ascontiguousarray(variance), *sighting_noise(known))
        choice = (ACCELERATION_STD, self.split, self.criterion == "det")

        def drive(ego: int, box: Inbox) -> Iterator[Estimate]:
            _, _, seen, neighbour, *heard, _, dt = measured_arrays(recording, ego, box)
            who_is_who = np.searchsorted(who, neighbour), *heard, int(np.searchsorted(who, ego))
            x, cov, theirs = follow((gnss, velocity, seen, *who_is_who, dt), assumed, solo, fix_variance, *choice)
            yield Estimate(slice(None), x, cov, box.link, theirs)

        return drive

    def _follow(self, said: Said, ego: int, box: Inbox) -> Iterator[Estimate]:
        recording, fix_cov = said.recording, np.diag(said.known.gnss_variance)
        nothing = np.zeros((recording.runs, 3, 3))
        belief = Belief(recording.gnss[:, 0, ego], nothing, nothing + fix_cov)
        for t in range(len(recording.t)):
            if t:
                noise = said.process[:, t, ego, :, None] * np.eye(3)
                x = belief.x + recording.dt * recording.velocity[:, t, ego]
                belief = Belief(x, belief.dependent, belief.independent + noise)
            theirs, others, held = said.pseudo_fixes(box, t, belief.x)
            if not self.split:
                belief, others = _all_dependent(belief), _all_dependent(others)
            fix = Belief(recording.gnss[:, t, ego], nothing, nothing + fix_cov)
            together = Belief(*(np.concatenate([a[:, None], b], axis=1) for a, b in zip(fix, others, strict=True)))
            used = np.concatenate([np.full((recording.runs, 1), t > 0), held], axis=1)
            belief, _ = intersect(belief, together, used, self.criterion)
            links = box.link[box.start[t] : box.start[t + 1]]
            yield Estimate(t, belief.x, belief.dependent + belief.independent, links, theirs)


@dataclass(frozen=True, eq=False)
class Said:
    """What all vehicles would say of themselves: solo x, p and process noise (R, T, N, 3), m, m^2 and m^2."""

    recording: Recording
    known: Knowledge
    x: Floats
    p: Floats
    process: Floats

    def pseudo_fixes(self, box: Inbox, t: int, prior: Floats) -> tuple[Floats, Belief, Bools]:
        """What the neighbours say of themselves (R, k, 3), NaN where unheard, hence of the ego, and who is heard.

        `age` steps later the velocity's error has come in age + 1 times, once in p_j itself and fully correlated:
        (age (age + 2)) of its variances at most. Relative noise is rotated to where the ego believes the neighbour
        to be: at the measured angles the weight would depend on the noise.
        """
        recording, span = self.recording, slice(box.start[t], box.start[t + 1])
        links, held = box.link[span], box.newest[:, span] >= 0
        runs, who = np.arange(recording.runs)[:, None], recording.links.neighbour[links]
        sent = np.where(held, box.newest[:, span], t)
        age = (t - sent)[..., None]
        theirs = self.x[runs, sent, who] + age * recording.dt * recording.velocity[runs, sent, who]
        one_step = self.process[runs, sent, who] + (recording.dt**2 * age * ACCELERATION_STD) ** 2
        spread = self.p[runs, sent, who] + age * (age + 2) * one_step
        seen = np.stack(spherical(*np.moveaxis(theirs - prior[:, None], -1, 0)), axis=-1)
        fixes = theirs - to_vector(recording.relative[:, links])
        others = Belief(fixes, spread[..., None] * np.eye(3), np.array(self.known.relative_cov(seen)))
        return np.where(held[..., None], theirs, np.nan), others, held


def _all_dependent(belief: Belief) -> Belief:
    """The same belief, its independence forgotten."""
    return Belief(belief.x, belief.dependent + belief.independent, np.zeros_like(belief.independent))
