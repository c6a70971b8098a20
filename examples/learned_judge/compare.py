"""What does a judge learn of what is wrong? Trains judges in development worlds and prints tables of unseen ones.

Run:  python examples/learned_judge/compare.py                   half an hour on a core, or more
      python examples/learned_judge/compare.py --small           to see that it runs
      python examples/learned_judge/compare.py --out FOLDER      keeps weights and columns

The judge is in star.py, its training in judge.py. The five clients are vehicles that meet different faults: a world
belongs to the client whose group has its first fault. With scikit-learn there is a random forest, too; convoys of real
errors need `coopoc data get`, or COOPOC_DATA.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from judge import begin, federate, fit_forest, rows_of, size, train
from scipy import special
from star import ANGLE, FEATURES, HEADS, MOTION, OTHER, OWN, RANGE, Floats, Forest, Pack, alone, follow, pack
from tqdm import tqdm

import coopoc as co
from coopoc.evaluate.statistics import mean_interval
from coopoc.studies.convoys import CONVOYS, convoy
from coopoc.studies.worlds import world

TRAINING, CHOOSING, REPORT = 200_000, 210_000, 0
"""First seeds: of development worlds that train, of those that may be looked at, and of validation worlds."""
GROUPS: Mapping[str, tuple[str, ...]] = {
    "canyon": ("own receiver", "multipath", "no fixes", "drift"),
    "liars": ("liars", "clock offsets"),
    "motorway": ("odometer", "compass"),
    "houses": ("NLOS", "mistaken angles", "range offset", "measured"),
    "radio and noise": ("noise levels", "late messages", "lost messages", "come and go"),
}
"""Client -> what is wrong in its worlds; worlds with nothing wrong are dealt out in turn."""
LEFT_OUT = ("liars", "NLOS", "odometer")
"""Kinds that one judge never met."""
BAND = special.chdtri(3, [0.975, 0.025])
WORSE = 1.1
HIDDEN: Mapping[str, Mapping[int, tuple[int, ...]]] = {
    "without neighbours' agreement": {
        OWN: (9, 10, 11, 12, 13, 15, 24, 25),
        OTHER: (9, 10, 11, 12, 13, 15, 24, 25),
        RANGE: (8, 9, 14, 25),
        ANGLE: (8, 9, 14, 25),
        MOTION: (23, 24),
    },
    "without signs": {
        OWN: (4, 5, 6, 12, 13, 23, 25),
        OTHER: (4, 5, 6, 12, 13, 23, 25),
        RANGE: (1, 5, 6, 7, 8, 13, 25),
        ANGLE: (1, 5, 6, 7, 8, 13, 25),
        MOTION: (6, 7, 8, 9, 10, 11, 12),
    },
    "of one step": {
        OWN: (1, 2, 3, 4, 5, 6, 7, 8, 10, 11, 12, 13, 20, 22, 23, 24, 25, 26, 27),
        OTHER: (1, 2, 3, 4, 5, 6, 7, 8, 10, 11, 12, 13, 20, 22, 23, 24, 25, 26, 27),
        RANGE: (2, 3, 4, 5, 6, 7, 8, 9, 11, 12, 13, 14, 20, 27),
        ANGLE: (2, 3, 4, 5, 6, 7, 8, 9, 11, 12, 13, 14, 20, 27),
        MOTION: (1, 2, 3, 6, 7, 8, 9, 10, 11, 18, 19, 20, 26),
    },
}
"""Ablation -> features that are hidden from each head."""


@dataclass(frozen=True)
class Judge:
    """Who judges: a net's weights, a forest, "truth" or None; the features that it sees; whether the ego is alone."""

    who: Floats | Forest | str | None
    shown: Floats | None = None
    alone: bool = False


def shown(hidden: Mapping[int, tuple[int, ...]]) -> Floats:
    """(HEADS, FEATURES) 0 for features that are hidden."""
    mask = np.ones((HEADS, FEATURES))
    for head, features in hidden.items():
        mask[head, list(features)] = 0.0
    return mask


def group(kinds: Sequence[str], seed: int) -> str:
    """Client of a world."""
    names = [name for name, words in GROUPS.items() if kinds and kinds[0].startswith(words)]
    return names[0] if names else [*GROUPS][seed % len(GROUPS)]


Drive = tuple[tuple[str, ...], str, Pack]


def drives(count: int) -> list[Drive]:
    """Kinds of fault, client and stars of development worlds: of one ego each, in one draw of the noise."""
    found = []
    for seed in tqdm(range(TRAINING, TRAINING + count), "training worlds", disable=None):
        one = world(seed, "development")
        stars = pack(one.recording.of_runs(slice(0, 1)), one.egos[seed % 2], one.fleet)
        found.append((one.kinds, group(one.kinds, seed), stars))
    return found


def trained(seen: Sequence[Drive], seeds: int, phases: int, steps: int) -> dict[str, Judge]:
    """Judges by name, "name / seed" where there are several."""
    clients = {name: [stars for _, of, stars in seen if of == name] for name in GROUPS}
    every, options = [stars for _, _, stars in seen], {"phases": phases, "steps": steps}
    made = {"textbook": Judge(None), "the truth": Judge("truth"), "the truth, alone": Judge("truth", alone=True)}

    def note(name: str, judge: Judge, began: float) -> None:
        made[name] = judge
        print(f"{name}: {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)

    def one(name: str, make: Callable[[], Floats], mask: Floats | None = None, solo: bool = False) -> None:
        began = time.perf_counter()
        note(name, Judge(make(), mask, solo), began)

    for seed in range(seeds):
        one(f"centralised / {seed}", lambda seed=seed: train(every, seed, **options))  # type: ignore[misc]
        one(f"federated / {seed}", lambda seed=seed: federate([*clients.values()], seed, **options))  # type: ignore[misc]
    for name, packs in clients.items():
        one(f"individual / {name}", lambda packs=packs: train(packs, 0, **options))  # type: ignore[misc]
    solo = {name: [alone(stars) for stars in packs] for name, packs in clients.items()}
    one("centralised, alone", lambda: train([stars for packs in solo.values() for stars in packs], 0, **options), solo=True)
    one("federated, alone", lambda: federate([*solo.values()], 0, **options), solo=True)
    for name, packs in solo.items():
        one(f"individual, alone / {name}", lambda packs=packs: train(packs, 0, **options), solo=True)  # type: ignore[misc]
    for name, hidden in HIDDEN.items():
        mask = shown(hidden)
        one(name, lambda mask=mask: train(every, 0, mask, **options), mask)  # type: ignore[misc]
    rest = [stars for kinds, _, stars in seen if not any(kind.startswith(LEFT_OUT) for kind in kinds)]
    one("left out of training", lambda: train(rest, 0, **options))
    began, last = time.perf_counter(), made["centralised / 0"].who
    if isinstance(last, np.ndarray):
        forest = fit_forest(rows_of(every, last, np.ones((HEADS, FEATURES)), 7), 0)
        if forest is not None:
            note("random forest", Judge(forest), began)
    return made


def scores(gap: Floats, covariance: Floats | None) -> tuple[float, float]:
    """RT-LE m and share of NEES in the 95 % band of errors (R, T, 3)."""
    level = float(np.sqrt(np.square(gap).sum(axis=-1).mean(axis=1)).mean())
    if covariance is None:
        return level, np.nan
    nees = np.einsum("rti,rti->rt", gap, np.linalg.solve(covariance, gap[..., None])[..., 0])
    return level, float(np.mean((nees >= BAND[0]) & (nees <= BAND[1])))


BASELINES: Mapping[str, Callable[..., co.Track]] = {
    "joint": co.JointFilter(),
    "kalman": co.Kalman(),
    "the rules": co.CooperativeFilter(),
    "the rules, alone": co.CooperativeFilter(),
}


def judged(recording: co.Recording, fleet: co.Fleet, egos: Sequence[int], judges: Mapping[str, Judge]) -> dict[str, Any]:
    """RT-LE m and NEES inside of all methods, each a mean over the egos, and microseconds of a step."""
    found = {}
    for name, method in BASELINES.items():
        seen = _alone(recording) if "alone" in name else recording
        track = method(seen, egos)
        each = [scores(track.x[:, :, e] - fleet.position[:, ego], _at(track, e)) for e, ego in enumerate(egos)]
        found[name] = (*np.mean(each, axis=0), 1e6 * track.seconds / track.x[..., 0].size)
    packs = [pack(recording, ego, fleet) for ego in egos]
    solo = [alone(stars) for stars in packs]
    for name, judge in judges.items():
        began, each = time.perf_counter(), []
        for stars, ego in zip(solo if judge.alone else packs, egos, strict=True):
            x, covariance, _ = follow(stars, judge.who, judge.shown)
            each.append(scores(x - fleet.position[:, ego], covariance))
        took = 1e6 * (time.perf_counter() - began) / (recording.runs * len(recording.t) * len(egos))
        found[name] = (*np.mean(each, axis=0), took)
    return found


def _at(track: co.Track, e: int) -> Floats | None:
    return None if track.covariance is None else track.covariance[:, :, e]


def _alone(recording: co.Recording) -> co.Recording:
    """The recording without links."""
    from dataclasses import replace

    links = recording.links
    none = type(links)(links.step[:0], links.observer[:0], links.neighbour[:0])
    return replace(recording, links=none, relative=recording.relative[:, :0], arrival=recording.arrival[:, :0])


def table(names: Sequence[str], found: Sequence[Mapping[str, Any]]) -> str:
    """Markdown rows: each method over `joint` and over the rules, with intervals over worlds."""
    lines = [
        "| method | over joint | over the rules | worse than alone [%] | NEES inside | us a step |",
        "|---|---|---|---|---|---|",
    ]
    for name in names:
        every = sorted({key for one in found for key in one if key == name or key.startswith(f"{name} / ")})
        level = np.array([np.mean([np.log(one[key][0]) for key in every]) for one in found])
        joint, rules = (np.log([one[key][0] for one in found]) for key in ("joint", "the rules"))
        worse = [100.0 * np.mean([one[key][0] > WORSE * one["kalman"][0] for key in every]) for one in found]
        inside, took = (np.nanmean([[one[key][i] for key in every] for one in found]) for i in (1, 2))
        row = [_over(level - joint), _over(level - rules), f"{np.mean(worse):.1f}", f"{inside:.2f}", f"{took:.0f}"]
        if len(every) > 1:
            each = [np.exp(np.mean([np.log(one[key][0]) for one in found] - rules)) for key in every]
            row[1] += f"; seeds or clients {min(each):.3f} to {max(each):.3f}"
        lines.append(f"| {name} | {' | '.join(row)} |")
    return "\n".join(lines)


def _over(logarithms: Floats) -> str:
    level = mean_interval(logarithms)
    return f"{np.exp(level.mean):.3f} [{np.exp(level.low):.3f}, {np.exp(level.high):.3f}]"


def by_kind(names: Sequence[str], found: Sequence[Mapping[str, Any]], kinds: Sequence[Sequence[str]]) -> str:
    """Markdown: geometric mean over `joint` of methods by kind of fault, and how many worlds have it."""
    lines = ["| kind of fault | worlds | " + " | ".join(names) + " |", "|---" * (len(names) + 2) + "|"]
    for kind in ["", *sorted({each for of in kinds for each in of})]:
        rows = [one for one, of in zip(found, kinds, strict=True) if kind in of or (not kind and not of)]
        cells = []
        for name in names:
            every = [key for key in rows[0] if key == name or key.startswith(f"{name} / ")]
            cells.append(np.exp(np.mean([np.log(one[key][0] / one["joint"][0]) for one in rows for key in every])))
        lines.append(f"| {kind or 'nothing wrong'} | {len(rows)} | " + " | ".join(f"{cell:.2f}" for cell in cells) + " |")
    return "\n".join(lines)


def transfer(found: Sequence[Mapping[str, Any]], kinds: Sequence[Sequence[str]]) -> str:
    """The judge that never met some kinds, in worlds with them and in the others, over the centralised one."""
    lines = []
    for words, inside in (("that it never met", True), ("that it met", False)):
        ratios = [
            np.log(one["left out of training"][0] / one["centralised / 0"][0])
            for one, of in zip(found, kinds, strict=True)
            if any(kind.startswith(LEFT_OUT) for kind in of) == inside
        ]
        lines.append(f"left out of training over centralised, {len(ratios)} worlds with faults {words}: {_over(np.array(ratios))}")
    return "\n".join(lines)


def main(
    worlds: int = 1500, report: int = 400, seeds: int = 3, phases: int = 3, steps: int = 1000, small: bool = False,
    out: Path | None = None, data: Path | None = None,
) -> None:  # fmt: skip
    """Train, compare, print.

    Args:
        worlds: development worlds that train.
        report: validation worlds of the tables.
        seeds: of training.
        phases: times that a judge filters the training worlds anew.
        steps: of the optimiser in each phase.
        small: few of all.
        out: folder of weights and columns.
        data: of real roads; None for those that were fetched.
    """
    if small:
        worlds, report, seeds, phases, steps = 10, 5, 1, 1, 20
    torch.set_num_threads(1)
    judges = trained(drives(worlds), seeds, phases, steps)
    print(f"weights {size()[0]}, {size()[1]} bytes; a federated client sends and receives {2 * phases * 12 * size()[1]} bytes")
    found, kinds = [], []
    for seed in tqdm(range(REPORT, REPORT + report), "unseen worlds", disable=None):
        one = world(seed, "validation")
        found.append(judged(one.recording.of_runs(slice(0, 2)), one.fleet, list(one.egos), judges))
        kinds.append(one.kinds)
    names = list(dict.fromkeys(name.partition(" / ")[0] for name in found[0]))
    main_ones = ["kalman", "the rules", "centralised", "federated", "individual", "the truth"]
    print(table(names, found), by_kind(main_ones, found, kinds), transfer(found, kinds), sep="\n\n")
    for task in CONVOYS:
        try:
            recording, fleet = convoy(task, data)
        except co.InputError as error:
            print(f"{task}: {error}")
            continue
        levels = judged(recording, fleet, range(len(recording.ids)), judges)
        print(task, {name: round(float(levels[name][0]), 3) for name in levels if name.partition(" / ")[0] in (*main_ones, "joint", "textbook")})
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        nets = {name.replace(" / ", "."): judge.who for name, judge in judges.items() if isinstance(judge.who, np.ndarray)}
        np.savez(out / "weights.npz", **nets)
        columns = {name.replace(" / ", "."): np.array([one[name] for one in found]) for name in found[0]}
        np.savez(out / "columns.npz", kinds=np.array(["; ".join(of) for of in kinds]), **columns)


if __name__ == "__main__":
    tyro.cli(main)
