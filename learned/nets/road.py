"""RoadConstants: the eight numbers of a road filter as a net, learned alone, together or centralised."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from coopoc.arrays import Floats, seed_of
from coopoc.errors import InputError
from coopoc.kernels.motion import own_variances
from coopoc.kernels.road import run_road
from coopoc.kernels.solo import SoloMeasurements
from coopoc.methods.noise_model import NoiseModel, motion_noise
from coopoc.methods.road import RoadErrors, RoadFilter, from_logs, louder, road_noise, to_logs, true_cost
from coopoc.world.sensors import Sensors

from ..training.clients import Batch
from .gain import Gain
from .stack import flatten

START = RoadErrors(fix=1.5, motion=1.0, correlation=2.0, gate=2.0, heading=0.1, scale=0.03, lasts=300.0, window=50.0)
"""Set by hand."""
KNOWN = NoiseModel.nominal(Sensors())
"""What a log without standard deviations is taken to have; what is learned are factors of it."""
STEP = 0.02
"""Of the logarithms, between which a difference is the gradient."""


class RoadConstants(Gain):
    """The eight numbers of `RoadErrors` as logarithms: a federation of road filters exchanges 32 bytes.

    The loss is `methods.road.true_cost` of the compiled filter; eight weights need no backpropagation, and have the
    gradient of central differences.

    Args:
        seed: without effect, every net has this argument; the start is the same for each.

    >>> round(RoadConstants().method("road").errors.gate, 6)
    2.0
    """

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        seed_of(seed)
        self.logs = nn.Parameter(torch.tensor(to_logs(START), dtype=torch.float32))

    def losses(self, theta: Tensor, batch: Batch) -> Tensor:
        """(S, B) cost of each segment."""
        fixes = torch.cat([batch.x0[None], batch.gnss]).double().numpy()
        velocity = torch.cat([batch.velocity[:1], batch.velocity]).double().numpy()
        truth = batch.truth.double().numpy()
        found = np.empty(fixes.shape[1:3])
        for s, logs in enumerate(theta.detach().double().numpy()):
            gnss, speed = (np.ascontiguousarray(part[:, s].swapaxes(0, 1))[:, :, None] for part in (fixes, velocity))
            errors, motion = from_logs(logs, 1.0), motion_noise(KNOWN, None)
            process = own_variances(louder(motion, errors), speed, batch.dt)
            seen = SoloMeasurements(gnss, speed, process, np.array([0]), batch.dt)
            x, cov, lasting = (np.empty((*gnss.shape[:3], *size)) for size in ((3,), (3, 3), (4,)))
            run_road(seen, road_noise(KNOWN, errors), x, cov, lasting)
            found[s] = true_cost(x[:, 1:, 0], cov[:, 1:, 0], truth[:, s].swapaxes(0, 1))
        return torch.from_numpy(found).to(theta.dtype)

    def loss_and_gradient(self, theta: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
        """Loss (S,) and its gradient (S, 8)."""
        at, gradient = theta.detach().double(), torch.zeros_like(theta)
        for k in range(theta.shape[1]):
            ahead, behind = (at.index_add(1, torch.tensor([k]), torch.full_like(at[:, :1], d)) for d in (STEP, -STEP))
            gradient[:, k] = (self.losses(ahead, batch) - self.losses(behind, batch)).mean(1) / (2 * STEP)
        return self.losses(theta, batch).mean(1), gradient

    def method(self, name: str, x0: Floats | None = None) -> RoadFilter:
        """`RoadFilter` with these numbers.

        Raises:
            InputError: an exact start, which it does not take.
        """
        if x0 is not None:
            raise InputError("x0", "a known start", "is not taken by a road filter", "Take start=gnss.")
        return RoadFilter(errors=from_logs(flatten([self])[0].double().numpy()), name=name)
