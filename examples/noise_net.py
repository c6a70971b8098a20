"""The filter of `coopoc.RoadFilter` in plain torch, in the plane, for many drives at once and with a gradient, and a
small net that sets its noise; `learned_noise.py` trains it."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

import coopoc as co
from coopoc.arrays import Floats
from coopoc.kernels.road import BELIEVED, LOUDEST, MOST_SCALE, SUDDEN
from coopoc.methods.road import RoadErrors, RoadFilter

MEMORIES = torch.tensor([5.0, 20.0, 100.0])
"""Fixes."""
Bounds = tuple[tuple[float, float], ...]
"""Logarithms of the least and the largest factor of R, Q, the noise of heading and scale, and the gate."""


class Drives(NamedTuple):
    """B drives of T steps in the plane: motion m and its variance m^2, fixes m (NaN: none), truth m (NaN: unknown), all
    (B, T, 2), lengths of the steps s (B, T), and the assumed variance m^2 of a fix (B, 2), without its factor."""

    moved: Tensor
    q: Tensor
    fix: Tensor
    truth: Tensor
    dt: Tensor
    r: Tensor


class State(NamedTuple):
    """Of B filters: begun (B,), x (B, 4), p (B, 4, 4), s since the last fix, level, factor of the covariance, number of
    fixes (B,), motion m since the last fix (B, 2), memories (B, 3, 7), last innovation (B, 2), and logarithms of the
    factors (B, 4)."""

    begun: Tensor
    x: Tensor
    p: Tensor
    since: Tensor
    level: Tensor
    scale: Tensor
    fixes: Tensor
    way: Tensor
    memory: Tensor
    last: Tensor
    factors: Tensor


class NoiseNet(nn.Module):
    """22 features -> logarithms of four factors within their bounds, 1 or next to it before training."""

    def __init__(self, bounds: Bounds, seed: int) -> None:
        super().__init__()
        torch.manual_seed(seed)
        self.layers = nn.Sequential(
            nn.Linear(22, 40), nn.Tanh(), nn.Linear(40, 32), nn.Tanh(), nn.Linear(32, 4)
        ).double()
        self.least, self.most = torch.tensor(bounds, dtype=torch.float64).T
        nn.init.zeros_(self.layers[-1].weight)
        nn.init.zeros_(self.layers[-1].bias)
        if self.least[0] > -0.1:  # where R cannot fall, it starts above 1: below there is no gradient
            nn.init.constant_(self.layers[-1].bias[:1], 0.3)

    def forward(self, features: Tensor) -> Tensor:
        out = self.layers(features)
        return torch.where(out >= 0, self.most * torch.tanh(out / self.most), self.least * torch.tanh(out / self.least))


def begin(count: int) -> State:
    def zeros(*shape: int) -> Tensor:
        return torch.zeros(count, *shape, dtype=torch.float64)

    none = torch.zeros(count, dtype=torch.bool)
    eye = torch.eye(4, dtype=torch.float64).expand(count, 4, 4)
    return State(
        none, zeros(4), eye, zeros(), 1 + zeros(), 1 + zeros(), zeros(), zeros(2), zeros(3, 7), zeros(2), zeros(4)
    )


def where(condition: Tensor, yes: Tensor, no: Tensor) -> Tensor:
    return torch.where(condition.view(-1, *[1] * (yes.dim() - 1)), yes, no)


def features(s: State, e: RoadErrors, r: Tensor) -> Tensor:
    """(B, 22): by memory the level, the bias, the correlation, the share that is believed and the direction of
    innovations; and the filter's own state in units of what it assumes."""
    square, east, north, product, believed, along, across = s.memory.unbind(-1)
    parts = [(0.05 + square).log(), 0.5 * (0.05 + east.square() + north.square()).log(), product / (0.2 + square)]
    parts += [2 * believed - 1, 0.5 * ((0.05 + along) / (0.05 + across)).log()]
    own = torch.diagonal(s.p, dim1=1, dim2=2)
    context = [0.5 * s.level.log(), 0.5 * (own[:, :2].sum(1) / r.sum(1)).log(), (0.05 + s.since).log() / 2]
    context += [0.5 * (0.01 + s.way.square().sum(1) / r.sum(1)).log() / 2, (1 + s.fixes).clamp(max=300).log() / 3]
    context += [0.5 * (own[:, 2] / e.heading**2).log(), 0.5 * (own[:, 3] / e.scale**2).log()]
    return torch.cat([*parts, torch.stack(context, 1)], 1)


def step(
    s: State, e: RoadErrors, net: NoiseNet | None, moved: Tensor, q: Tensor, fix: Tensor, dt: Tensor, r: Tensor
) -> State:
    """`kernels.road.road_step` in the plane, with the factors of the net."""
    louder, noisier, turning, wider = s.factors.exp().unbind(1)
    c, n, scale = s.x[:, 2].cos(), s.x[:, 2].sin(), 1 + s.x[:, 3]
    east, north = c * moved[:, 0] - n * moved[:, 1], n * moved[:, 0] + c * moved[:, 1]
    keep = torch.exp(-dt / e.lasts)
    f = torch.diag_embed(torch.stack([torch.ones_like(keep), torch.ones_like(keep), keep, keep], 1))
    f[:, :2, 2:] = torch.stack([-scale * north, east, scale * east, north], 1).view(-1, 2, 2)
    fades = (turning * (1 - keep * keep))[:, None] * torch.tensor([e.heading**2, e.scale**2], dtype=torch.float64)
    x = torch.cat([s.x[:, :2] + scale[:, None] * torch.stack([east, north], 1), keep[:, None] * s.x[:, 2:]], 1)
    p = f @ s.p @ f.mT + torch.diag_embed(torch.cat([noisier[:, None] * e.motion**2 * q, fades], 1))
    x, p = where(s.begun, x, s.x), where(s.begun, p, s.p)
    s = s._replace(x=x, p=p, since=s.since + dt, way=s.way + moved)
    seen = fix[:, 0].isfinite()
    if not seen.any():
        return s
    r = e.fix**2 * r
    first = torch.diag_embed(torch.cat([r, torch.tensor([[e.heading**2, e.scale**2]]).double().expand(len(r), 2)], 1))
    update, young = seen & s.begun, seen & ~s.begun
    safe = torch.where(update[:, None], fix, s.x[:, :2])
    gap = safe - s.x[:, :2]
    rho = torch.exp(-s.since / e.correlation)
    lasting = 1 + 2 * rho / (1 - rho).clamp(min=1e-6)
    base = s.level[:, None] * louder[:, None] * r
    gated = s.p[:, :2, :2] + torch.diag_embed(base * (1 / louder).clamp(min=1)[:, None])  # R below 1 tightens no gate
    white = torch.linalg.solve_triangular(torch.linalg.cholesky(gated), gap[..., None], upper=False)[..., 0]
    square = 0.5 * white.square().sum(1)
    w = (square / (e.gate * wider) ** 2).clamp(min=1)
    noise = torch.diag_embed((w * lasting)[:, None] * base)
    share = torch.stack([torch.ones_like(w), torch.ones_like(w), 1 / w, 1 / w], 1)[..., None]
    k = share * torch.linalg.solve(s.p[:, :2, :2] + noise, s.p[:, :2]).mT
    a = torch.eye(4, dtype=torch.float64).expand(len(k), 4, 4) - torch.cat([k, torch.zeros_like(k)], 2)
    x = s.x + (k @ gap[..., None])[..., 0]
    p = a @ s.p @ a.mT + k @ noise @ k.mT
    p = 0.5 * (p + p.mT)
    start = torch.cat([torch.where(young[:, None], fix, 0), torch.zeros_like(s.x[:, 2:])], 1)
    x, p = where(young, start, where(update, x, s.x)), where(young, first, where(update, p, s.p))
    with torch.no_grad():
        seen_by_filter = (s.fixes + BELIEVED + 1).clamp(max=e.window)
        scale = s.scale + (torch.minimum(square, SUDDEN * s.scale) - s.scale) / seen_by_filter
        believed = scale.clamp(e.least, MOST_SCALE) if e.least < 1 else s.scale
        level = (s.level * (1 + (square.clamp(max=SUDDEN) - 1) / e.window)).clamp(1, LOUDEST)
        v = white.clamp(-5, 5)
        ahead = nn.functional.normalize(s.way, dim=1)
        along, across = (v * ahead).sum(1).square(), (v[:, 0] * ahead[:, 1] - v[:, 1] * ahead[:, 0]).square()
        new = torch.stack([square.clamp(max=25), v[:, 0], v[:, 1], (v * s.last).sum(1) / 2, 1 / w, along, across], 1)
        rate = torch.maximum(1 / MEMORIES, 1 / (1 + s.fixes[:, None]))[..., None]
        memory = s.memory + rate * (new[:, None] - s.memory)
    s = s._replace(
        begun=s.begun | seen,
        x=x,
        p=p,
        level=where(update, level, s.level),
        scale=where(update, believed, s.scale),
        fixes=s.fixes + update,
        memory=where(update, memory, s.memory),
        last=where(update, v, s.last),
    )
    if net is not None:
        with torch.no_grad():
            known = features(s, e, r)
        s = s._replace(factors=where(seen, net(known), s.factors))
    return s._replace(since=torch.where(seen, 0.0, s.since), way=where(seen, torch.zeros_like(s.way), s.way))


def rolled(
    drives: Drives, e: RoadErrors, net: NoiseNet | None, s: State, at: slice
) -> tuple[State, Tensor, Tensor, Tensor]:
    """State after these steps, positions (B, t, 2) and covariances (B, t, 2, 2), NaN before the first fix, and
    logarithms of the factors (B, t, 4)."""
    xs, ps, factors = list[Tensor](), list[Tensor](), list[Tensor]()
    for moved, q, fix, dt in zip(*(part[:, at].unbind(1) for part in (*drives[:3], drives.dt)), strict=True):
        s = step(s, e, net, moved, q, fix, dt, drives.r)
        xs.append(where(s.begun, s.x[:, :2], torch.full_like(s.x[:, :2], torch.nan)))
        ps.append(s.scale[:, None, None] * s.p[:, :2, :2])
        factors.append(s.factors)
    return s, torch.stack(xs, 1), torch.stack(ps, 1), torch.stack(factors, 1)


@torch.no_grad()
def filtered(drives: Drives, e: RoadErrors, net: NoiseNet | None = None) -> tuple[Floats, Floats]:
    """Positions (B, T, 2) m and covariances (B, T, 2, 2) m^2."""
    _, x, p, _ = rolled(drives, e, net, begin(len(drives.fix)), slice(None))
    return x.numpy(), p.numpy()


@torch.no_grad()
def factors(drives: Drives, e: RoadErrors, net: NoiseNet) -> list[float]:
    """Geometric means of the factors of R, Q, the noise of heading and scale, and the gate."""
    return rolled(drives, e, net, begin(len(drives.fix)), slice(None))[3].mean((0, 1)).exp().tolist()


def drives_of(seen: co.Recording, truth: co.Fleet, columns: Sequence[int] | None = None) -> Drives:
    """Vehicles of a recording, one drive each; without columns all."""
    columns = range(len(seen.ids)) if columns is None else columns
    known = co.NoiseModel.nominal(seen.sensors)
    parts = seen.dt * seen.velocity[0], known.process_variance(seen)[0], seen.gnss[0], truth.position
    moved, q, fix, true = (torch.tensor(part[:, columns, :2].swapaxes(0, 1).copy()) for part in parts)
    dt, r = torch.full(fix.shape[:2], seen.dt, dtype=torch.float64), torch.tensor(known.gnss_variance[:2])
    return Drives(moved, q, fix, true, dt, r.repeat(len(columns), 1))


def compiled(seen: co.Recording, errors: RoadErrors, columns: Sequence[int]) -> tuple[Floats, Floats]:
    """The same as `filtered` by the library."""
    x, cov, _ = RoadFilter(errors=errors).filtered(seen, columns)
    return x[0].swapaxes(0, 1)[..., :2], cov[0].swapaxes(0, 1)[..., :2, :2]
