"""GainNet's training and inference: plain torch and the compiled engine, in one run.

    python benchmarks/learned_gain.py            # a Markdown table on stdout, about a minute

All rows use the same net and the same drives (town10-clients, pieces of 100 steps) on one thread unless stated, one
after the other in every round; the ratios are to be compared, the times are this machine's. "Plain torch" is the loop
of KalmanNet's public training code re-expressed with our reference module: one Python step after the other, autograd,
and torch.optim.AdamW. A row counts only if its answer is the reference's."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from timing import report
from torch import Tensor

import coopoc as co
from coopoc.learned.nets.gain import Recurrent, flatten
from coopoc.learned.nets.gain_net import GainNet
from coopoc.learned.training.clients import Segments, clients
from coopoc.learned.training.fit import descend
from coopoc.learned.training.schedule import Schedule, one_core

ROUNDS = 5
RATE = 1e-3
SCHEDULE = Schedule(learning_rate=RATE, weight_decay=0.3, clip=1e9, mirror=False)


class Row(NamedTuple):
    """One way to do the job: its words, trajectory-steps per call, the call, and whether its answer is right."""

    words: str
    steps: int
    call: Callable[[], Any]
    error: float
    """Difference from plain torch: the largest of positions in m, or that of all but a thousandth of the trained
    weights. Where a gradient is below the rounding of 32 bits, its sign is not defined, and AdamW's first steps are of
    full length."""


def timed(call: Callable[[], Any]) -> float:
    """Seconds per call, of as many calls as take a tenth of a second: a short one alone would find cold caches."""
    calls, spent, began = 0, 0.0, time.perf_counter()
    while spent < 0.1:
        call()
        calls, spent = calls + 1, time.perf_counter() - began
    return spent / calls


def plain_training(net: GainNet, pieces: Segments, plan: np.ndarray) -> Tensor:
    """Weights (P,) after one optimiser step per row of the plan (steps, batch)."""
    mine = GainNet(**net.settings)
    mine.load_state_dict(net.state_dict())
    optimiser = torch.optim.AdamW(mine.parameters(), lr=RATE, weight_decay=SCHEDULE.weight_decay)
    for index in plan:
        batch = pieces.batch(torch.from_numpy(index)[None])
        gnss, velocity, truth = (a[:, 0].transpose(0, 1) for a in (batch.gnss, batch.velocity, batch.truth))
        optimiser.zero_grad()
        found = Recurrent.forward(mine, gnss, velocity, batch.x0[0], batch.dt)
        (found - truth).square().sum(-1).mean().backward()
        optimiser.step()
    return flatten([mine])[0]


def our_training(net: GainNet, pieces: Segments, plans: list[np.ndarray]) -> Tensor:
    """The same (S, P) for S nets that all start as this one, each with its plan."""
    theta, rates = flatten([net] * len(plans)), [np.full(len(plan), RATE) for plan in plans]
    draws = [torch.Generator() for _ in plans]
    for _ in descend(theta, net, pieces, plans, rates, SCHEDULE, draws, {}):
        pass
    return theta


def training(net: GainNet, pieces: Segments) -> list[Row]:
    """One pass over the pieces, or for plain torch at batch 1 over a few."""
    count, length = len(pieces), pieces.gnss.shape[1] - 1
    order = np.arange(count)
    one, few, full = order[:, None], order[:4, None], order[None]
    four = [part.reshape(-1, count // 6) for part in np.split(np.tile(order, 4), 4)]
    many = [np.roll(order, s)[:36].reshape(-1, 2) for s in range(35)]
    rows = [
        Row("plain torch, batch 1", len(few) * length, lambda: plain_training(net, pieces, few), 0.0),
        Row(f"plain torch, batch {count}", count * length, lambda: plain_training(net, pieces, full), 0.0),
    ]
    ours = [
        ("engine, batch 1", [one], [few]),
        (f"engine, batch {count}", [full], [full]),
        (f"engine, 4 nets x batch {count // 6}", four, [p[:2] for p in four]),
        ("engine, 35 nets x batch 2", many, [p[:2] for p in many[:3]]),
    ]
    for words, plans, checked in ours:
        wanted = torch.stack([plain_training(net, pieces, plan) for plan in checked])
        error = float((our_training(net, pieces, checked) - wanted).abs().quantile(0.999))
        total = sum(plan.size for plan in plans) * length
        rows.append(Row(words, total, lambda plans=plans: our_training(net, pieces, plans), error))
    return rows


def inference(net: GainNet, drive: Segments) -> list[Row]:
    """One drive of 900 steps, and 128 of them at once."""
    batch, theta = drive.batch(torch.zeros(1, 1, dtype=torch.long)), flatten([net])
    gnss, velocity, x0 = batch.gnss[:, 0].transpose(0, 1), batch.velocity[:, 0].transpose(0, 1), batch.x0[0]
    one = batch.gnss, batch.velocity, batch.x0
    many = [a.expand(*a.shape[:-2], 128, 3).contiguous() for a in one]
    wanted, length = Recurrent.forward(net, gnss, velocity, x0, batch.dt).transpose(0, 1), gnss.shape[1]
    rows = [Row("plain torch, 1 drive", length, lambda: Recurrent.forward(net, gnss, velocity, x0, batch.dt), 0.0)]
    for words, inputs in (("engine, 1 drive", one), ("engine, 128 drives", many)):
        found = net.rollout(theta, *inputs, batch.dt)[:, 0]
        error, steps = float((found - wanted).abs().max()), length * found.shape[1]
        rows.append(Row(words, steps, lambda inputs=inputs: net.rollout(theta, *inputs, batch.dt), error))
    return rows


def seconds(rows: list[Row]) -> dict[str, float]:
    """Per trajectory-step, medians of interleaved rounds."""
    spent: dict[str, list[float]] = {row.words: [] for row in rows}
    for _ in range(ROUNDS):
        for row in rows:
            spent[row.words].append(timed(row.call) / row.steps)
    return {words: float(np.median(times)) for words, times in spent.items()}


def parts() -> tuple[GainNet, Segments, Segments]:
    """The net, what it trains on and the drive that it follows."""
    group = clients(co.load_fleet("town10-clients"))
    pieces = Segments.join([c.training for c in group])
    return GainNet(), pieces.take(range(len(pieces) // 12 * 12)), group[0].long.take([0])


@one_core()
def measured(found: tuple[GainNet, Segments, Segments] | None = None) -> list[dict[str, Any]]:
    """Per row its name, microseconds, the ratio to plain torch's time, and whether its answer is right."""
    net, pieces, drive = parts() if found is None else found
    out: list[dict[str, Any]] = []
    for job, allowed, rows in (("training", 1e-5, training(net, pieces)), ("inference", 1e-3, following(net, drive))):
        medians = seconds(rows)
        for row in rows:
            full = job == "training" and row.words.endswith(f"batch {len(pieces)}")
            words = row.words.replace(f"batch {len(pieces)}", "full batch")
            words = words.replace(f"batch {len(pieces) // 6}", "a sixth")
            spent, plain = medians[row.words], medians[rows[full].words]
            right = row.error <= allowed
            out.append({"name": f"{job}: {words}", "us": 1e6 * spent, "ratio": spent / plain, "right": right})
    return out


@torch.no_grad()
def following(net: GainNet, drive: Segments) -> list[Row]:
    """`inference`, without gradients also when its calls are timed later."""
    return [row._replace(call=torch.no_grad()(row.call)) for row in inference(net, drive)]


if __name__ == "__main__":
    print(report(measured()))
