"""Cost and effect of differential privacy: RT-LE and a membership inference against epsilon."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib.metadata import version
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from coopoc.arrays import Floats
from coopoc.evaluate.scores import bounded_rt_le, rows_of
from coopoc.methods.kalman import Kalman
from coopoc.methods.track import Method
from coopoc.study.study import Params, Row, Study
from coopoc.world.sensors import Sensors

from . import lineup, scene, weights
from .privacy_views import FIGURES, TABLES, findings

if TYPE_CHECKING:
    from torch import Tensor

    from coopoc.learned.federation.history import Federation
    from coopoc.learned.privacy.differential import Privacy
    from coopoc.learned.training.clients import Client

EPSILONS = (1.0, 3.0, 10.0, 30.0, 100.0, math.inf)
FLEETS = ("town10-clients", "town04")
"""Four clients, the paper's, and sixty: the vehicles of a fleet that holds no test drive."""
LOST = 10.0
"""m, at which RT-LE is cut: the fixes alone have 6 m in scenario 2, and a filter may be 1e27 m away."""
ATTACKS = (("client", "loss"), ("client", "gradient"), ("aggregate", "loss"))
"""Updates that are seen, and score of a candidate."""


class Plan(NamedTuple):
    """Federation of a method at every epsilon, chosen on town10-validation: few rounds, as each costs privacy.

    `clip` is the largest; `bearable` is the noise (standard deviation over all rounds) that a weight stands.
    """

    clip: float
    bearable: float
    rounds: int
    local_epochs: int
    learning_rate: float
    weight_decay: float

    def clipped(self, noise_multiplier: float, clients: int) -> float:
        """The clip S at which the mean's noise over all rounds, sqrt(T) z S / C, is bearable: no data is looked at.

        >>> PLANS["okf"].clipped(4.0, 4) < PLANS["okf"].clipped(1.0, 60) == 0.3
        True
        """
        return min(self.clip, self.bearable * clients / (noise_multiplier * math.sqrt(self.rounds)))


PLANS = {"fedkalmannet": Plan(0.5, 0.008, 5, 5, 3e-3, 0.3), "okf": Plan(0.3, 0.4, 10, 1, 0.05, 0.0)}


class Trained(NamedTuple):
    """The federations of all training seeds, the clients of each, their updates (P,) by (seed, name) and round, and the
    price: clip, z of the sum, and the epsilon of a server that sees single updates."""

    federations: list[Federation]
    groups: list[tuple[Client, ...]]
    sent: dict[tuple[int, str], dict[int, Tensor]]
    price: dict[str, float]


class Tap:
    """Updates of the clients, recorded for the probe; protected before by `inner`, if given."""

    def __init__(self, inner: Privacy | None) -> None:
        self.inner = inner
        self.sent: dict[tuple[int, str], dict[int, Tensor]] = {}

    def protect(self, updates: Tensor, names: Sequence[str], seed: int, number: int) -> Tensor:
        """As `Privacy.protect`."""
        hidden = updates if self.inner is None else self.inner.protect(updates, names, seed, number)
        for name, update in zip(names, hidden, strict=True):
            self.sent.setdefault((seed, name), {})[number] = update
        return hidden

    def check(self, rule: Any) -> None:
        """As `Privacy.check`."""
        if self.inner is not None:
            self.inner.check(rule)


def cell(p: Params) -> list[Row]:
    """RT-LE per training seed, ego and run, and the AUC of each attack on membership; of a reference, RT-LE.

    The weights are those of the last round: to choose a round by the clients' validation losses is not private.
    """
    if p["method"] == "bound":
        return [{"measure": "rt_le", **row} for row in lineup.bound_rows(p)]
    if p["method"] == "kalman":
        return _scored(Kalman(weights.fitted(p)), p, "rt_le")
    made, method = trained(p), str(p["method"])
    found: list[Row] = []
    for seed, federation in enumerate(made.federations):
        last = federation.after(len(federation.history) - 1)
        found += _scored(last.method(method), p, "rt_le", train_seed=seed, **made.price)
        if p["epsilon"] == math.inf:
            found += _scored(federation.after(0).method(method), p, "untrained", train_seed=seed)
    return found + probed(made)


def trained(p: Params) -> Trained:
    """Federations of all training seeds with the cell's epsilon, equal weights and all clients in every round."""
    from coopoc.learned.federation.federated import Plan, federate_many
    from coopoc.learned.nets.gain_net import GainNet
    from coopoc.learned.nets.okf import NoiseParameters
    from coopoc.learned.privacy.differential import Privacy, auc_bound, epsilon, noise_for
    from coopoc.learned.training.clients import clients
    from coopoc.learned.training.schedule import Schedule

    net = GainNet if p["method"] == "fedkalmannet" else NoiseParameters
    plan, drives, delta = PLANS[p["method"]], scene.fleet(p["clients"]), float(p["delta"])
    acting, seeds = Sensors.paper_training(p["velocity_reading"]), weights.seeds(p)
    groups = [clients(drives, acting, seed=seed, start=scene.start(p)) for seed in seeds]
    z = noise_for(float(p["epsilon"]), plan.rounds, 1.0, delta)
    count = len(drives.ids)
    clip = plan.clipped(z, count) if z else math.inf
    tap = Tap(Privacy(clip, z, delta, count) if z else None)
    optimiser = Schedule(learning_rate=plan.learning_rate, weight_decay=plan.weight_decay)
    federation = Plan(plan.rounds, "uniform", plan.local_epochs, optimiser, privacy=tap)
    made = federate_many([net(seed=seed) for seed in seeds], groups, seeds, federation)
    alone = z / math.sqrt(count)
    price = {
        "clip": clip,
        "noise_multiplier": z,
        "ceiling": auc_bound(z, plan.rounds),
        "epsilon_alone": epsilon(alone, plan.rounds, 1.0, delta),
        "ceiling_alone": auc_bound(alone, plan.rounds),
    }
    return Trained(made, groups, tap.sent, price)


def probed(made: Trained) -> list[Row]:
    """A row per attack, over all clients and seeds.

    Members are a client's training pieces, others its validation pieces: the same vehicle, never trained on. Scores
    are compared within a client: shifted and scaled by their mean and spread over all its candidates.
    """
    from coopoc.learned.privacy.membership_inference import membership_inference

    rows: list[Row] = []
    for seen, score in ATTACKS:
        parts = [_standardised(*pair) for pair in _candidates(made, seen, score)]
        members, others = (np.concatenate(side) for side in zip(*parts, strict=True))
        found = membership_inference(members, others)
        row = {"measure": "probe", "run": 0, "ego": "all", "seen": seen, "score": score}
        numbers = {"auc": found.auc, "auc_low": found.low, "auc_high": found.high, "found_at_1_percent": found.found}
        rows.append({**row, **numbers, "members": found.members, "others": found.others})
    return rows


def _candidates(made: Trained, seen: str, score: str) -> Iterator[list[Floats]]:
    """Scores of members and others of every client and federation; zeros for a client that never sent an update."""
    from coopoc.learned.privacy.membership_inference import gradient_scores, loss_scores
    from coopoc.learned.training.clients import Segments

    straight = partial(gradient_scores, mirrors=False)
    judge: Callable[..., Floats] = loss_scores if score == "loss" else straight
    for seed, (federation, group) in enumerate(zip(made.federations, made.groups, strict=True)):
        thetas = [row.weights for row in federation.history]
        for client in group:
            sent = made.sent.get((seed, client.name), {})
            alone = [(thetas[number - 1], thetas[number - 1] + update) for number, update in sent.items()]
            steps = alone if seen == "client" else list(pairwise(thetas))
            both = Segments.join([client.training, client.validation])
            scores = judge(federation.model, steps, both) if steps else np.zeros(len(both))
            yield np.split(scores, [len(client.training)])


def _standardised(members: Floats, others: Floats) -> tuple[Floats, Floats]:
    both = np.concatenate([members, others])
    spread = float(both.std()) or 1.0
    return (members - both.mean()) / spread, (others - both.mean()) / spread


def _scored(method: Method, p: Params, measure: str, **more: Any) -> list[Row]:
    """Rows of RT-LE, at most LOST."""
    trial = scene.trial(p)
    return rows_of({"rt_le_m": bounded_rt_le(method, *trial, LOST)}, trial[1], measure=measure, **more)


def key(p: Params) -> dict[str, str]:
    """Digests that change the numbers beyond the parameters: data, code, and the library that trains."""
    return {**scene.facts(p), "clients": scene.fleet(p["clients"]).digest, "torch": version("torch")}


def _grid() -> list[dict[str, Any]]:
    """Both methods at every epsilon with few and with many clients, and the references."""
    grid = [{"clients": c, "method": m, "epsilon": e} for c in FLEETS for m in PLANS for e in EPSILONS]
    return [*grid, *({"clients": FLEETS[0], "method": m, "epsilon": math.inf} for m in ("kalman", "bound"))]


STUDY = Study(
    "privacy",
    "What does a client-level (epsilon, delta) cost in accuracy, and what does it hide from membership inference?",
    cell=cell,
    key=key,
    grid=_grid(),
    settings={
        **scene.DRAWN,
        **scene.SOLO,
        "scenario": 2,
        "velocity_ratio": 0.15,
        "runs": 10,
        "train_seeds": 3,
        "delta": 1e-5,
    },
    tables=TABLES,
    figures=FIGURES,
    findings=findings,
    limitations=(
        "Rounds, rates, the largest clip and the noise that a weight bears were chosen on another fleet, and epsilon "
        "does not count that choice. The clip follows from them, epsilon and the number of clients.",
        "Epsilon is of the sum of the updates, as a server under secure aggregation or an outsider sees it; the table "
        "has that of a server that sees single updates.",
        "The pieces of a vehicle follow each other in one drive, so the probe's intervals, which take them as "
        "independent, are somewhat narrow; and noise has the same draws at every epsilon, so that one chance effect "
        "shows at several of them. A probe that fails proves nothing; epsilon is the guarantee.",
        "Noise is drawn in floating point, whose rounding can leak (Mironov, CCS 2012); a hardened build samples a "
        "discrete Gaussian.",
    ),
    minutes=15,
    metrics={"rt_le_m": "lower"},
    reference=lineup.reference("privacy"),
)
