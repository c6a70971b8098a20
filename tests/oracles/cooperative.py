"""The cooperative filter with dense matrices and one number at a time, one run.

State: named vectors, ("x", j) position, ("b", j) error of fixes, ("v", j) velocity and ("c", j) clone of vehicle j,
("common",) and ("compass",). A number z = h x + noise beyond its gate has its innovation's variance multiplied by
q / gate, and by 100 more beyond four times the gate.
"""

from __future__ import annotations

import copy
import math
from typing import Any, NamedTuple

import numpy as np

from coopoc import NoiseModel, Recording
from coopoc.arrays import Floats
from coopoc.kernels.stars.cooperative_state import Guards
from coopoc.world.inbox import inbox
from coopoc.world.links import spherical, to_vector, wrap
from coopoc.world.v2x import FIX_AND_VELOCITY
from oracles import solo

FLAT, NOWHERE = 1e6, 1e4
Name = tuple[Any, ...]


class Belief:
    """A Gaussian of named vectors."""

    def __init__(self) -> None:
        self.names: list[Name] = []
        self.x, self.p = np.zeros(0), np.zeros((0, 0))

    def at(self, name: Name) -> slice:
        k = self.names.index(name)
        return slice(3 * k, 3 * k + 3)

    def add(self, name: Name, mean: Any, variance: Any) -> None:
        n = len(self.x)
        p = np.zeros((n + 3, n + 3))
        p[:n, :n], p[n:, n:] = self.p, np.diag(np.broadcast_to(variance, 3))
        self.names.append(name)
        self.x, self.p = np.append(self.x, np.broadcast_to(mean, 3)), p

    def transform(self, name: Name, terms: dict[Name, float]) -> None:
        """The vector becomes a sum of others."""
        f = np.eye(len(self.x))
        f[self.at(name)] = 0
        for other, factor in terms.items():
            f[self.at(name), self.at(other)] = factor * np.eye(3)
        self.x, self.p = f @ self.x, f @ self.p @ f.T

    def drop(self, name: Name) -> None:
        if name in self.names:
            keep = np.ones(len(self.x), bool)
            keep[self.at(name)] = False
            self.names.remove(name)
            self.x, self.p = self.x[keep], self.p[np.ix_(keep, keep)]

    def noise(self, name: Name, variance: Any) -> None:
        at = self.at(name)
        self.p[at, at] += np.diag(np.broadcast_to(variance, 3))

    def row(self, terms: dict[Name, Any], axis: int) -> Floats:
        """h of one number: a vector's factor is one for its axis, or three for its numbers."""
        h = np.zeros(len(self.x))
        for name, factor in terms.items():
            if np.ndim(factor):
                h[self.at(name)] = factor
            else:
                h[self.at(name).start + axis] = factor
        return h

    def update(self, h: Floats, z: float, r: float, gate: float = 0.0) -> float:
        innovation, s = z - h @ self.x, h @ self.p @ h + r
        q = float(innovation**2 / s)
        if gate and q > gate:
            s *= q / gate * (100.0 if q > 4 * gate else 1.0)
        gain = self.p @ h / s
        self.x, self.p = self.x + gain * innovation, self.p - np.outer(gain, gain) * s
        return q


class Sent(NamedTuple):
    """A message: step, position, its variance, odometer, velocity, variance of one step's motion; (3,) each."""

    step: int
    estimate: Floats
    variance: Floats
    odometer: Floats
    velocity: Floats
    process: Floats


class Life(NamedTuple):
    """Parameters of lasting errors: own and common m^2, their correlation of a step, compass bias and noise rad^2."""

    own: float
    common: float
    keep: float
    bias: float
    heading: float


class Oracle:
    """The filter of one ego in one run; `loop` goes back where a member has lost trust."""

    def __init__(self, seen: Recording, ego: int, run: int, known: NoiseModel, guards: Guards, robust: bool) -> None:
        s = known.sensors
        self.seen, self.ego, self.run, self.known, self.guards, self.robust = seen, ego, run, known, guards, robust
        self.life, self.std, self.white = Life(0, 0, 1, 0, 0), np.ones(3), np.ones(3)
        if s is not None:
            self.std = s.relative_std.copy()
        if robust and s is not None:
            heading, bias = (float(v**2) for v in known.compass)
            keep = math.exp(-seen.dt / s.gnss_drift_time)
            self.life = Life(s.gnss_drift_std**2, s.gnss_common_std**2, keep, bias, heading)
            self.std[1] = math.sqrt(self.std[1] ** 2 - heading - bias)
            self.white = np.square(s.gnss_std) / np.square(s.fix_std)
        shape = seen.gnss.shape
        self.q = np.broadcast_to(known.process_variance(seen), shape)[run]
        self.r = np.broadcast_to(known.fix_variance(seen), shape)[run]
        self.position, self.variance = seen.gnss[run].copy(), self.r.copy()
        if robust:
            for j in range(shape[2]):
                for c in range(3):
                    one = seen.gnss[run, :, j, c], seen.velocity[run, :, j, c], self.q[:, j, c]
                    self.position[:, j, c], self.variance[:, j, c] = solo.kalman(*one, self.r[0, j, c], seen.dt)
        self.odometer = np.cumsum(np.nan_to_num(seen.dt * seen.velocity[run]), axis=0)
        self.betrayed: dict[int, list[float]] = {}
        self.box = inbox(seen, ego, FIX_AND_VELOCITY)
        self.state: dict[str, Any] = {
            "belief": Belief(),
            "members": [],
            "trusted": set(range(shape[2])) if not guards.trust else {ego},
            "last": {},
            "serves": {},
            "joined": {},
            "hits": {},
            "mean": {},
            "kept": {},
        }

    def loop(self) -> tuple[Floats, Floats, list[Floats]]:
        """x (T, 3), covariance (T, 3, 3), neighbours (k, 3) of each step."""
        memory, steps = int(self.guards.memory), len(self.seen.t)
        older = newer = (0, copy.deepcopy(self.state))
        found: list[Any] = []
        t = 0
        while t < steps:
            if memory and t % memory == 0:
                older = newer if t == len(found) else older
                newer = t, copy.deepcopy(self.state)
            alarm = self.step(t)
            if alarm and memory:
                t, self.state = older[0], copy.deepcopy(older[1])
                newer = older
                self.distrust(t)
                continue
            if t == len(found):
                b = self.state["belief"]
                x = b.at(("x", self.ego))
                found.append(copy.deepcopy((b.x[x], b.p[x, x], [b.x[b.at(("x", j))] for j in self.neighbours(t)[1]])))
            t += 1
        others = [np.array(o).reshape(-1, 3) for *_, o in found]
        return np.array([x for x, *_ in found]), np.array([p for _, p, _ in found]), others

    def neighbours(self, t: int) -> tuple[Any, list[int]]:
        """Links of a step, and the columns that they join."""
        here = np.arange(self.box.start[t], self.box.start[t + 1])
        return here, self.seen.links.neighbour[self.box.link[here]].tolist()

    def message(self, link: int, j: int) -> Sent | None:
        """The newest one that is held."""
        s = int(self.box.newest[self.run, link])
        if s < 0:
            return None
        velocity = self.seen.velocity[self.run, s, j]
        return Sent(s, self.position[s, j], self.variance[s, j], self.odometer[s, j], velocity, self.q[s, j])

    def step(self, t: int) -> bool:
        s, g, dt = self.state, self.guards, self.seen.dt
        b, life = s["belief"], self.life
        here, others = self.neighbours(t)
        links = dict(zip(others, here.tolist(), strict=True))
        messages = {j: self.message(link, j) for j, link in links.items()}
        relative = {j: self.seen.relative[self.run, self.box.link[link]] for j, link in links.items()}
        for j in [j for j in s["members"] if j not in others]:
            if ("b", j) in b.names:
                at = b.at(("b", j))
                s["kept"][j] = b.x[at].copy(), np.maximum(np.diag(b.p)[at], 0.01)
            for kind in "xbvc":
                b.drop((kind, j))
            s["members"].remove(j)
        if t == 0:
            b.add(("x", self.ego), self.seen.gnss[self.run, 0, self.ego], FLAT)
            if life.own:
                b.add(("b", self.ego), 0, life.own)
            if life.common:
                b.add(("common",), 0, life.common)
            if life.bias + life.heading:
                b.add(("compass",), 0, [life.bias, 0, 0])
        else:
            self.predict(t)
        for j in s["members"]:
            self.predict_member(t, j, messages[j])
        for j in [j for j in others if j not in s["members"]]:
            self.join(t, j, messages[j], relative[j])
        at = {j: b.x[b.at(("x", j))].copy() for j in (self.ego, *others)}
        fix = self.seen.gnss[self.run, t, self.ego]
        if np.isfinite(fix).all():
            self.update(
                ("fix",),
                [(self.fix_terms(self.ego), fix[c], self.r[t, self.ego, c] * self.white[c]) for c in range(3)],
                g.fix_gate,
            )
        order = sorted(s["members"], key=lambda j: s["slot"][j])
        alarm = False
        if self.robust:
            self.measure(at, order, relative)
        for j in order:
            alarm |= self.receive(t, j, messages[j], relative[j], at)
        if not self.robust:
            self.measure(at, order, relative)
        if g.trust:
            self.trust(dt)
        return alarm

    def update(self, key: Name, rows: list[Any], gate: float) -> list[float]:
        """Numbers one after the other, each with its count of hits; terms, z and r of None were not measured."""
        hits = self.state["hits"].setdefault(key, [0] * len(rows))
        allowed = [gate if n < self.guards.patience else 0.0 for n in hits]
        b, found = self.state["belief"], []
        for c, row in enumerate(rows):
            if row is None:
                found.append(math.nan)
                continue
            q = b.update(b.row(row[0], c), row[1], row[2], allowed[c])
            hits[c] = hits[c] + 1 if gate and q > gate else 0
            found.append(q)
        return found

    def fix_terms(self, j: int) -> dict[Name, float]:
        names = [("x", j), ("b", j), ("common",)]
        return {name: 1.0 for name in names if name in self.state["belief"].names}

    def predict(self, t: int) -> None:
        b, life = self.state["belief"], self.life
        at = b.at(("x", self.ego))
        b.x[at] += self.seen.dt * self.seen.velocity[self.run, t, self.ego]
        b.noise(("x", self.ego), self.q[t, self.ego])
        for name in b.names:
            if name[0] == "b" and life.own:
                if name[1] in self.state["trusted"]:
                    b.transform(name, {name: life.keep})
                b.noise(name, life.own * (1 - life.keep**2))
        if life.common:
            b.transform(("common",), {("common",): life.keep})
            b.noise(("common",), life.common * (1 - life.keep**2))

    def late(self, j: int, message: Sent | None, t: int) -> None:
        """A member whose newest message is not of now gets a velocity."""
        b, prompt = self.state["belief"], message is not None and message.step == t
        if self.guards.acceleration and not prompt and ("v", j) not in b.names:
            b.add(("v", j), 0.0 if message is None else message.velocity, 100.0)

    def predict_member(self, t: int, j: int, message: Sent | None) -> None:
        s, dt = self.state, self.seen.dt
        b = s["belief"]
        if j not in s["trusted"]:
            b.noise(("b", j), self.guards.wander**2 * dt)
        self.late(j, message, t)
        if ("v", j) in b.names:
            b.noise(("v", j), (self.guards.acceleration * dt) ** 2)
            b.transform(("x", j), {("x", j): 1.0, ("v", j): dt})
            return
        if message is None:
            s["serves"][j] = -1, 0
            b.noise(("x", j), FLAT)
            return
        before, times = s["serves"][j]
        times = times + 1 if before == message.step else 1
        s["serves"][j] = message.step, times
        b.x[b.at(("x", j))] += dt * message.velocity
        b.noise(("x", j), (2 * times - 1) * (message.process + (dt**2 * (t - message.step)) ** 2))

    def join(self, t: int, j: int, message: Sent | None, relative: Floats) -> None:
        s = self.state
        b = s["belief"]
        taken = {s["slot"][i] for i in s["members"]} if s["members"] else set()
        s.setdefault("slot", {})[j] = next(k for k in range(1, 10**6) if k not in taken)
        s["members"].append(j)
        s["joined"][j], s["hits"][("relative", j)] = t, [0, 0, 0]
        s["serves"][j] = (-1 if message is None else message.step), 1
        near = 1 + (0.0 if np.isnan(relative[0]) else relative[0])
        gap = to_vector(relative) if np.isfinite(relative).all() else np.array([near, near, 0.1 * near])
        b.add(("x", j), b.x[b.at(("x", self.ego))] + gap, FLAT)
        if j not in s["trusted"]:
            mean, variance = s["kept"].get(j, (np.zeros(3), np.full(3, self.guards.tau**2)))
            b.add(("b", j), mean, variance + self.life.own)
        elif self.life.own:
            b.add(("b", j), 0.0, self.life.own)

    def measure(self, at: dict[int, Floats], order: list[int], relative: dict[int, Floats]) -> None:
        """At the prediction, forgotten but for the solution; then at that solution."""
        s = self.state
        b = s["belief"]
        if not order:
            return
        if ("compass",) in b.names:
            i = b.at(("compass",)).start + 1
            b.x[i], b.p[i], b.p[:, i] = 0.0, 0.0, 0.0
            b.p[i, i] = self.life.heading
        exact = self.known.exact_relative
        if exact:
            kept, hits = copy.deepcopy(b), copy.deepcopy(s["hits"])
            for j in order:
                self.relate(j, at, relative[j], False, kept)
            at = {j: b.x[b.at(("x", j))].copy() for j in (self.ego, *order)}
            s["belief"], s["hits"] = kept, hits
            b = kept
        for j in order:
            self.relate(j, at, relative[j], exact, b)

    def relate(self, j: int, at: dict[int, Floats], relative: Floats, exact: bool, before: Belief) -> None:
        b, there = self.state["belief"], np.isfinite(relative)
        if not there.all() and b.p[b.at(("x", j)), b.at(("x", j))][0, 0] >= NOWHERE:
            return
        gap, unit = at[j] - at[self.ego], self.known.sensors is None
        expected = np.array(spherical(*gap))
        far, azimuth, inclination = expected
        ground, least = math.hypot(gap[0], gap[1]), 0.0 if unit else self.known.sensors.min_range  # type: ignore[union-attr]
        reach = max(far, least)
        flat = max(ground, 1e-3 * reach)
        sa, ca, si, ci = math.sin(azimuth), math.cos(azimuth), math.sin(inclination), math.cos(inclination)
        if exact:
            rows = np.array(
                [
                    gap / far,
                    [-gap[1] / flat**2, gap[0] / flat**2, 0],
                    [gap[0] * gap[2] / (flat * reach**2), gap[1] * gap[2] / (flat * reach**2), -flat / reach**2],
                ]
            )
            residual = relative - expected
            residual[1:] = wrap(residual[1:])
            z, r, turn = residual + rows @ gap, self.std**2, 1.0
        else:
            rows = np.array([[ca * si, sa * si, ci], [-sa, ca, 0], [ca * ci, sa * ci, -si]])
            z = rows @ to_vector(np.where(there, relative, expected))
            r = np.ones(3) if unit else (self.std * [1.0, reach * ground / far, reach]) ** 2
            turn = ground
        listed: list[Any] = []
        for c in range(3):
            terms: dict[Name, Any] = {("x", j): rows[c], ("x", self.ego): -rows[c]}
            if c == 1 and ("compass",) in b.names:
                terms[("compass",)] = np.array([turn, turn, 0.0])
            listed.append((terms, z[c], r[c]) if there[c] else None)
        self.update(("relative", j), listed, self.guards.gate)

    def receive(self, t: int, j: int, message: Sent | None, relative: Floats, at: dict[int, Floats]) -> bool:
        s, g, dt = self.state, self.guards, self.seen.dt
        b = s["belief"]
        self.late(j, message, t)
        last = s["last"].get(j)
        if message is None or (last and message.step <= last.step) or not np.isfinite(message.estimate).all():
            return False
        age, x = t - message.step, b.at(("x", j))
        if b.p[x, x][0, 0] >= NOWHERE and (not np.isfinite(relative).all() or s["joined"][j] < t):
            b.x[x] = at[j] = message.estimate + age * dt * message.velocity
        tracked, before = ("v", j) in b.names, self.robust and last is not None
        clone, late = before and ("c", j) in b.names, 0.0
        if tracked:
            late = (0.5 * g.acceleration * (age * dt) ** 2) ** 2
            r = message.process / dt**2 + (g.acceleration * age * dt) ** 2
            for c in range(3):
                b.update(b.row({("v", j): 1.0}, c), message.velocity[c], r[c])
        steps = message.step - last.step if before else 0
        moved = message.odometer - last.odometer if before else np.zeros(3)
        spent = 0.5 * steps * (message.process + last.process) if before else np.zeros(3)
        back = {("v", j): -age * dt} if tracked else {}
        if clone:
            for c in range(3):
                b.update(b.row({("x", j): 1.0, **back, ("c", j): -1.0}, c), moved[c], spent[c] + late)
        rows: list[Any] = []
        for c in range(3):
            m, r, middle, terms = message.estimate[c], message.variance[c], 1.0, dict(self.fix_terms(j)) | back
            if before:
                way = message.process[c] + 0.5 * (steps - 1) * (message.process[c] + last.process[c])
                said = between(
                    m, r, last.estimate[c] + moved[c], last.variance[c], way, steps, self.r[message.step, j, c]
                )
                if said is None:
                    rows.append(None)
                    continue
                m, r, walk, middle = said
                r = r * self.white[c] + walk
                if clone:
                    m += (middle - 1) * moved[c]
                    terms |= {("x", j): middle, ("c", j): 1 - middle}
                    terms |= {name: middle * factor for name, factor in back.items()}
                else:
                    r += (1 - middle) ** 2 * way
            if not tracked:
                m += age * dt * message.velocity[c]
                r += age**2 * (message.process[c] + (dt**2 * age) ** 2)
            rows.append((terms, m, r + late))
        alarm = bool(before and g.trust and j in s["trusted"] and self.suspicious(j, rows))
        if alarm:
            self.betrayed[j] = [self.betrayed.get(j, [0, 0])[0] + 1, t]
        if j in self.betrayed and t <= self.betrayed[j][1]:
            rows = [None] * 3
        for c, row in enumerate(rows):
            if row is not None:
                b.update(b.row(row[0], c), row[1], row[2], g.fix_gate if before or not self.robust else 0.0)
        s["last"][j] = message
        if tracked:
            b.drop(("c", j))
            b.add(("c", j), 0.0, 0.0)
            b.transform(("c", j), {("x", j): 1.0, **back})
            b.noise(("c", j), late + 1e-12)
        return alarm

    def suspicious(self, j: int, rows: list[Any]) -> bool:
        """The clipped mean innovation of a trusted member, beside what an error of its fixes would make of it."""
        s, g = self.state, self.guards
        b, (count, mean) = s["belief"], s["mean"].get(j, (0.0, np.zeros(3)))
        count, odds = min(count + 1, g.window), math.log((1 - g.share) / g.share)
        for c, row in enumerate(rows):
            if row is None:
                continue
            gap, p = row[1] - b.row(row[0], c) @ b.x, b.p[b.at(("x", j)), b.at(("x", j))][c, c]
            far = 3 * math.sqrt(p + row[2])
            mean[c] += (np.clip(gap, -far, far) - mean[c]) / count
            v = p + row[2] / count + (1.0 if self.life.own else 0.0)
            odds += normal(mean[c], v) - normal(mean[c], v + g.tau**2)
        s["mean"][j] = count, mean
        return odds < -g.revoke and count >= 3

    def distrust(self, t: int) -> None:
        s = self.state
        for j, (_, until) in self.betrayed.items():
            if until >= t and j in s["trusted"]:
                s["trusted"].remove(j)
                s["mean"].pop(j, None)
                s["kept"].pop(j, None)
                if j in s["members"]:
                    s["belief"].drop(("b", j))
                    s["belief"].add(("b", j), 0.0, self.guards.tau**2 + self.life.own)

    def trust(self, dt: float) -> None:
        """The surest member first: p(b = 0 | all) / p(b = 0) by Bayes' rule, of Gaussians."""
        s, g, own = self.state, self.guards, self.life.own
        b, wide = s["belief"], g.tau**2 + own
        narrow = 1 / (1 / own - 1 / wide) if own else 1e-6
        while True:
            odds = {}
            for j in s["members"]:
                if j in s["trusted"] or j not in s["last"]:
                    continue
                odds[j] = math.log((1 - g.share) / g.share) - g.grudge * self.betrayed.get(j, [0, 0])[0]
                at = b.at(("b", j))
                for x, p in zip(b.x[at], np.diag(b.p)[at], strict=True):
                    if own:
                        odds[j] += normal(x, narrow + p) + 0.5 * math.log(2 * math.pi * wide / own * narrow)
                    else:
                        odds[j] += normal(x, p) - normal(0.0, wide)
            best = max(odds, key=lambda j: (odds[j], -s["slot"][j]), default=-1)
            if best < 0 or odds[best] <= g.sure:
                return
            s["trusted"].add(best)
            s["mean"].pop(best, None)
            for c in range(3):
                b.update(b.row({("b", best): 1.0}, c), 0.0, narrow)
            if not own:
                b.drop(("b", best))


def normal(x: float, variance: float) -> float:
    """Logarithm of the density of N(0, variance)."""
    return -0.5 * (math.log(2 * math.pi * variance) + x * x / variance)


def between(
    now: float, p: float, carried: float, p0: float, spent: float, steps: int, fix: float
) -> tuple[float, float, float, float] | None:
    """The fixes between two estimates of a Kalman filter, as one: estimate = keep carried + (1 - keep) m with
    keep = prod (1 - K_i)."""
    if p > p0 + 2 * spent + 1e-9:
        return now, p, 0.0, 1.0
    parts = min(steps, 50)
    after = p0 + (p - p0) * (np.arange(parts) + 1) / parts
    before = np.append(p0, after[:-1])
    taken = -np.log(np.minimum(after / (before + spent / parts), 1)).sum()
    usual = -steps / parts * np.log(np.maximum(1 - after / fix, 1e-3)).sum()
    if steps > 1 and 2 * taken > usual:
        taken = usual
    new, k = 1 - math.exp(-taken), 1 - math.exp(-taken / steps)
    if new < 1e-9:
        return None
    white = after.mean() / k * k / (2 - k) * (2 - new) / new
    middle = min(max(1 / new - (1 - k) / (k * steps), 0.5), 1.0) if steps > 1 else 1.0
    return carried + (now - carried) / new, white, spent * (steps - 1 / steps) / (12 * steps), middle
