"""A small net that sets the noise of the road filter, step by step, against the same filter with learned constants: the
trial of docs/learned.md, "A net that sets the noise".

python examples/learned_noise.py --data ~/measured                 # 18 minutes of one core
python examples/learned_noise.py --quick --out runs/quick          # does it run? two minutes, no results

The filter is `coopoc.RoadFilter`, written differentiably; without the net both agree to 1e-6, which each run checks.
What is learned, in the worlds of `coopoc.learned.training.roads`:
- net: 2,364 weights above the constants that the package ships, learned in the same worlds. After each fix it sees what
  innovations were, in units of the filter's sigma, over 5, 20 and 100 fixes, and sets factors of the noise of fixes
  (R), of the motion (Q), of heading and scale, and of the gate until the next. Its authority is bounded: R 1 to e^3,
  Q 1 / e to e, the gate 1 to e;
- both ways: the same, with R from 1 / e on;
- relearned: the eight numbers of the filter anew, by Nelder-Mead on the compiled filter and whole drives;
- relearned net: "both ways" above these;
- free: that with an authority of e^6 each way, which may tighten the gate (by e^3).
Whatever is there in the folder of results is not made again.
"""

import argparse
import copy
import json
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from noise_net import Drives, NoiseNet, State, begin, compiled, drives_of, factors, filtered, rolled
from real_logs import Filter, Log, real_logs, scored
from scipy.optimize import minimize
from scipy.stats import t as student
from torch import Tensor, nn

import coopoc as co
from coopoc.arrays import Floats
from coopoc.learned.training.roads import roads
from coopoc.methods.road import ROAD, RoadErrors, RoadFilter, from_logs, to_logs, true_cost

UP = ((-1e-3, 3.0), (-1.0, 1.0), (-1.0, 1.0), (-1e-3, 1.0))
BOTH = ((-1.0, 3.0), *UP[1:])
FREE = ((-6.0, 6.0), (-6.0, 6.0), (-6.0, 6.0), (-3.0, 3.0))
BOUNDS = {"net": UP, "both ways": BOTH, "relearned net": BOTH, "free": FREE}
"""Logarithms of the least and the largest factor of R, Q, the noise of heading and scale, and the gate, by net."""
WRONG = {
    "no gate": replace(ROAD, gate=1e9, window=np.inf),
    "tight gate, small R": replace(ROAD, gate=0.1, fix=ROAD.fix / 3),
}
"""What a net without bounds may make of the filter, for the test of the simulator."""
SIMULATOR, CALIBRATED = "simulator", "calibrated"
Scores = dict[str, list[float]]
SHIPPED = co.learned.load_method("road").errors
"""Constants of roads as the package has them, learned in the same simulator."""
Made = dict[str, tuple[RoadErrors, NoiseNet | None]]
"""Name -> constants and net of a filter."""
CHUNK, STEPS = 100, 600
"""Steps of truncated backpropagation, and of a drive, in each of which is a fix unless one is missing."""


def shortened(drives: Drives, steps: int) -> Drives:
    """For training: steps up to the next fix, or of a second, as one; the first `steps` of these, NaN where none is."""
    rows = []
    for drive in zip(*(part.numpy() for part in drives[:5]), strict=True):
        _, _, fix, _, dt = drive
        ends = [0]
        for t in range(1, len(dt)):
            if np.isfinite(fix[t, 0]) or t - ends[-1] >= round(1.0 / dt[0]):
                ends.append(t)
        ends = ends[:steps]
        starts = [0, *(t + 1 for t in ends[:-1])]
        moved, q, time = (np.add.reduceat(drive[k][: ends[-1] + 1], starts) for k in (0, 1, 4))
        row, none = (moved, q, fix[ends], drive[3][ends], time), (0.0, 0.0, np.nan, np.nan, 0.0)
        fill = [np.full((steps - len(ends), *part.shape[1:]), value) for part, value in zip(row, none, strict=True)]
        rows.append([torch.tensor(np.concatenate(pair)) for pair in zip(row, fill, strict=True)])
    return Drives(*(torch.stack(part) for part in zip(*rows, strict=True)), drives.r)


def worlds(count: int, seed: int) -> tuple[co.Recording, co.Fleet]:
    """So many times 24 drives, each in a world of its own."""
    made = [roads(co.load_fleet("town10-clients"), seed + k) for k in range(count)]
    ids = tuple(f"{name}-{k}" for k, drives in enumerate(made) for name in drives.ids)
    gnss, velocity = (np.concatenate([getattr(d.recording, part) for d in made], 2) for part in ("gnss", "velocity"))
    position, motion = (np.concatenate([getattr(d.truth, part) for d in made], 1) for part in ("position", "velocity"))
    truth = co.Fleet(ids, made[0].truth.t, position, motion)
    like = co.observe(truth, co.Sensors(), co.V2X(max_neighbours=0))
    return replace(like, gnss=gnss, velocity=velocity), truth


def constants(seen: co.Recording, truth: co.Fleet, evaluations: int) -> RoadErrors:
    """The numbers of the filter that cost least on whole drives, on the average."""
    every = list(range(len(seen.ids)))
    true = truth.position.swapaxes(0, 1)[..., :2]

    def cost(logs: Floats) -> float:
        x, p = compiled(seen, from_logs(logs), every)
        return float(true_cost(x, p, true).mean())

    start = to_logs(ROAD)
    simplex = start + np.vstack([np.zeros(8), 0.7 * np.eye(8)])
    found = minimize(cost, start, method="Nelder-Mead", options={"maxfev": evaluations, "initial_simplex": simplex})
    return from_logs(found.x)


def trained(net: NoiseNet, e: RoadErrors, drives: Drives, held: Drives, epochs: int, seed: int) -> NoiseNet:
    """The net after training on drives, as it was best on those held."""
    draw = np.random.default_rng(seed)
    adam = torch.optim.Adam(net.parameters(), lr=4e-3)
    fall = torch.optim.lr_scheduler.CosineAnnealingLR(adam, epochs)
    usual = np.nanmean(np.square(filtered(drives, e)[0] - drives.truth.numpy()).sum(-1), 1)
    mean_square = torch.tensor(usual + 1e-2)[:, None]
    best, weights = validated(held, e, net), copy.deepcopy(net.state_dict())
    print(f"  at its start: {best:.4f}", flush=True)
    for epoch in range(epochs):
        rows = torch.tensor(draw.permutation(len(drives.fix))[:96])
        batch, s = Drives(*(part[rows] for part in drives)), begin(len(rows))
        for first in range(0, batch.fix.shape[1], CHUNK):
            s, x, p, _ = rolled(batch, e, net, s, slice(first, first + CHUNK))
            loss = cost_of(x, p, batch.truth[:, first : first + CHUNK], mean_square[rows])
            adam.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(net.parameters(), 1.0)
            adam.step()
            s = State(*(part.detach() for part in s))
        fall.step()
        if epoch % 3 == 2 or epoch == epochs - 1:
            now = validated(held, e, net)
            if now < best:
                best, weights = now, copy.deepcopy(net.state_dict())
            print(f"  epoch {epoch + 1}: {now:.4f}", flush=True)
    net.load_state_dict(weights)
    return net


def cost_of(x: Tensor, p: Tensor, truth: Tensor, mean_square: Tensor) -> Tensor:
    """Squared errors over the mean squared error that constants have on the same drive, whose gradient is that of the
    logarithm of its RMSE, and a tenth of minus the log likelihood of the truth (Student's t, as `true_cost`)."""
    there = x[..., 0].isfinite() & truth[..., 0].isfinite()
    gap = torch.where(there[..., None], x - truth, 0)
    det = p[..., 0, 0] * p[..., 1, 1] - p[..., 0, 1] ** 2
    nees = (p[..., 1, 1] * gap[..., 0] ** 2 - 2 * p[..., 0, 1] * gap.prod(-1) + p[..., 0, 0] * gap[..., 1] ** 2) / det
    each = 0.5 * gap.square().sum(-1) / mean_square + 0.1 * (0.5 * det.log() + 3 * torch.log1p(nees / 4))
    return torch.where(there, each, 0).sum() / there.sum()


def validated(drives: Drives, e: RoadErrors, net: NoiseNet | None) -> float:
    x, p = filtered(drives, e, net)
    return float(true_cost(x, p, drives.truth.numpy()).mean())


def learned(seed: int, draws: int, epochs: int, out: Path) -> Made:
    """What a seed has learned, in worlds of its own, by name; kept in files."""
    kinds = tuple(BOUNDS) if seed == 0 else ("net", "both ways")
    files = {kind: out / f"{kind} {seed}.pt" for kind in kinds}
    if not all(file.exists() for file in files.values()):
        seen, truth = worlds(draws, 100 * seed + 10)
        drives, held = (
            shortened(drives_of(*part), STEPS) for part in ((seen, truth), worlds(max(draws // 3, 1), 100 * seed + 50))
        )
        relearned = constants(seen, truth, 10 * epochs) if seed == 0 else SHIPPED
        for kind, file in files.items():
            if not file.exists():
                e = SHIPPED if kind in ("net", "both ways") else relearned
                print(f"{kind}, seed {seed}, from {e}", flush=True)
                net = trained(NoiseNet(BOUNDS[kind], seed), e, drives, held, epochs, seed)
                torch.save({"constants": asdict(e), "net": net.state_dict()}, file)
    made: Made = {}
    for kind, file in files.items():
        kept, net = torch.load(file), NoiseNet(BOUNDS[kind], seed)
        net.load_state_dict(kept["net"])
        made[f"{kind} {seed}"] = RoadErrors(**kept["constants"]), net
    return made


@cache
def multipath(size: float = 30.0, seed: int = 900, start: float = 150.0, lasts: float = 60.0) -> tuple[Drives, int]:
    """The test of the simulator: 48 drives in worlds that trained nothing; the same with fixes that are all `size` m
    off for a minute, in one direction; the same with fixes whose error grows to `size` over that minute. And the step
    of its end; all drives end a minute later."""
    seen, truth = worlds(2, seed)
    time = (seen.t - start) / lasts
    there, angle = (time >= 0) & (time < 1), np.random.default_rng(seed).uniform(0, 2 * np.pi, len(seen.ids))
    off = size * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    until = int((start + 2 * lasts) / seen.dt) + 1
    parts = [
        drives_of(replace(seen, gnss=seen.gnss + wrong[:, None, None] * off).between(0, until), truth.between(0, until))
        for wrong in (0.0 * time, 1.0 * there, there * time)
    ]
    return Drives(*(torch.cat(part) for part in zip(*parts, strict=True))), until - 1 - int(lasts / seen.dt)


def lock_outs(drives: Drives, end: int, e: RoadErrors, net: NoiseNet | None) -> list[float]:
    """Geometric mean of the RMSE m; of the jump and of the error that grows the share of drives in which the estimate
    is more than 10 m from where it were without, at its end and a minute later."""
    x = filtered(drives, e, net)[0].reshape(3, -1, *drives.fix.shape[1:])
    usual = np.sqrt(np.nanmean(np.square(x[0] - drives.truth[: x.shape[1]].numpy()).sum(-1), -1))
    off = [np.linalg.norm(x[k] - x[0], axis=-1)[:, at] for k in (1, 2) for at in (end, -1)]
    return [float(np.exp(np.log(usual).mean())), *(float((gap > 10).mean()) for gap in off)]


def ran(e: RoadErrors, net: NoiseNet | None = None) -> Filter:
    """The filter with these constants, compiled, or with a net."""
    return lambda seen, truth, columns: (
        filtered(drives_of(seen, truth, columns), e, net) if net else compiled(seen, e, columns)
    )


def evaluated(name: str, e: RoadErrors, net: NoiseNet | None, logs: dict[str, Log], out: Path) -> Scores:
    """Numbers of a filter by test, kept in a file: `lock_outs` of the simulator, RT-LE m and NEES of each vehicle."""
    file = out / f"{name}.json"
    if not file.exists():
        found: Scores = {SIMULATOR: lock_outs(*multipath(), e, net)}
        for label, log in logs.items() if name not in WRONG else ():
            scores = calibrated(log) if name == CALIBRATED else scored(log, ran(e, net))
            for c, score in zip(log.columns, scores, strict=True):
                found[label if len(log.columns) == 1 else f"{label} {log.seen.ids[c]}"] = score.tolist()
            if net:
                found[f"factors, {label}"] = factors(drives_of(*begun(log)), e, net)
        file.write_text(json.dumps(found))
    kept: Scores = json.loads(file.read_text())
    print(name, {label: np.round(score, 3).tolist() for label, score in kept.items()}, flush=True)
    return kept


def begun(log: Log) -> tuple[co.Recording, co.Fleet, list[int]]:
    """The first 1200 steps at most, without a break."""
    begin, stop = log.seen.stretches(log.columns[0])[0]
    part = log.between(begin, min(stop, begin + 1200))
    return part.seen, part.truth, part.columns


def checked(log: Log) -> None:
    """Without a net the filter is the library's, to 1e-6."""
    seen, truth, columns = begun(log)
    for ours, theirs in zip(
        filtered(drives_of(seen, truth, columns), ROAD), compiled(seen, ROAD, columns), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-6)


def calibrated(log: Log) -> Floats:
    """Scores of the library's filter, of each vehicle calibrated on the part that is not scored."""
    first = log.between(0, log.start)
    own = [RoadFilter.fitted(replace(first.seen, observers=(c,)), first.truth).errors or ROAD for c in log.columns]
    return np.concatenate([scored(log._replace(columns=[c]), ran(e)) for c, e in zip(log.columns, own, strict=True)])


def main(data: Path, out: Path, seeds: int, quick: bool) -> None:
    torch.set_num_threads(1)
    out.mkdir(parents=True, exist_ok=True)
    logs = real_logs(data) if data.is_dir() else {}
    if quick:
        logs = {name: logs[name] for name in logs.keys() & {"comma2k19", "indoor"}}
    for log in logs.values():
        checked(log)
    louder = replace(SHIPPED, motion=SHIPPED.motion * np.exp(0.5))
    fixed = {**WRONG, "hand": ROAD, "shipped": SHIPPED, CALIBRATED: ROAD, "shipped, Q times e": louder}
    made: Made = {name: (e, None) for name, e in fixed.items()}
    for seed in range(seeds):
        made |= learned(seed, *((1, 2) if quick else (6, 30)), out)
    made["relearned"] = made["relearned net 0"][0], None
    report({name: evaluated(name, *one, logs, out) for name, one in made.items()})


def report(scores: dict[str, Scores]) -> None:
    """Tables: of the simulator, of RT-LE m with NEES over its dimension in brackets, and of ratios of RT-LE."""
    print("\n| | RMSE, m | jump, at its end | a minute later | growing, at its end | a minute later |")
    print("|---" * 6 + "|")
    for name, row in scores.items():
        if name != CALIBRATED:  # on a real log
            print(f"| {name} |", " | ".join(f"{x:.2f}" for x in row[SIMULATOR]), "|")
    shown = {name: row for name, row in scores.items() if name not in WRONG}
    labels = [label for label in shown["hand"] if label != SIMULATOR]
    print("\n| |", " | ".join(shown), "|\n|---" + "|---" * len(shown) + "|")
    for label in labels:
        cells = (f"{rmse:.3f} ({nees / 2:.2f})" for rmse, nees in (row[label] for row in shown.values()))
        print(f"| {label} |", " | ".join(cells), "|")
    print("\n| RT-LE of | over that of | geometric mean | of the three roads | least | worst |\n" + "|---" * 6 + "|")
    level = {name: np.log([row[label][0] for label in labels]) for name, row in shown.items()}
    for name in shown:
        for other in ("hand", "shipped", CALIBRATED, "relearned"):
            if labels and name != other:
                gain = level[name] - level[other]
                parts = gain.mean(), gain[:3].mean(), gain.min(), gain.max()
                print(f"| {name} | {other} |", " | ".join(f"{np.exp(x):.3f}" for x in parts), "|")
    print("\nMean factors of R, Q, noise of heading and scale, gate:")
    for name, row in shown.items():
        for label in (label for label in row if label.startswith("factors")):
            print(f"{name}, {label[9:]}:", *(f"{factor:.2f}" for factor in row[label]))
    for kind in ("net", "both ways"):
        gains = [(row - level["shipped"]).mean() for name, row in level.items() if name.startswith(kind)]
        if labels and len(gains) > 1:
            half = student.ppf(0.975, len(gains) - 1) * np.std(gains, ddof=1) / np.sqrt(len(gains))
            mean, low, high = np.exp(np.mean(gains) + half * np.array([0, -1, 1]))
            print(f"{kind} over shipped, {len(gains)} seeds, geometric mean: {mean:.3f} [{low:.3f}, {high:.3f}]")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--out", type=Path, default=Path("runs/learned_noise"))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--quick", action="store_true")
    given = parser.parse_args()
    main(given.data, given.out, 1 if given.quick else given.seeds, given.quick)
