"""GainNet's training and inference: plain torch, the compiled engine and the arithmetic's floor, in one run.

    python benchmarks/learned_gain.py            # two Markdown tables on stdout, about two minutes

All rows use the same net and the same drives (town10-clients, pieces of 100 steps) on one thread unless stated, one
after the other in every round; the ratios are to be compared, the times are this machine's. "Plain torch" is the loop
of KalmanNet's public training code re-expressed with our reference module: one Python step after the other, autograd,
and torch.optim.AdamW. The flop floor is 2 flops for each weight of a layer and step (forward; three times that to
train) at this core's measured peak of single-precision multiply-adds. One drive has another floor: to read all weights,
which are more than the first cache holds. A row counts only if its answer is the reference's."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from functools import reduce
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from tabulate import tabulate
from torch import Tensor

import coopoc as co
from coopoc.learned.nets.gain import Recurrent
from coopoc.learned.nets.gain_net import GainNet
from coopoc.learned.nets.stack import flatten
from coopoc.learned.training.clients import Segments, clients
from coopoc.learned.training.fit import descend
from coopoc.learned.training.machine import one_core
from coopoc.learned.training.schedule import Schedule

ROUNDS = 5
CHAINS = 12
RATE = 1e-3
SCHEDULE = Schedule(learning_rate=RATE, weight_decay=0.3, clip=1e9, mirror=False)


class Row(NamedTuple):
    """One way to do the job: its words, trajectory-steps per call, the call, and whether its answer is right."""

    words: str
    steps: int
    call: Callable[[], Any]
    error: float
    """Largest difference from plain torch: of trained weights, or of positions in m."""


@intrinsic
def _chains(typing: Any, rounds: Any) -> Any:
    """Twelve sums of vectors that stay in registers, so many multiply-adds each: as many as hide one another's wait."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        vector = ir.VectorType(ir.FloatType(), 16)
        a, b, *starts = (ir.Constant(vector, [number] * 16) for number in (0.999, 1e-3, *map(float, range(CHAINS))))
        sums = [cgutils.alloca_once_value(builder, start) for start in starts]
        with cgutils.for_range(builder, values[0]):
            for each in sums:
                scaled = builder.fmul(builder.load(each), a, flags=("contract",))
                builder.store(builder.fadd(scaled, b, flags=("contract",)), each)
        total = reduce(builder.fadd, map(builder.load, sums))
        return builder.extract_element(total, ir.IntType(32)(0))

    return types.float32(types.intp), generate


@numba.njit
def _multiply_add(rounds: int) -> float:
    return _chains(rounds)


def peak() -> float:
    """Single-precision flops per second of one core, the most of nine runs of multiply-adds that stay in registers."""
    rounds = 4_000_000
    _multiply_add(1)
    return 2.0 * 16 * CHAINS * rounds / min(timed(lambda: _multiply_add(rounds)) for _ in range(9))


@numba.njit(fastmath={"reassoc", "nsz"})
def _read(numbers: np.ndarray, rounds: int) -> None:
    for _ in range(rounds):
        total = np.float32(0.0)
        for i in range(len(numbers)):
            total += numbers[i]
        numbers[0] = np.float32(0.5) * total


def reading(count: int) -> float:
    """Seconds in which one core adds so many single-precision numbers that are in its second cache, least of nine."""
    numbers, rounds = np.zeros(count, np.float32), 1000
    _read(numbers, 1)
    return min(timed(lambda: _read(numbers, rounds)) for _ in range(9)) / rounds


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
        error = float((our_training(net, pieces, checked) - wanted).abs().max())
        total = sum(plan.size for plan in plans) * length
        rows.append(Row(words, total, lambda plans=plans: our_training(net, pieces, plans), error))
    return rows


def inference(net: GainNet, drive: Segments) -> list[Row]:
    """One drive of 900 steps, and 128 of them at once."""
    batch = drive.batch(torch.zeros(1, 1, dtype=torch.long))
    gnss, velocity, x0 = batch.gnss[:, 0].transpose(0, 1), batch.velocity[:, 0].transpose(0, 1), batch.x0[0]
    many = [a.expand(128, *a.shape[1:]).contiguous() for a in (gnss, velocity, x0)]
    wanted, length = Recurrent.forward(net, gnss, velocity, x0, batch.dt), gnss.shape[1]
    rows = [Row("plain torch, 1 drive", length, lambda: Recurrent.forward(net, gnss, velocity, x0, batch.dt), 0.0)]
    for words, inputs in (("engine, 1 drive", (gnss, velocity, x0)), ("engine, 128 drives", many)):
        found = net(*inputs, batch.dt)
        error = float((found - wanted).abs().max())
        rows.append(Row(words, length * len(found), lambda inputs=inputs: net(*inputs, batch.dt), error))
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
    for job, allowed, rows in (("training", 1e-4, training(net, pieces)), ("inference", 1e-3, following(net, drive))):
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


def table(rows: list[Row], floors: dict[str, float], allowed: float, against: Callable[[Row], Row]) -> str:
    """Microseconds per trajectory-step (median of interleaved rounds), steps/s, ratios to plain torch and floors, s."""
    medians = seconds(rows)
    lines: list[Iterable[Any]] = []
    for row in rows:
        us = 1e6 * medians[row.words]
        ratio = medians[against(row).words] / medians[row.words]
        lines.append(
            [
                row.words,
                us,
                f"{1e6 / us:,.0f}",
                ratio,
                *(us / (1e6 * floor) for floor in floors.values()),
                row.error,
                "yes" if row.error <= allowed else "NO",
            ]
        )
    header = ["", "us per step", "steps/s", "x plain torch", *floors, "difference", "same answer"]
    form = ("", ".3g", "", ".3g", *[".3g"] * len(floors), ".1e", "")
    return tabulate(lines, header, tablefmt="github", floatfmt=form)


@one_core()
def main() -> None:
    """Print the tables."""
    net, pieces, drive = parts()
    count = len(pieces)
    weights = sum(p.numel() for name, p in net.named_parameters() if "weight" in name)
    speed = peak()
    floor, read = 2.0 * weights / speed, reading(weights)
    versions = f"numba {numba.__version__}, torch {torch.__version__}"
    print(
        f"{weights:,} weights in layers; peak {speed / 1e9:.0f} GFLOP/s on one core, which reads them in "
        f"{1e6 * read:.2f} us; {versions}; {count} pieces of {pieces.gnss.shape[1] - 1} steps.\n"
    )
    rows = training(net, pieces)
    print("Training, AdamW included:\n")
    floors = {"x flop floor": 3 * floor}
    print(table(rows, floors, 1e-4, lambda row: rows[1] if row.words.endswith(str(count)) else rows[0]), "\n")
    drives = following(net, drive)
    print(f"Inference, {drives[0].steps} steps a drive:\n")
    floors = {"x flop floor": floor, "x read of weights": read}
    print(table(drives, floors, 1e-3, lambda row: drives[0]))


if __name__ == "__main__":
    main()
