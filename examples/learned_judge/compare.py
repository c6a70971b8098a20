"""What does a judge learn of what is wrong? Trains judges in development worlds and prints tables of unseen ones.

Run:  python examples/learned_judge/compare.py                   half an hour on a core
      python examples/learned_judge/compare.py --small           to see that it runs
      python examples/learned_judge/compare.py --out FOLDER      keeps weights and columns

The filter is in star.py, the training in judge.py. Five clients are vehicles that meet different faults: a world is of
the client whose group has its first fault. Convoys of real errors need the roads of `coopoc data get`.
"""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from judge import ALL, ROUNDS, federate, train
from scipy import special
from star import (
    ANGLE,
    HEADS,
    MOTION,
    NET,
    NONE,
    OTHER,
    OWN,
    RANGE,
    SIZE,
    TRUTH,
    Floats,
    Judge,
    Pack,
    alone,
    follow,
    pack,
)
from tqdm import tqdm

import coopoc as co
from coopoc.evaluate.statistics import mean_interval
from coopoc.studies.roads import CONVOYS, convoy
from coopoc.studies.worlds import world

TRAINING = 200_000
"""First seed of development worlds that train; the tables are of validation worlds from 0 on."""
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
BAND, WORSE = special.chdtri(3, [0.975, 0.025]), 1.1
ABLATIONS: Mapping[str, Sequence[tuple[tuple[int, ...], list[int]]]] = {
    "without neighbours' agreement": (
        ((OWN, OTHER), [9, 10, 11, 12, 13, 15, 24, 25]),
        ((RANGE, ANGLE), [8, 9, 14, 25]),
        ((MOTION,), [23, 24]),
    ),
    "without signs": (
        ((OWN, OTHER), [4, 5, 6, 12, 13, 23, 25]),
        ((RANGE, ANGLE), [1, 5, 6, 7, 8, 13, 25]),
        ((MOTION,), [6, 7, 8, 9, 10, 11, 12]),
    ),
    "of one step": (
        ((OWN, OTHER), [1, 2, 3, 4, 5, 6, 7, 8, 10, 11, 12, 13, 20, 22, 23, 24, 25, 26, 27]),
        ((RANGE, ANGLE), [2, 3, 4, 5, 6, 7, 8, 9, 11, 12, 13, 14, 20, 27]),
        ((MOTION,), [1, 2, 3, 6, 7, 8, 9, 10, 11, 18, 19, 20, 26]),
    ),
}
"""Ablation -> features that are hidden from heads."""
BASELINES: Mapping[str, Callable[..., co.Track]] = {
    "joint": co.JointFilter(),
    "kalman": co.Kalman(),
    "the rules": co.CooperativeFilter(),
    "the rules, alone": co.CooperativeFilter(),
}
MAIN = ["kalman", "the rules", "centralised", "federated", "individual", "corrected", "the truth"]
Levels = Mapping[str, Any]
"""Method, "name / seed or client" where there are several -> RT-LE m, share of NEES inside, microseconds a step."""


def trained(count: int, seeds: int, phases: int, steps: int) -> dict[str, Judge]:
    """Judges by name, "name / seed or client" where there are several; "alone" are those of an ego by itself."""
    clients: dict[str, list[Pack]] = {name: [] for name in GROUPS}
    rest, every = list[Pack](), list[Pack]()
    for seed in tqdm(range(TRAINING, TRAINING + count), "training worlds", disable=None):
        one = world(seed, "development")
        stars = pack(one.recording.of_runs(slice(0, 1)), one.egos[seed % 2], one.fleet)
        mine = [name for name, words in GROUPS.items() if one.kinds and one.kinds[0].startswith(words)]
        clients[mine[0] if mine else [*GROUPS][seed % len(GROUPS)]].append(stars)
        every.append(stars)
        if not any(kind.startswith(LEFT_OUT) for kind in one.kinds):
            rest.append(stars)
    made = {"textbook": Judge(NONE), "the truth": Judge(TRUTH), "the truth, alone": Judge(TRUTH)}

    def note(name: str, weights: Floats, shown: Floats = ALL) -> None:
        made[name] = Judge(NET, weights, shown)
        print(f"{name}: {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)

    began = time.perf_counter()
    for seed in range(seeds):
        note(f"centralised / {seed}", train(every, seed, phases, steps))
        note(f"federated / {seed}", federate([*clients.values()], seed, phases, steps))
    for name, packs in clients.items():
        note(f"individual / {name}", train(packs, 0, phases, steps))
    solo = {name: [alone(stars) for stars in packs] for name, packs in clients.items()}
    few, half = min(phases, 2), steps // 2
    note("centralised, alone", train([stars for packs in solo.values() for stars in packs], 0, few, half))
    note("federated, alone", federate([*solo.values()], 0, few, half))
    for name, packs in solo.items():
        note(f"individual, alone / {name}", train(packs, 0, few, half))
    for name, hidden in ABLATIONS.items():
        shown = ALL.copy()
        for heads, features in hidden:
            shown[np.ix_(heads, features)] = 0.0
        note(name, train(every, 0, min(phases, 3), steps, shown), shown)
    note("left out of training", train(rest, 0, min(phases, 3), steps))
    return made


def scores(gap: Floats, covariance: Any) -> tuple[float, float]:
    """RT-LE m and share of NEES in the 95 % band of errors (R, T, 3)."""
    nees = np.einsum("rti,rti->rt", gap, np.linalg.solve(covariance, gap[..., None])[..., 0])
    inside = float(np.mean((nees >= BAND[0]) & (nees <= BAND[1])))
    return float(np.sqrt(np.square(gap).sum(axis=-1).mean(axis=1)).mean()), inside


def judged(recording: co.Recording, fleet: co.Fleet, egos: Sequence[int], judges: Mapping[str, Judge]) -> Levels:
    """Levels of all methods, means over the egos; "corrected" is the centralised judge without errors that last."""
    found, links = {}, recording.links
    none = type(links)(links.step[:0], links.observer[:0], links.neighbour[:0])
    solo = replace(recording, links=none, relative=recording.relative[:, :0], arrival=recording.arrival[:, :0])
    for name, method in BASELINES.items():
        track = method(solo if "alone" in name else recording, egos)
        assert track.covariance is not None
        pairs = [(track.x[:, :, e] - fleet.position[:, ego], track.covariance[:, :, e]) for e, ego in enumerate(egos)]
        found[name] = (*np.mean([scores(*pair) for pair in pairs], axis=0), 1e6 * track.seconds / track.x[..., 0].size)
        if name == "the rules":
            lasts = [{key: v[:, :, e] for key, v in track.extras.items() if v.ndim == 3} for e in range(len(egos))]
    packs = [pack(recording, ego, fleet, outlier=0.0) for ego in egos]
    better = [pack(corrected(recording, ego, lasts[e]), ego, fleet) for e, ego in enumerate(egos)]
    for name, judge in (
        *judges.items(),
        *((f"corrected{key[11:]}", judges[key]) for key in judges if "centralised /" in key),
    ):
        began = time.perf_counter()
        some = [alone(stars) for stars in packs] if "alone" in name else better if "corrected" in name else packs
        tracks = [follow(stars, judge) for stars in some]
        took = 1e6 * (time.perf_counter() - began) / (recording.runs * len(recording.t) * len(egos))
        pairs = [(x - fleet.position[:, ego], cov) for (x, cov, _), ego in zip(tracks, egos, strict=True)]
        found[name] = (*np.mean([scores(*pair) for pair in pairs], axis=0), took)
    return found


def corrected(recording: co.Recording, ego: int, found: Mapping[str, Any]) -> co.Recording:
    """Measurements of an ego without the errors that last, as the rules have found them until each step, (R, T)."""
    velocity, relative, links = recording.velocity.copy(), recording.relative.copy(), recording.links.of(ego)
    flat = velocity[:, :, ego, :2] @ [1.0, 1.0j] * np.exp(1j * found["heading_error"])
    turned = np.stack([flat.real, flat.imag, velocity[:, :, ego, 2]], axis=-1)
    velocity[:, :, ego] = (1.0 + found["scale_error"])[..., None] * turned
    step, turn = recording.links.step[links], 2.0 * np.pi
    relative[:, links, 0] = np.maximum(relative[:, links, 0] - found["range_offset"][:, step], 0.1)
    relative[:, links, 1] = (relative[:, links, 1] - found["compass_error"][:, step] + np.pi) % turn - np.pi
    sensors = replace(recording.sensors, heading_bias_std=0.0, range_offset_std=0.0)
    return replace(recording, velocity=velocity, relative=relative, sensors=sensors)


def named(found: Sequence[Levels], name: str, column: int = 0) -> Floats:
    """(worlds, seeds or clients) of a method."""
    keys = [key for key in found[0] if key.partition(" / ")[0] == name]
    return np.array([[one[key][column] for key in keys] for one in found])


def over(logarithms: Floats) -> str:
    """Geometric mean with its interval over worlds."""
    level = mean_interval(logarithms)
    return f"{np.exp(level.mean):.3f} [{np.exp(level.low):.3f}, {np.exp(level.high):.3f}]"


def table(found: Sequence[Levels]) -> str:
    """Markdown: each method over `joint` and over the rules."""
    heads = ("method", "over joint", "over the rules", "each", "worse than alone [%]", "NEES inside", "us a step")
    rows = [heads, ("---",) * len(heads)]
    for name in dict.fromkeys(key.partition(" / ")[0] for key in found[0]):
        level, took = np.log(named(found, name)), named(found, name, 2)
        joint, rules = (level - np.log(named(found, other)) for other in ("joint", "the rules"))
        worse = 100.0 * np.mean(named(found, name) > WORSE * named(found, "kalman"))
        each = ", ".join(f"{value:.3f}" for value in np.exp(rules.mean(axis=0))) if rules.shape[1] > 1 else ""
        inside = f"{np.mean(named(found, name, 1)):.2f}"
        rows.append(
            (
                name,
                over(joint.mean(axis=1)),
                over(rules.mean(axis=1)),
                each,
                f"{worse:.1f}",
                inside,
                f"{np.median(took):.0f}",
            )
        )
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def by_kind(found: Sequence[Levels], kinds: Sequence[Sequence[str]]) -> str:
    """Markdown: geometric mean over `joint` by kind of fault, and how many worlds have it."""
    rows = [["kind of fault", "worlds", *MAIN], ["---"] * (len(MAIN) + 2)]
    for kind in ["", *sorted({each for of in kinds for each in of})]:
        some = [one for one, of in zip(found, kinds, strict=True) if kind in of or (not kind and not of)]
        if some:
            cells = [np.exp(np.mean(np.log(named(some, name) / named(some, "joint")))) for name in MAIN]
            rows.append([kind or "nothing wrong", str(len(some)), *(f"{cell:.2f}" for cell in cells)])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def transfer(found: Sequence[Levels], kinds: Sequence[Sequence[str]]) -> str:
    """The judge that never met some kinds over the centralised one, in worlds with them and in the others."""
    met = np.array([not any(kind.startswith(LEFT_OUT) for kind in of) for of in kinds])
    ratio = np.log(named(found, "left out of training")[:, 0] / named(found, "centralised")[:, 0])
    parts = [f"{over(ratio[met == known])} in {(met == known).sum()} worlds" for known in (False, True)]
    return f"left out of training over centralised: {parts[0]} with such faults, {parts[1]} without"


def main(
    worlds: int = 1500, report: int = 400, seeds: int = 2, phases: int = 4, steps: int = 1000,
    small: bool = False, out: Path | None = None, data: Path | None = None,
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
    judges = trained(worlds, seeds, phases, steps)
    sent = 8 * phases * ROUNDS * HEADS * SIZE
    print(f"{HEADS * SIZE} weights; a federated client sends and receives {sent} bytes", flush=True)
    found, kinds = list[Levels](), list[tuple[str, ...]]()
    for seed in tqdm(range(report), "unseen worlds", disable=None):
        one = world(seed, "validation")
        found.append(judged(one.recording.of_runs(slice(0, 2)), one.fleet, list(one.egos), judges))
        kinds.append(one.kinds)
    print(table(found), by_kind(found, kinds), transfer(found, kinds), sep="\n\n")
    for task in CONVOYS:
        try:
            recording, fleet = convoy(task, data)
        except co.InputError as error:
            print(f"{task}: {error}")
            continue
        levels = [judged(recording, fleet, range(len(recording.ids)), judges)]
        print(task, *(f"{name} {np.mean(named(levels, name)):.3f}" for name in ("joint", "textbook", *MAIN)), sep=", ")
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        columns: Any = {name.replace(" / ", "."): np.array([one[name] for one in found]) for name in found[0]}
        weights: Any = {name.replace(" / ", "."): judge.weights for name, judge in judges.items()}
        np.savez(out / "weights.npz", **weights)
        np.savez(out / "columns.npz", kinds=np.array(["; ".join(of) for of in kinds]), **columns)


if __name__ == "__main__":
    tyro.cli(main)
