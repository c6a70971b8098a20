"""The cooperative filter with dense matrices and one number at a time, one run.

State: named vectors, ("x", j) position and ("b", j) error of fixes of vehicle j, ("o", j) error of its odometry,
("common",) and ("compass",). Numbers z = H x + noise beyond their gate have their innovations' covariance multiplied
by q / gate, of relative ones by 100 more beyond four times the gate, of fixes as `kernels.gate` says. What is vague has
a variance of FLAT m^2.
"""

import copy
from math import cos, exp, hypot, inf, log, pi, sin, sqrt
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy import array, broadcast_to, diag, eye, full, isfinite, isnan, nan, outer, trace, where, zeros
from numpy.linalg import norm, slogdet, solve

from coopoc.arrays import Floats
from coopoc.kernels.gate import (
    AWAY,
    CONFIRMED,
    FIX_GATE,
    FIXES_TO_RETURN,
    GATE,
    HARD_REJECT_FACTOR,
    LEAK,
    PATIENCE,
    SLIP_M2,
)
from coopoc.kernels.odometry_fault import DECISIVE
from coopoc.kernels.stars.cooperative_members import CHANGES, CONTRADICTED, WIDEST
from coopoc.kernels.stars.cooperative_messages import (
    CLIP,
    FADES,
    FAULTY_SHARE,
    FIX_SCORE,
    LEAST,
    PENALTY,
    REVOKE_LOG_ODDS,
    TRUST_LOG_ODDS,
    WINDOW,
)
from coopoc.kernels.stars.cooperative_state import ACCELERATION, ESTABLISHED, MAX_LOCKOUT, TAU, TURN_MEMORY_S, WILD
from coopoc.kernels.stars.otherwise import (
    AGREEING,
    KNOWN,
    LEFT_OPEN,
    MAX_LEVEL,
    MAX_LEVEL_CHANGE,
    MIN_LEVEL,
    PRIOR,
    SIDEWAYS,
    SLIP_DURATION_S,
    SLIP_HIDDEN_S,
    SLIP_INTERVAL_S,
    SPEED_MEMORY_S,
    SUDDEN,
    TURNS,
    UNTRUSTED,
    USUAL_SQUARE,
)
from coopoc.methods.odometry_fault import with_odometry
from coopoc.world.inbox import inbox
from coopoc.world.links import spherical, to_vector, wrap
from coopoc.world.v2x import FIX_AND_VELOCITY
from oracles.pace import heard

FLAT = 1e6
PAIR_TIME = 60.0
Name = tuple[Any, ...]


class Belief:
    """A Gaussian of named vectors."""

    def __init__(self):
        self.names: list[Name] = []
        self.x, self.p = zeros(0), zeros((0, 0))

    def at(self, *name):
        k = self.names.index(name)
        return slice(3 * k, 3 * k + 3)

    def add(self, name, mean, variance):
        n = len(self.x)
        p = zeros((n + 3, n + 3))
        p[:n, :n], p[n:, n:] = self.p, diag(broadcast_to(variance, 3))
        self.names.append(name)
        self.x, self.p = np.append(self.x, broadcast_to(mean, 3)), p

    def transform(self, name, terms):
        """The vector becomes a sum of others."""
        f = eye(len(self.x))
        f[self.at(*name)] = 0
        for other, factor in terms.items():
            f[self.at(*name), self.at(*other)] = factor * eye(3)
        self.x, self.p = f @ self.x, f @ self.p @ f.T

    def drop(self, name):
        if name in self.names:
            keep = np.ones(len(self.x), bool)
            keep[self.at(*name)] = False
            self.names.remove(name)
            self.x, self.p = self.x[keep], self.p[np.ix_(keep, keep)]

    def noise(self, name, variance):
        at = self.at(*name)
        self.p[at, at] += diag(broadcast_to(variance, 3))

    def row(self, terms, axis):
        """h of one number: a vector's factor is one for its axis, or three for its numbers."""
        h = zeros(len(self.x))
        for name, factor in terms.items():
            if np.ndim(factor):
                h[self.at(*name)] = np.atleast_2d(factor)[axis if np.ndim(factor) == 2 else 0]
            else:
                h[self.at(*name).start + axis] = factor
        return h

    def update(self, h, z, r, gate=0.0):
        """One number; its squared normalised innovation."""
        return self.updates(h[None], array([z]), array([r]), gate)

    def updates(self, h, z, r, gate=0.0, share=1.0):
        """Several numbers with one gate, or a share of their information; their squared Mahalanobis distance."""
        gap, s = z - h @ self.x, h @ self.p @ h.T + diag(r)
        q = float(gap @ solve(s, gap))
        if gate and q > gate:
            s = s * (q / gate * (100.0 if q > 4 * gate else 1.0))
        s = s / share
        gain = solve(s, h @ self.p).T
        self.x, self.p = self.x + gain @ gap, self.p - gain @ s @ gain.T
        return q

    def average(self, which, prior, odds):
        """All of these numbers are 0, or N(0, prior)."""
        some = [i for i in which if self.p[i, i] > 0]
        if not some or odds == -inf:
            return
        p, m = self.p[np.ix_(some, some)], self.x[some]
        prior = broadcast_to(prior, len(which))[[i in some for i in which]]
        odds += 0.5 * (np.log(prior).sum() - slogdet(p)[1] - m @ solve(p, m))
        none, k = 1 / (1 + exp(min(-odds, 700))), solve(p, self.p[some]).T
        self.x, self.p = self.x - none * k @ m, self.p - none * k @ (p - (1 - none) * outer(m, m)) @ k.T


class Sent(NamedTuple):
    """A message: step, mean of fixes, its weight, odometer, velocity, variance of one step's motion; (3,) each."""

    step: int
    mean: Floats
    weight: Floats
    odometer: Floats
    velocity: Floats
    process: Floats


class Life(NamedTuple):
    """Parameters of lasting errors: own and common m^2, their correlation of a step, compass bias and noise rad^2,
    offset of ranges m^2, their scale and the offset m^2 of those of a pair, heading and scale of odometry and offset of
    a clock, their correlation of a step, log odds that there is none."""

    own: float
    common: float
    keep: float
    bias: float
    heading: float
    offset: float
    ranged: Floats
    turn: Floats
    holds: float
    absent: Floats


def fresh(gnss, moved, variance):
    """Fixes (T, N, 3) but those that repeat the last one of their receiver, whose vehicle has moved."""
    new, last = gnss.copy(), full(gnss.shape[1:], nan)
    moves = np.square(moved).sum(-1) > 0.01 * variance[..., 0]
    for now, fix, goes in zip(new, gnss, moves, strict=True):
        now[goes & (fix == last).all(1)] = nan
        last = where(isfinite(fix), fix, last)
    return new


class Oracle:
    """The filter of one ego in one run."""

    def __init__(self, seen, ego, run, known, priors):
        s, measured, self.more = known.sensors, seen.velocity, zeros(len(seen.t))
        if priors.fix_gate:  # `test_odometry_fault` has what refers to that
            seen, fault = with_odometry(seen, [ego], known, priors.fix)
            self.more = self.more if fault.extra is None else fault.extra[run, :, ego]
        self.by, self.corrected_now, self.grown = (seen.velocity - measured)[run, :, ego], False, 0.0
        self.seen, self.ego, self.run, self.known, self.priors = seen, ego, run, known, priors
        self.dt, self.u = seen.dt, seen.velocity[run, :, ego]
        self.life, self.white = Life(0, 0, 1, 0, 0, 0, zeros(2), zeros(3), 1, zeros(6)), np.ones(3)
        self.std: Floats = np.ones(3)
        if s is not None:
            self.std = s.relative_std.copy()
            heading, bias = (float(v**2) for v in known.compass)
            self.std[1] = sqrt(self.std[1] ** 2 - heading - bias)
            keep = exp(-seen.dt / s.gnss_drift_time)
            offset, absent = s.range_offset_std**2, full(6, priors.absent)
            absent[[2, 3, 5]] = max(priors.absent, 8.0)
            absent[3:5][[bias > 0, offset > 0]] = -inf
            bias, offset = bias or priors.compass**2, offset or priors.offset**2
            holds, turn = exp(-seen.dt / priors.lasts), np.square([priors.heading, priors.scale, priors.clock])
            ranged, lasting = (
                np.square([priors.range_scale, priors.pair_offset]),
                (s.gnss_drift_std**2, s.gnss_common_std**2),
            )
            self.life = Life(*lasting, keep, bias, heading, offset, ranged, turn, holds, absent)
            self.white = np.square(s.gnss_std) / np.square(s.fix_std)
        self.r = priors.fix**2 * broadcast_to(known.fix_variance(seen), seen.gnss.shape)[run]
        gnss = fresh(seen.gnss[run], seen.dt * seen.velocity[run], self.r)
        self.fix = gnss[:, ego]
        self.remember(gnss, seen.velocity[run])
        self.lone: Any
        self.box = inbox(seen, ego, FIX_AND_VELOCITY)
        self.q = heard(seen, self.box, known, run, ego)
        self.deaf = False
        self.reset()

    def remember(self, gnss, velocity):
        """What every vehicle sends: a mean of its fixes, each of which fades with its age."""
        self.mean, self.weight, self.odometer = (zeros(gnss.shape) for _ in range(3))
        m, w, o = zeros((3, *gnss.shape[1:]))
        for t, (z, u) in enumerate(zip(gnss, velocity, strict=True)):
            moved, there = np.nan_to_num(self.dt * u), isfinite(z)
            w = where(isnan(u), 0.0, w * exp(-self.dt / FADES)) + there / self.r[t]
            m, o = m + moved, o + moved
            m = where(there, m + (z - m) / where(there, self.r[t] * w, 1.0), m)
            self.mean[t], self.weight[t], self.odometer[t] = m, w, o

    def reset(self):
        self.state, self.lone = self.blank(), None
        self.doubts, self.left, self.last, self.pending, self.alike = zeros(2), 0.0, 0.0, 0.0, 0.0

    def blank(self):
        tables = (
            "last",
            "since",
            "way",
            "joined",
            "hits",
            "mean",
            "slot",
            "pace",
            "locked",
            "louder",
            "bends",
            "revoked",
        )
        numbers = (
            "made",
            "supported",
            "shown",
            "apart",
            "unseen",
            "blind",
            "evidence",
            "driven",
            "agree",
            "slips",
            "speed",
            "spread",
        )
        return SimpleNamespace(
            **{name: {} for name in tables},
            **dict.fromkeys((*numbers, "score", "numbers", "squares", "late", "weight", "unsaid", "whole"), 0.0),
            **{name: zeros(6) for name in ("level", "learned", "information")},
            **{name: zeros(3) for name in ("gap", "cov", "off", "course", "recent")},
            **dict.fromkeys(("left", "unused")),
            **{name: [] for name in ("products", "votes", "members")},
            belief=Belief(),
            jumped=False,
            vague=set(),
            trusted={self.ego} if self.priors.fix_gate else set(range(self.seen.gnss.shape[2])),
        )

    def loop(self):
        """x (T, 3), covariance (T, 3, 3), neighbours (k, 3) of each step."""
        found: list[Any] = []
        for t in range(len(self.seen.t)):
            fix, u = self.fix[t], self.u[t]
            self.gather(t)
            if isnan(u[0]) or not (self.state.belief.names or self.places(t, fix)):
                self.reset()
                found.append((full(3, nan), full((3, 3), nan), []))
                continue
            if not self.state.belief.names:
                self.begin(t)
            if self.priors.forget and self.lone is None and self.neighbours(t)[1]:
                self.lone = copy.deepcopy(self.state)
            self.tries(t)
            self.remember_error(t)
            x, cov = self.compare(t, *self.answer())
            cov = cov * (1 + self.state.unsaid / self.state.whole)
            more, white = max(self.lasting(t) - trace(cov), self.others()), self.r[t, self.ego] * self.white
            here = x, cov + more * diag(white / white.sum())
            b, way = self.state.belief, self.state.way
            errors = [b.x[b.at("b", j)] for j in {self.ego, *self.state.members} - self.state.trusted]
            if self.priors.forget and self.trusted() + (self.ego in self.state.trusted) < 2:
                here[1][:] += sum(map(outer, errors, errors)) / 2
            at = [b.x[b.at("x", j)] + way[j] if j in way else full(3, nan) for j in self.neighbours(t)[1]]
            found.append((*here, at))
        neighbours = [array(o).reshape(-1, 3) for *_, o in found]
        return array([x for x, *_ in found]), array([p for _, p, _ in found]), neighbours

    def remember_error(self, t):
        s, b = self.state, self.state.belief
        s.late += self.dt
        if s.share < 1:
            return
        error, keep = self.fix[t] - sum([b.x[b.at(*name)] for name in self.fix_terms(self.ego)]), exp(-min(s.late, 1.0))
        if s.weight:
            s.products = [*s.products, (t, error @ s.recent / s.weight)]
        s.recent, s.weight, s.late = keep * s.recent + error, keep * s.weight + 1, 0.0

    def lasting(self, t):
        if not (self.priors.forget and self.state.products):
            return 0.0
        when, p = array(self.state.products).T
        w, seconds = np.exp(-(t - when) * self.dt / 100), (t - self.state.began) * self.dt
        n = max(w.sum(), 1.0)
        c, error = w @ p / n, w @ p**2 / n * max(2 / np.clip(seconds, 1, 100), 1 / n)
        return float(max(c - error / c, 0.0)) if c > 0 else 0.0

    def others(self):
        return 3 * self.usual() / (1 + self.trusted()) if self.priors.forget else 0.0

    def answer(self):
        """Position and covariance, averaged over which errors are there."""
        b = copy.deepcopy(self.state.belief)
        self.average(b)
        x = b.at("x", self.ego)
        self.state.cov, self.state.off = diag(b.p[x, x]), b.x[x] - self.state.belief.x[x]
        return b.x[x], b.p[x, x]

    def compare(self, t, x, cov):
        """Beside the star, the ego alone: whose answer counts?"""
        if self.lone is None:
            return x, cov
        fix, dt, before = self.fix[t], self.dt, self.state
        if self.state.unused == t:
            fix = full(3, nan)
        level = max(self.state.level[:3])
        self.state, self.deaf = self.lone, True
        self.pace(t)
        self.corrected_now, self.grown = self.pending == KNOWN, self.more[t]
        self.step(t, 0.0)
        self.corrected_now = False
        y, q = self.answer()
        self.lone, self.state, self.deaf = self.state, before, False
        self.left -= dt
        if isfinite(fix).all():
            r = self.r[t, self.ego] * self.white + self.life.own + self.life.common
            star, lone = (min(((fix - at) ** 2 / (r + diag(p))).sum(), 25) for at, p in ((x, cov), (y, q)))
            self.doubts = exp(-dt / 10) * self.doubts + [star - lone, 1]
            self.gather(t)
            star, lone = (sum(self.off(t, at)) for at in (x, y))
            self.alike = exp(-dt / 10) * self.alike + star - lone
            if (level > 2.9 or self.alike > 20) and self.doubts[1] > 3 and self.doubts[0] > 4 * self.doubts[1]:
                self.state = copy.deepcopy(self.lone)
                self.doubts, self.last, self.alike = zeros(2), max(2 * self.last, 20.0), 0.0
                self.left = self.last
        return (y, q) if self.left > 0 else (x, cov)

    def average(self, b):
        life, slot = self.life, self.state.slot
        members = sorted((self.ego, *self.state.members), key=lambda j: -slot[j])
        turns = [b.at("o", j).start + i for j in members if ("o", j) in b.names for i in range(3)]
        for k, i in enumerate(turns):
            b.average([i], life.turn[k % 3], life.absent[k % 3])
        if ("compass",) in b.names:
            b.average([b.at("compass").start], life.bias, life.absent[3])
            b.average([b.at("compass").start + 2], life.offset, life.absent[4])
        if ("r", self.ego) in b.names:
            b.average([b.at("r", self.ego).start], life.ranged[0], life.absent[5])
        if life.absent[0] == -inf:
            turns = [i for k, i in enumerate(turns) if k % 3 < 2]
            b.average(turns, np.tile(life.turn[:2], len(members)), self.priors.exact * max(len(members), 2))

    def motion(self, t):
        """The ego's velocity and the variance of its motion, corrected by fixes or not."""
        u, q = self.u[t], self.q[t, self.ego]
        return (u, q + self.grown) if self.corrected_now else (u - self.by[t], q)

    def pace(self, t):
        """The most of late speeds, and its direction."""
        dt, u = self.dt, self.u[t]
        speed, late = float(norm(u)), self.state.speed * exp(-dt / SPEED_MEMORY_S)
        self.state.blind += dt
        if speed > 0.5 * late:
            self.state.course, self.state.blind = u / speed, 0.0
        self.state.speed = max(speed, late)

    def tries(self, t):
        """A step, and perhaps one that slips."""
        share, dt = self.priors.slip * (self.known.sensors is not None), self.dt
        self.pace(t)
        more = self.more[t]
        self.pending = 0.0 if more == 0 else KNOWN if self.pending == KNOWN else self.pending + more
        before = copy.deepcopy(self.state) if share else None
        self.step(t, 0.0)
        n, p = self.state.numbers, self.state.slips
        known, fails = self.pending == KNOWN, self.pending > 0
        strange = (p > 0.1 or self.state.squares > n + sqrt(2 * n)) and (fails or known or not self.state.jumped)
        if before is None or not strange:
            self.state.slips *= 0.0 if n else exp(-dt / SLIP_DURATION_S)
            return
        first, self.state = self.state, before
        rate, shows = (share * self.state.speed) ** 2, self.r[t, self.ego] @ self.white + self.state.shown**2
        if not before.left or p <= 0.1:
            self.keep_place(shows)
        self.corrected_now, self.grown = fails or known, self.more[t] if known else self.pending
        self.step(t, rate * dt**2 + (min(rate * SLIP_HIDDEN_S**2, shows) if p <= 0.5 and dt < SLIP_HIDDEN_S else 0.0))
        self.corrected_now = False
        prior = p * (1.0 if known else exp(-dt / SLIP_DURATION_S)) + (1 - p) * min(
            dt / (SLIP_DURATION_S if known else SLIP_INTERVAL_S), 0.5
        )
        odds = self.state.score - first.score + (DECISIVE if fails else log(prior / (1 - prior)))
        if odds < 0:
            self.state = first
        elif fails:
            self.pending = KNOWN
        self.state.slips = 1 / (1 + exp(min(-odds, 700)))

    def count(self, q, logdet, numbers):
        """What the numbers of an update say of a slip."""
        self.state.score -= 0.5 * (q + logdet)
        self.state.numbers += numbers
        self.state.squares += q

    def neighbours(self, t):
        """Links of a step, and the columns that they join."""
        here = np.arange(self.box.start[t], self.box.start[t + 1])
        return here, self.seen.links.neighbour[self.box.link[here]].tolist()

    def gather(self, t):
        """The messages of neighbours that are held at a step, and what is measured of them."""
        here, others = (np.empty(0, int), []) if self.deaf else self.neighbours(t)
        links = dict(zip(others, here.tolist(), strict=True))
        self.relative = {j: self.seen.relative[self.run, self.box.link[link]] for j, link in links.items()}
        self.messages = {j: self.message(link, j) for j, link in links.items()}

    def places(self, t, fix):
        """Where the ego may be, and the variance: by its fix, and by each neighbour."""
        found = [(fix.copy(), self.r[t, self.ego])] if isfinite(fix).all() else []
        for j, message in self.messages.items():
            if message is not None and isfinite(self.relative[j]).all() and message.weight.all():
                late = (t - message.step) * self.dt * message.velocity
                found.append((message.mean + late - to_vector(self.relative[j]), 1 / message.weight + 1))
        return found

    def message(self, link, j):
        """The newest one that is held."""
        s = int(self.box.newest[self.run, link])
        if s < 0:
            return None
        velocity, q = self.seen.velocity[self.run, s, j], self.louder(j) * self.q[s, j]
        return Sent(s, self.mean[s, j], self.weight[s, j], self.odometer[s, j], velocity, q)

    def louder(self, j):
        """Level of a vehicle's motion."""
        s, few = self.state, self.state.mean.get(j, (0.0, 0.0))[0] < AGREEING
        doubted = few and j in s.last and j not in s.trusted and j != self.ego
        return (UNTRUSTED if doubted else 1.0) * exp(s.level[5]) * float(s.louder.get(j, 1.0))

    def learn(self, kind, more, share, numbers=1):
        """What innovations show of a level: derivative and information of their log-likelihood."""
        self.state.learned[kind] += 0.5 * numbers * share * more
        self.state.information[kind] += 0.5 * numbers * share**2

    def own_variance(self):
        return diag(self.state.belief.p)[self.state.belief.at("x", self.ego)].sum()

    def corrected(self):
        """What the level of motion makes of the ego's variance, after an update."""
        s, now = self.state, self.own_variance()
        left = (now / s.whole) ** 2
        s.made, s.unsaid, s.whole = min(s.made * left, now), s.unsaid * min(left, 1), now

    def begin(self, t):
        """The first step."""
        s, b, life = self.state, self.state.belief, self.life
        b.add(("x", self.ego), 0.0, 0.0)
        if life.common:
            b.add(("common",), 0, life.common)
        if life.bias + life.heading + life.offset:
            b.add(("compass",), 0, [life.bias, 0, life.offset])
        if life.ranged[0]:
            b.add(("r", self.ego), 0, [life.ranged[0], 0, 0])
        self.add_turn(self.ego)
        s.slot[self.ego], s.began = 0, t
        s.trusted.add(self.ego)
        self.start(t, self.fix[t].copy())

    def step(self, t, slip):
        s, g, b = self.state, self.priors, self.state.belief
        s.score = s.numbers = s.squares = s.share = 0.0
        s.now = slip > 0
        self.gather(t)
        others, messages, relative = [*self.messages], self.messages, self.relative
        louder = self.louder(self.ego)
        fix = self.fix[t].copy()
        if s.unused == t:
            fix[:] = nan
        seen, outvoted = bool(isfinite(fix).all()), bool(g.fix_gate) and self.outvoted(t, fix)
        if outvoted:
            s.trusted.add(self.ego)
        again = bool(g.fix_gate) and t > s.began and seen
        again = again and (outvoted or self.lost(t)) and self.start(t, fix)
        for j in list(s.members):
            if j not in others or again or self.contradicted(t, j):
                self.dismiss(j, j in others, outvoted)
        dt = self.dt
        trusted = self.ego in s.trusted
        if trusted and s.hits.get(self.ego, 0) == 0:
            s.agreed += min(dt, 1.0)
        elif s.agreed < ESTABLISHED or not trusted:
            s.agreed = max(min(s.agreed, ESTABLISHED) - 1.5 * dt, 0.0)
        s.unseen += dt
        u, q = self.motion(t)
        u, q = self.steady(t, self.ego, u, louder * q)
        if t > s.joined[self.ego]:
            self.predict(dt * u, q)
            x = b.at("x", self.ego)
            across = min(SIDEWAYS + (TURNS * s.blind) ** 2, 1.0)
            widened = min(slip, LEFT_OPEN * self.grown) if self.corrected_now else slip
            b.p[x, x] += widened * (across * eye(3) + outer(s.course, s.course))
        s.made = s.made + q.sum()
        grown, way = max(0.0 if self.ego in s.vague else self.own_variance() - s.whole, q.sum()), 0.0
        s.cov = s.cov + (grown / 3 if slip else q)
        if s.left:
            if slip:
                corrections = louder * self.grown if self.corrected_now else 0.0
                grown, way = max(q.sum() - 3 * corrections, 0.0), self.by[t] * dt if self.corrected_now else 0.0
            s.left = s.left[0] - way, s.left[1] + grown / 3
        s.unsaid *= min(self.own_variance() / s.whole, 1.0) if s.whole else 1.0
        s.whole = self.own_variance()
        for j in [j for j in others if j not in s.members]:
            self.join(t, j)
        if isfinite(fix).all():
            self.add_fix(t, fix)
        for j in self.nearest()[1]:
            new = j in s.vague and messages[j] is not None
            if new and g.fix_gate and isfinite(relative[j]).all():
                s.way[j] = self.goes_on(t, j)[0]
            else:
                self.take(t, j)
                if new and g.fix_gate and isfinite(relative[j][1]):
                    self.trust()
        at, order = self.nearest()
        self.measure(t, at, order)
        for j in order:
            self.take(t, j)
        if g.fix_gate:
            self.trust()
            self.follow_majority()
        self.corrected()
        if g.forget:
            step = np.clip(s.learned / (s.information + PRIOR), -MAX_LEVEL_CHANGE, MAX_LEVEL_CHANGE)
            before, s.level = s.level, np.clip(s.level + step, 5 * [MIN_LEVEL] + [g.quietest], MAX_LEVEL)
            changes, n = np.exp(s.level - before) - 1, self.trusted()
            if len(self.fix_terms(self.ego)) == 1:
                fixes = (changes[3] + n * changes[4]) / (1 + n)
                made = min(s.made, s.whole + s.unsaid)
                s.unsaid += made * changes[5] + (s.whole + s.unsaid - made) * fixes
        s.learned = zeros(6)
        s.information = s.information * (exp(-dt / g.forget) if g.forget else 1.0)

    def nearest(self):
        """Where ego and members are now, and the members, nearest first."""
        s, b = self.state, self.state.belief
        at = {j: b.x[b.at("x", j)] + s.way.get(j, 0.0) for j in (self.ego, *s.members)}
        return at, sorted(s.members, key=lambda j: float(norm(at[j] - at[self.ego])))

    def dismiss(self, j, measured, doubted):
        if measured and (doubted or j not in self.state.trusted):
            self.doubt(j)
        for kind in "xbor":
            self.state.belief.drop((kind, j))
        self.state.members.remove(j)

    def add_fix(self, t, fix):
        s, louder, way = self.state, exp(self.state.level[3]), self.state.speed * self.state.unseen
        rows = [(self.fix_terms(self.ego), fix[c], louder * self.r[t, self.ego, c] * self.white[c]) for c in range(3)]
        if self.ego not in s.vague:
            self.learn_fix(3, rows)
            _, gap, _, r = self.mahalanobis(s.belief, rows)
            far, most = float(norm(gap)), s.speed * s.unseen + 2 * sqrt(r.sum())
            more = far - float(norm(s.gap))
            if more > most or far < 2 * sqrt(r.sum()):
                s.jumped = more > most
            apart = float(norm(fix - s.belief.x[s.belief.at("x", self.ego)]))
            s.shown, s.apart = max(s.shown + min(apart - s.apart, most), 0.0), apart
            s.gap, s.unseen = gap, 0.0
        if self.priors.fix_gate and self.ego not in s.vague:
            self.go_back(t, fix, rows)
            rows = [(self.fix_terms(self.ego), *row[1:]) for row in rows]
        s.share = self.use_fix(t, self.ego, rows, True, self.may_slip(self.r[t, self.ego] * self.white, way**2))
        self.corrected()

    def keep_place(self, more):
        s, b, at = self.state, self.state.belief, self.state.belief.at("x", self.ego)
        s.left = b.x[at].copy(), (trace(b.p[at, at]) + more) / 3
        s.evidence = s.agree = s.driven = 0.0

    def go_back(self, t, fix, rows):
        """To where the ego was before fixes contradicted it, if it is there again."""
        s, b = self.state, self.state.belief
        q, gap, cov, r = self.mahalanobis(b, rows)
        gate, at = max(self.priors.fix_gate, FIX_GATE), b.at("x", self.ego)
        gain = 0.0 if s.now else float(np.mean(diag(cov) / (diag(cov) + r)))
        s.agree = 0.0 if q > gate else s.agree + gain
        if not s.left:
            if q > gate:
                self.keep_place(0.0)
            return
        (x, p), most = s.left, HARD_REJECT_FACTOR * gate
        if ("o", self.ego) in b.names and self.life.absent[0] == -inf:
            p += s.driven**2 * diag(b.p)[b.at("o", self.ego)].sum() / 3
        other = ((fix - x) ** 2 / (p + r + SLIP_M2)).sum()
        s.evidence = 0.0 if other > gate else max(s.evidence + min(q, most) - other, 0.0)
        near = np.square(b.x[at] - x + diag(cov) / (diag(cov) + r) * gap).sum() < 3 * p
        if not near and s.evidence > FIXES_TO_RETURN * most:
            if self.speak_for(t, b.x[at], x) > 0:
                return
            for j in list(s.members):
                self.dismiss(j, j in self.messages, False)
            self.place(x, p)
            s.left, s.cov, s.off = None, full(3, p), zeros(3)
        elif near and s.agree > AWAY:
            s.left = None

    def learn_fix(self, kind, rows):
        _, gap, cov, r = self.mahalanobis(self.state.belief, rows)
        total, s = trace(cov) + r.sum(), self.state
        change, square = np.square(gap - s.gap).sum() / 2 / total, gap @ gap / total
        wild, established = square > SUDDEN, s.agreed >= ESTABLISHED and s.locked.get(self.ego, 0.0) >= MAX_LOCKOUT
        noise = change if kind == 3 and wild and not established else square
        self.learn(kind, min(noise, SUDDEN) - 1, r.sum() / total, 3)
        if kind == 3 and not (wild and (s.jumped or change > SUDDEN)):
            self.learn(5, min(square, SUDDEN) - 1, s.made / total, 3)

    def mahalanobis(self, b, rows):
        """Squared distance and innovations of rows, their covariance without noise, and the noise's variance."""
        h = array([b.row(row[0], c) for c, row in enumerate(rows)])
        gap, r = array([row[1] for row in rows]) - h @ b.x, array([row[2] for row in rows])
        cov = h @ b.p @ h.T
        return float(gap @ solve(cov + diag(r), gap)), gap, cov, r

    def may_slip(self, fix, way2):
        return min(SLIP_M2, max(float(np.mean(fix)), 0.25 * way2))

    def use_fix(self, t, j, rows, again, slip):
        """The share of its information that is used."""
        share, hits = self.share_of(t, j, rows, again, slip), self.state.hits
        hits[j] = hits.get(j, 0) + 1 if share < 1 else 0
        return share

    def share_of(self, t, j, rows, again, slip):
        """That share, the less, the more in a row were rejected; trust may be revoked."""
        s, g, b = self.state, self.priors, self.state.belief
        used = [c for c, row in enumerate(rows) if row is not None]
        h = array([b.row(rows[c][0], c) for c in used])
        z, r = (array([rows[c][i] for c in used]) for i in (1, 2))
        if not used:
            return 1.0
        if j in s.vague and len(used) == 3:
            b.updates(h, z, r)
            s.vague.discard(j)
            return 1.0
        judged = j != self.ego or any(i in s.last for i in s.members)
        doubtful = g.fix_gate and judged and again and len(used) == 3 and self.wrong(j, *self.mahalanobis(b, rows))
        if doubtful:
            supported = j != self.ego or self.speak_for(t, b.x[b.at("x", j)], z) >= 0
            if supported and j in s.trusted:
                s.revoked[j] = s.revoked.get(j, 0) + 1
            elif not supported:
                b.noise(("x", j), np.square(z - h @ b.x).sum() / 3)
            s.agreed *= s.jumped or j != self.ego or j not in s.trusted
            self.doubt(j, TAU if supported else 0.0)
            if j == self.ego:
                s.locked[j] = 0.0
                h = array([b.row(self.fix_terms(j), c) for c in used])
                b.updates(h, z, r)
            return 0.0 if supported else 1.0
        gap, own = z - h @ b.x, h @ b.p @ h.T
        square = float(gap @ solve(own + diag(r), gap))
        self.count(min(square, FIX_SCORE), slogdet(own + diag(r))[1], len(used))
        mine, noise, locked = trace(own), r.sum(), s.locked
        if not judged:
            mine, noise = s.cov[used].sum(), noise * exp(-s.level[3])
        gain = mine / (mine + noise)
        q = square
        if j == self.ego and len(self.fix_terms(j)) == 1:
            q = float((((gap - s.off[used]) ** 2) / (s.cov[used] + r)).sum())
        q = min(q, float(gap @ gap) / slip)
        share, hits = 1.0, locked.get(j, 0.0)
        if g.fix_gate:
            if q > g.fix_gate and hits < PATIENCE:
                share = g.fix_gate / q if q < HARD_REJECT_FACTOR * g.fix_gate else 0.0
            share /= 1 + s.hits.get(j, 0) if share < 1 and (j == self.ego or self.trusted() > 2) else 1
            locked[j] = hits + gain if q > g.fix_gate else max(hits - LEAK * gain, 0.0)
            holds = s.agreed >= ESTABLISHED or (s.agreed > 0 and s.jumped)
            if not judged and holds and s.level[3] <= 2.9:
                locked[j] = min(locked[j], MAX_LOCKOUT)
        if share:
            b.updates(h, z, r, share=share)
        return share

    def wrong(self, j, q, gap, cov, r):
        """On average, or locked out, the ego beside a neighbour that is trusted."""
        locked = q > self.priors.fix_gate and self.state.locked.get(j, 0.0) >= PATIENCE
        return self.wrong_on_average(j, q, gap, cov, r) or (locked and (j != self.ego or self.trusted() > 0))

    def trusted(self):
        """How many members are trusted, of those that have sent a message."""
        return sum(j in self.state.last and j in self.state.trusted for j in self.state.members)

    def wrong_on_average(self, j, q, gap, cov, r):
        """The clipped mean innovation, beside what another error of the fixes would make of it."""
        s, g = self.state, self.priors
        count, mean, noise = s.mean.get(j, (0.0, zeros(3), 0.0))
        count = min(count + 1, WINDOW)
        s.mean[j] = count, mean, noise
        if j not in s.trusted and q > max(g.fix_gate, FIX_GATE):
            return True
        mean = mean + (gap * min(1.0, sqrt(CLIP / q)) - mean) / count
        s.mean[j] = count, mean, noise + (r.sum() - noise) / count
        v = cov + diag(r) / count + (1.0 if self.life.own else 0.0) * eye(3)
        near = mean @ solve(v, mean)
        enough = near >= 2 * (log((1 - FAULTY_SHARE) / FAULTY_SHARE) + REVOKE_LOG_ODDS)
        v = v + (self.usual(j) if j != self.ego else 0.0) * eye(3)
        wide = v + min(TAU**2, mean @ mean / 3) * eye(3)
        odds = log((1 - FAULTY_SHARE) / FAULTY_SHARE) + normal(mean, v) - normal(mean, wide)
        return bool(count >= LEAST and enough and odds < -REVOKE_LOG_ODDS)

    def usual(self, but=-1):
        """Variance of an error of fixes that nothing is wrong with: of those of the others the lower median distance
        from the nearest."""
        s, b, errors = self.state, self.state.belief, list[Any]()
        for j in (self.ego, *(j for j in s.members if j in s.last)):
            if j != but and j not in s.trusted:
                errors.append((b.x[b.at("b", j)], trace(b.p[b.at("b", j), b.at("b", j)])))
            elif j != but and j in s.mean and s.mean[j][0] >= 3:
                errors.append((s.mean[j][1], s.mean[j][2] / s.mean[j][0]))
        if len(errors) < 3:
            return 0.0
        apart = array([[((x - y) ** 2).sum() - p - q for y, q in errors] for x, p in errors])
        np.fill_diagonal(apart, inf)
        return float(np.sort(apart.min(1))[(len(errors) - 1) // 2].clip(0) / 3)

    def doubt(self, j, tau=TAU):
        """Its fixes have an error of that deviation, m, or none."""
        s, variance = self.state, tau**2 + self.life.own
        s.trusted = s.trusted - {j} if tau else s.trusted | {j}
        s.mean.pop(j, None)
        if ("x", j) in s.belief.names:
            s.belief.drop(("b", j))
            if variance:
                s.belief.add(("b", j), 0.0, variance)

    def follow_majority(self):
        """More that err alike than are trusted, the ego's own among them, or most: the ego goes where they see it."""
        s, b, own = self.state, self.state.belief, self.ego not in self.state.trusted
        if not own and (s.trusted != {self.ego} or {*s.revoked} - {self.ego}):
            return

        def far(j, k=None):
            """From one another, or from 0."""
            at, to = b.at("b", j), b.at("b", j if k is None else k)
            two, cross = float(k is not None), b.p[at, to]
            v = b.p[at, at] + two * (b.p[to, to] - cross - cross.T) + 1e-6 * eye(3)
            gap = b.x[at] - two * b.x[to]
            return float(gap @ solve(v, gap))

        heard = [j for j in s.members if j in s.last]
        early = [self.ego, *(j for j in heard if s.agreed <= 0 or j not in s.revoked)]
        wrong = [j for j in early if j not in s.trusted and far(j) > WILD]
        alike = {j: [k for k in wrong if k == j or far(j, k) < FIX_GATE] for j in wrong}
        best = max([self.ego][: self.ego in wrong] if own else wrong, key=lambda j: len(alike[j]), default=None)
        if best is None or len(alike[best]) < 2:
            return
        if len(alike[best]) <= self.trusted() + 1 if own else 2 * len(alike[best]) <= len(heard):
            return
        x, e = b.at("x", self.ego), b.at("b", best)
        there, variance = b.x[x] + b.x[e], trace(b.p[x, x] + b.p[e, e] + 2 * b.p[x, e])
        if own and norm(b.x[e]) > s.shown + 2 * sqrt(variance):
            return
        before = [self.ego, *s.members]
        for j in list(s.members):
            self.dismiss(j, True, False)
        s.way.clear()
        self.place(there, variance / 3)
        for j in before:
            s.revoked.update({j: s.revoked.get(j, 0) + 1} if j in s.trusted and j not in alike[best] else {})
            self.doubt(j, 0.0 if j in alike[best] else TAU)
        s.left, s.agreed, s.hits[self.ego] = None, 0.0, 0

    def start(self, t, fix):
        """The ego at its fix, or where two messages put it that contradict the fix, or, without one, most."""
        s, g = self.state, self.priors
        places, votes = self.places(t, fix), [1]
        if g.fix_gate:
            votes = [sum(((x - y) ** 2 / (p + q)).sum() <= g.fix_gate for y, q in places) for x, p in places]
        best = int(np.argmax(votes))
        elsewhere = isnan(fix[0]) or (votes[0] <= 1 and max(votes) >= 2)
        if self.ego not in s.trusted and votes[0] < max(len(votes), 2):
            return False
        self.place(places[best if elsewhere else 0][0], FLAT)
        s.joined[self.ego], s.hits[self.ego] = t, 0
        if s.left:
            moved = self.dt * self.motion(t)[0]
            s.left = s.left[0] + moved, s.left[1]
        s.agreed = 0.0
        s.vague.add(self.ego)
        if elsewhere:
            fix[:], s.unused = nan, t
            s.vague.discard(self.ego)
        return True

    def place(self, x, variance):
        """The ego anew, whose fixes are trusted."""
        s, b = self.state, self.state.belief
        b.drop(("b", self.ego))
        if self.life.own:
            b.add(("b", self.ego), 0, self.life.own)
        b.transform(("x", self.ego), {})
        b.x[b.at("x", self.ego)] = x
        b.noise(("x", self.ego), variance)
        s.trusted.add(self.ego)
        s.mean.pop(self.ego, None)
        s.locked.pop(self.ego, None)

    def outvoted(self, t, fix):
        """Do more fixes agree with one another elsewhere than with the start, and no more neighbours with that?"""
        votes, r, (u, q) = self.state.votes, self.r[t, self.ego] * self.white, self.motion(t)
        if votes and votes[0][1] >= CONFIRMED:
            return False
        for at in votes:
            at[0] += self.dt * u
        self.state.spread = self.state.spread + q.mean() if votes else 0.0
        if isnan(fix).any():
            return False
        for at in votes:
            if ((fix - at[0]) ** 2 / (2 * r + self.state.spread + SLIP_M2)).sum() <= HARD_REJECT_FACTOR * FIX_GATE:
                at[1] += 1
                break
        else:
            votes[1:] = [[fix.copy(), 1]]
        if votes[-1][1] <= votes[0][1]:
            return False
        votes[:], self.state.spread = [[fix.copy(), votes[1][1]], votes[0]], 0.0
        b = self.state.belief
        return self.speak_for(t, b.x[b.at("x", self.ego)] + self.dt * u, fix) <= 0

    def speak_for(self, t, here, there):
        """How much nearer do neighbours put the ego to one place than to another?"""
        return sum(self.off(t, there)) - sum(self.off(t, here))

    def off(self, t, place):
        """How far is a place from where each neighbour puts the ego?"""
        std, found = self.std * np.exp(self.state.level[:3] / 2), []
        for j, message in self.messages.items():
            relative = self.relative[j]
            if message is None or isnan(relative[0]):
                continue
            with np.errstate(divide="ignore"):
                r = np.mean(1 / message.weight + self.r[t, self.ego] * self.white + 1) + std[0] ** 2
                r += self.life.own + self.life.common
            gap = message.mean + (t - message.step) * self.dt * message.velocity - place
            q = (norm(gap) - relative[0]) ** 2 / r
            if isfinite(relative).all():
                q = np.square(gap - to_vector(relative)).sum() / (r + std[1] ** 2 * gap @ gap)
            found.append(min(float(q), FIX_GATE))
        return found

    def lost(self, t):
        s = self.state
        held = [j for j in s.members if j in s.last]
        if self.trusted():
            return False
        if self.ego in s.trusted:
            return bool(s.hits[self.ego] > 0 and s.locked.get(self.ego, 0.0) >= PATIENCE)
        if s.agreed > 0:
            return False
        b, noise = s.belief, (self.r[t, self.ego] @ self.white) / 3
        error = b.x[b.at("b", self.ego)]
        apart = [float(np.square(error - b.x[b.at("b", j)]).sum()) for j in held]
        agree = error @ error > FIX_GATE * noise and apart[:1] < [FIX_GATE * noise]
        return len(held) >= 2 or bool(len(held) == 1 and (error @ error > WILD * noise or agree))

    def contradicted(self, t, j):
        hits, since = self.state.hits[("relative", j)], t - self.state.joined[j]
        most = max(hits)
        return bool(most >= min(CONTRADICTED, max(2, since - most)) or sum(n >= 3 for n in hits) >= 2)

    def fix_terms(self, j):
        names = [("x", j), ("b", j), ("common",)]
        return {name: 1.0 for name in names if name in self.state.belief.names}

    def steady(self, t, j, u, q):
        """Velocity and variance of a step's motion, or the last ones where no vehicle can have changed that fast."""
        g, dt, louder = self.priors, self.dt, self.state.louder
        last, since, variance, slips = self.state.pace.get(j, (u, -inf, q, 0))
        passed = max(t - since, 1) * dt
        changed = (ACCELERATION * passed) ** 2
        strange = ((u - last) ** 2 / ((q + variance) / dt**2 + changed)).sum()
        if g.forget:
            seen = min(t - self.state.began + 1, CHANGES)
            louder[j] = max(louder.get(j, 1.0) * (1 + (min(strange, WIDEST) / 3 - 1) / seen), 1.0)
        if g.slip * (self.known.sensors is not None) and g.fix_gate and strange > WILD and slips < 5:
            self.state.pace[j] = last, since, variance, slips + 1
            return last, variance + changed * dt**2
        if g.fix_gate and since >= 0:
            cross, square = exp(-passed / TURN_MEMORY_S) * self.state.bends.get(j, zeros(2))
            self.state.bends[j] = array([cross + last[0] * u[1] - last[1] * u[0], square + passed * u[:2] @ u[:2]])
        self.state.pace[j] = u, t, q, 0
        return u, q

    def predict(self, moved, q):
        b, life = self.state.belief, self.life
        self.drive(self.ego, moved)
        b.noise(("x", self.ego), q)
        for name in b.names:
            if name[0] == "b" and life.own:
                if name[1] in self.state.trusted:
                    b.transform(name, {name: life.keep})
                b.noise(name, life.own * (1 - life.keep**2))
            if name[0] == "r" and name[1] != self.ego:
                keep = exp(-self.dt / PAIR_TIME)
                b.transform(name, {name: keep})
                b.noise(name, [(1 - keep**2) * life.ranged[1], 0, 0])
        if life.common:
            b.transform(("common",), {("common",): life.keep})
            b.noise(("common",), life.common * (1 - life.keep**2))

    def add_turn(self, j):
        if self.life.turn.any():
            self.state.belief.add(("o", j), 0.0, self.life.turn)

    def turn(self, j):
        """Errors of an odometry, where they are linear."""
        b: Belief = self.state.belief
        return b.x[b.at("o", j)]

    def turned(self, j, moved):
        """A motion by odometry, corrected, and its derivatives by the errors of it."""
        b, by = self.state.belief, zeros((3, 3))
        if ("o", j) not in b.names or (j == self.ego and self.corrected_now):
            return moved, by
        turn, scale, _ = self.turn(j)
        c, s = cos(turn), sin(turn)
        way = (1 + scale) * array([[c, -s], [s, c]]) @ moved[:2]
        by[:2, 0], by[:2, 1] = [-way[1], way[0]], way / (1 + scale)
        return np.append(way, moved[2]), by

    def drive(self, j, moved, steps=1):
        b, (way, by) = self.state.belief, self.turned(j, moved)
        b.x[b.at("x", j)] += way
        if j == self.ego and self.state.left:
            self.state.left = self.state.left[0] + way, self.state.left[1]
            self.state.driven += hypot(way[0], way[1])
        if ("o", j) not in b.names:
            return
        x, o, f, level = b.at("x", j), b.at("o", j), eye(len(b.x)), exp(self.state.level[5])
        sure = min(
            max((b.x[o][:2] ** 2 / (diag(b.p)[o][:2] + 1e-12)).sum(), 1),
            300 if self.priors.fix_gate and j == self.ego else 1,
        )
        holds = self.life.holds ** (level**2 * sure * steps)
        f[x, o], f[o, o] = by, holds * eye(3)
        b.p = f @ b.p @ f.T
        b.x[o] *= holds
        b.noise(("o", j), (1 - holds**2) * self.life.turn)

    def near(self, j):
        """Where the ego measures a vehicle."""
        b, relative = self.state.belief, self.relative[j]
        far = 1 + (0.0 if isnan(relative[0]) else relative[0])
        gap = to_vector(relative) if isfinite(relative).all() else array([far, far, 0.1 * far])
        near: Floats = b.x[b.at("x", self.ego)] + gap
        return near

    def join(self, t, j):
        s, b, message = self.state, self.state.belief, self.messages[j]
        taken = {s.slot[i] for i in s.members} if s.members else set()
        s.slot[j] = next(k for k in range(1, 10**6) if k not in taken)
        s.members.append(j)
        s.joined[j], s.hits[("relative", j)], s.hits[j] = t, [0, 0, 0], 0
        s.since[j] = t if message is None else message.step
        b.add(("x", j), self.near(j), FLAT)
        if message is not None:
            b.x[b.at("x", j)] -= (t - message.step) * self.dt * message.velocity
        s.vague.add(j)
        s.locked.pop(j, None)
        s.way.pop(j, None)
        self.add_turn(j)
        if self.life.ranged[1]:
            b.add(("r", j), 0, [self.life.ranged[1], 0, 0])
        variance = self.life.own + (0.0 if j in s.trusted else TAU**2)
        if variance:
            b.add(("b", j), 0.0, variance)

    def measure(self, t, at, order):
        """Linear at the prediction."""
        b = self.state.belief
        if order and ("compass",) in b.names:
            i = b.at("compass").start + 1
            b.x[i], b.p[i], b.p[:, i] = 0.0, 0.0, 0.0
            b.p[i, i] = self.life.heading
        for j in order:
            self.relate(t, j, at)

    def relate(self, t, j, at):
        relative, message = self.relative[j], self.messages[j]
        s, g, there = self.state, self.priors, isfinite(relative)
        b, vague, hits = s.belief, j in s.vague, s.hits[("relative", j)]
        if not there.all() and vague:
            return
        gap, unit = at[j] - at[self.ego], self.known.sensors is None
        expected = array(spherical(*gap))
        far = expected[0]
        ground, least = hypot(gap[0], gap[1]), 0.0 if unit else self.known.sensors.min_range  # type: ignore[union-attr]
        reach = max(far, least)
        flat = max(ground / far, 1e-3) * reach
        rows = array(
            [
                gap / far,
                [-gap[1] / flat**2, gap[0] / flat**2, 0],
                [gap[0] * gap[2] / (flat * reach**2), gap[1] * gap[2] / (flat * reach**2), -flat / reach**2],
            ]
        )
        residual, size = relative - expected, array([1.0, flat, reach])
        residual[1:] = wrap(residual[1:])
        z, r = residual + rows @ gap, 1 / size**2 if unit else self.std**2
        r, age = r * np.exp(s.level[:3]), (t - s.since[j]) * self.dt
        s.way[j], by = self.goes_on(t, j)
        z = z - rows @ s.way[j]
        if age:
            r = r + rows**2 @ ((age / self.dt) ** 2 * message.process + (ACCELERATION * age**2 / 2) ** 2)
        h = []
        for c in range(3):
            terms: dict[Name, Any] = {("x", j): rows[c], ("x", self.ego): -rows[c]}
            if ("o", j) in b.names:
                terms[("o", j)] = rows[c] @ by
                z[c] += rows[c] @ by @ self.turn(j)
            if c < 2 and ("compass",) in b.names:
                terms[("compass",)] = array([[0, 0, 1], [1, 1, 0]][c])
            for who, factor in ((self.ego, far), (j, 1.0)):
                if c == 0 and ("r", who) in b.names:
                    terms[("r", who)] = array([factor, 0, 0])
            h.append(b.row(terms, c))
        spread = np.einsum("ci,ij,cj->c", h, b.p, h)
        if g.fix_gate and not vague:  # the variance of terms of second order, with what each number leaves of its error
            p, own = spread * size**2, r * size**2
            u, v, w = where(there, p * own / (p + own), p)
            r = r + array([0.5 * (v**2 + w**2), u * p[1], u * p[2]]) / (reach * size) ** 2
        total = spread + r
        for c in np.flatnonzero(there):
            logdet = log((float(h[c] @ b.p @ h[c]) + r[c]) * size[c] ** 2)
            q = b.update(h[c], z[c], r[c], 0.0 if vague or not g.fix_gate else GATE)
            if not vague:
                self.count(min(q, GATE), logdet, 1)
                hits[c] = hits[c] + 1 if g.fix_gate and q > GATE else 0
                self.learn(c, min(q, SUDDEN) - USUAL_SQUARE, r[c] / total[c])
        s.vague.discard(j)

    def take(self, t, j):
        """Use the newest message, and go on from there."""
        self.messages[j] = self.receive(t, j, self.messages[j])
        self.state.way[j] = self.goes_on(t, j)[0]

    def receive(self, t, j, message):
        """Move to where the newest message was sent, use the fixes since the last one; the message as it is used."""
        s, dt, last = self.state, self.dt, self.state.last.get(j)
        b, since = s.belief, s.since[j]
        if message is None and since < t:
            s.since[j] = t
            s.vague.add(j)
            b.noise(("x", j), FLAT)
            b.x[b.at("x", j)] = self.near(j)
        if message is None or (last and message.step <= last.step):
            return message
        gap, steps = message.step - since, message.step - last.step if last else 1
        follows, moved = bool(last and since == last.step), message.odometer - (last.odometer if last else 0.0)
        u, q = self.steady(t, j, moved / (gap * dt) if follows and steps > 1 else message.velocity, message.process)
        self.drive(j, gap * dt * u, gap)
        half, spent = (1 + 1 / steps) / 2, (steps if follows else gap**2) * q
        b.noise(("x", j), half * spent)
        rows = [self.said(message, last, j, q, moved, steps, follows, c) for c in range(3)]
        if last and j not in s.vague and j in s.trusted and None not in rows:
            self.learn_fix(4, rows)
        slip = self.may_slip(self.r[message.step, j], float(np.square(moved).sum()))
        self.use_fix(t, j, rows, last is not None, slip)
        b.noise(("x", j), (1 - half) * spent)
        s.last[j], s.since[j] = message, message.step
        return message._replace(process=q)

    def said(self, new, last, j, q, moved, steps, follows, c):
        """Terms, number and variance of the mean of the fixes since the last message, None for none."""
        fade, weight, z = exp(-self.dt / FADES), new.weight[c], new.mean[c]
        old = fade**steps * last.weight[c] if last else 0.0
        old = old if weight > old * (1 - 1e-9) else 0.0
        if weight - old <= 1e-9 * weight or not weight:
            return None
        louder, long = exp(self.state.level[4]), 1 / (1 - fade**2)
        white = louder * self.white[c] / (weight - old)
        if old:
            before = last.mean[c] + moved[c]
            z = before + (z - before) * weight / (weight - old)
            way = (steps - 1 / steps) / 12 if follows else min((steps - 1) * (2 * steps - 1) / (6 * steps), long)
        else:
            n = weight * self.r[new.step, j, c]
            white *= (2 - min(n * (1 - fade), 1)) / (1 + fade)
            way = long * max(0, 1 - 1 / n)
        terms: dict[Name, Any] = dict(self.fix_terms(j))
        if ("o", j) in self.state.belief.names:  # by a clock that is ahead
            terms["o", j] = outer(-new.velocity, [0, 0, 1])
        return terms, z, white + way * q[c]

    def goes_on(self, t, j):
        """The way since the newest message, and its derivatives by the errors of odometry."""
        message, (*_, slips) = self.messages[j], self.state.pace.get(j, [0])
        age = (t - self.state.since[j]) * self.dt
        u = zeros(3) if message is None else self.state.pace[j][0] if slips else message.velocity
        if message and j in self.state.bends and not slips:
            cross, square = self.state.bends[j]
            signal, noise = (
                cross**2 / square**2 * u[:2] @ u[:2],
                message.process[:2].mean() / (self.dt * TURN_MEMORY_S) ** 2,
            )
            a = (age + self.dt) / 2 * cross / square * max(0.0, 1 - noise / (signal + 1e-12))
            u = array([cos(a) * u[0] - sin(a) * u[1], sin(a) * u[0] + cos(a) * u[1], u[2]])
        return self.turned(j, age * u)

    def trust(self):
        """The surest member first: p(b = 0 | all) / p(b = 0) by Bayes' rule, of Gaussians."""
        s, wide = self.state, TAU**2 + self.life.own
        b = s.belief
        while True:
            odds, narrow = {}, {}
            for j in (self.ego, *s.members):
                if j in s.trusted or (j not in s.last and j != self.ego):
                    continue
                at = b.at("b", j)
                x, p = b.x[at], b.p[at, at]
                odds[j] = log((1 - FAULTY_SHARE) / FAULTY_SHARE) - PENALTY * s.revoked.get(j, 0)
                own = min(self.life.own + self.usual(j), wide / 2)
                narrow[j] = own * wide / (wide - own)
                odds[j] += normal(x, narrow[j] * eye(3) + p) - normal(0 * x, wide * wide / (wide - own) * eye(3))
            best = max(odds, key=lambda j: (odds[j], -s.slot[j]), default=-1)
            if best < 0 or odds[best] <= TRUST_LOG_ODDS:
                return
            s.trusted.add(best)
            s.mean.pop(best, None)
            for c in range(3):
                b.update(b.row({("b", best): 1.0}, c), 0.0, max(narrow[best], 1e-6))
            if not self.life.own:
                b.drop(("b", best))


def normal(x, cov):
    """Logarithm of the density of N(0, cov)."""
    return float(-0.5 * (slogdet(2 * pi * cov)[1] + x @ solve(cov, x)))
