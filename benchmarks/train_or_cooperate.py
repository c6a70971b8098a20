"""What is worth more on real robots, training or cooperating online, at equal bytes? RT-LE against bytes sent.

python benchmarks/train_or_cooperate.py MRCLAM_Dataset6 --figure docs/real_bytes.png

Noise of the pose filter is learned on the first 300 s from true poses: by each robot alone, federated (the mean of the
logarithms over the robots, once: 7 numbers up and down, 4 B each) and centralised (all that a robot measured, 4 B a
number). Then the rest is driven with few landmarks: alone with each, and with K neighbours and calibrated noise.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np

from coopoc import V2X, Sensors
from coopoc.arrays import Floats
from coopoc.evaluate.ledger import of_track
from coopoc.evaluate.metrics import errors
from coopoc.evaluate.statistics import mean_interval
from coopoc.learned.pose_noise import LEARNED, PoseTask, fit_pose_noise
from coopoc.studies import pose_drives as drives
from coopoc.studies.real import SETTLED, TRAINING, _filter

GATE, LANDMARKS = 5.0, (0, 2, 4)


def main() -> None:
    """Print the table and draw the figure."""
    options = argparse.ArgumentParser()
    options.add_argument("data")
    options.add_argument("--until", type=float, default=300.0)
    options.add_argument("--evaluations", type=int, default=150)
    options.add_argument("--block", type=float, default=30.0)
    options.add_argument("--figure", default="")
    given = options.parse_args()
    alone = drives.drive(given.data, given.until, V2X(max_neighbours=0, radius=float("inf")), GATE)
    assert alone.truth is not None
    dt, noise = alone.recording.dt, alone.recording.sensors
    start, settled = int(given.until / dt), int(min(SETTLED, given.until / 10) / dt)
    truth, marks = alone.truth.between(0, start), len(alone.recording.landmarks)
    parts = [
        drives.thinned(alone.recording, n, settled).between(0, start) for n in sorted({min(n, marks) for n in TRAINING})
    ]

    def fitted(egos: tuple[str, ...]) -> Sensors:
        tasks = [PoseTask(part, truth, egos, _filter({}, 0, GATE, alone), settled) for part in parts]
        return fit_pose_noise(tasks, noise, given.evaluations)

    own = [fitted((ego,)) for ego in alone.ids]
    names = [name for name in LEARNED if getattr(noise, name) > 0]
    means = {name: float(np.exp(np.mean([np.log(getattr(one, name)) for one in own]))) for name in names}
    first = alone.recording.between(0, start)
    held = sum(int(np.isfinite(part).sum()) for part in (first.gnss, first.relative)) + 2 * start * len(alone.ids)
    ways: list[tuple[str, int, Any, float]] = [
        ("calibrated", 0, noise, 0.0),
        ("trained alone", 0, own, 0.0),
        ("trained federated", 0, replace(noise, **means), 8.0 * len(names)),
        ("trained centralised", 0, fitted(alone.ids), 4.0 * held / len(alone.ids)),
        *((f"online, K = {k}", k, noise, 0.0) for k in range(1, min(5, len(alone.ids)))),
    ]
    shown = []
    for label, k, assumed, trained in ways:
        drive = drives.drive(given.data, given.until, V2X(max_neighbours=k, radius=float("inf")), GATE)
        sent, cells = trained, list[Any]()
        for n in LANDMARKS:
            recording, method = drives.thinned(drive.recording, n, start), _filter({}, k, GATE, drive)
            each = assumed if isinstance(assumed, list) else [assumed]
            tracks = [replace(method, assumed=one)(recording, drive.ids) for one in each]
            assert drive.truth is not None
            error = np.stack(
                [errors(tracks[i % len(tracks)], drive.truth)[0, :, i] for i in range(len(drive.ids))], axis=1
            )
            cells.append(mean_interval(blocks(error[start:], int(given.block / dt))))
            if k:
                account = of_track(tracks[0], recording, method.message)
                per_second = account.of("online", "on air", "broadcast") / account.seconds
                sent = float(per_second.mean()) * (len(recording.t) - start) * dt
        shown.append((label, sent, cells))
        row = " | ".join(f"{one.mean:.3f} [{one.low:.3f}, {one.high:.3f}]" for one in cells)
        print(f"| {label} | {sent:,.0f} | {row} |", flush=True)
    if given.figure:
        draw(shown, given.figure)


def blocks(error: Floats, size: int) -> Floats:
    """(E, B) root mean square of errors (T, E) over blocks of steps."""
    parts = [error[k : k + size] for k in range(0, len(error) - size + 1, size)]
    return np.array([np.sqrt(np.nanmean(part**2, axis=0)) for part in parts]).T


def draw(shown: list[tuple[str, float, list[Any]]], file: str) -> None:
    """RT-LE against bytes per robot, a panel per number of landmarks; no bytes stand at 1."""
    from matplotlib import colormaps
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(LANDMARKS), figsize=(9.0, 3.4), sharex=True, sharey=True, layout="constrained")
    for column, (axis, n) in enumerate(zip(axes, LANDMARKS, strict=True)):
        for number, (label, sent, cells) in enumerate(shown):
            one, online = cells[column], label.startswith("online")
            bars = [[one.mean - one.low], [one.high - one.mean]]
            beside = 1.15 ** (number - 4) if online else 1.4 if "alone" in label else 1.0  # equal bytes, side by side
            place, color = max(sent, 1.0) * beside, colormaps["tab10"](number)
            axis.errorbar(place, one.mean, bars, fmt="s" if online else "o", color=color, label=label)
        axis.set(xscale="log", yscale="log", title=f"{n} landmarks", xlabel="Bytes sent per robot")
    axes[0].set_ylabel("RT-LE [m]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    figure.savefig(file, dpi=120)


if __name__ == "__main__":
    main()
