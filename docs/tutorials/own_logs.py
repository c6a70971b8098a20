# %% [markdown]
# # My log, from file to figure
#
# Two cars and a road-side unit: fixes once a second, wheel speed and compass ten times a second, UWB ranges five
# times a second, and their own column layout. The first cell writes such a file as a logger would: no fix under a
# bridge for seven seconds, a logger of `cab` that stops for four, and 5 % of the ranges too long by reflections. The
# other cells work the same on your file; [Your data](../your_data.md) describes all kinds and columns.

# %%
import tempfile
import textwrap
from pathlib import Path

import numpy as np
import pandas as pd

import coopoc as co

rng = np.random.default_rng(2)
t = np.round(np.arange(0, 60, 0.1), 1)
rows, truth = [], []
for car, lane in (("van", 0.0), ("cab", 3.5)):
    course = 0.4 * np.sin(2 * np.pi * t / 40)
    x, y = np.cumsum(np.cos(course)) + 4 * lane, np.cumsum(np.sin(course)) + lane
    truth += [(now, car, x[k], y[k]) for k, now in enumerate(t)]
    for k, now in enumerate(t):
        if car == "cab" and 44 < now < 48:
            continue
        if k % 10 == 0 and not 25 < now < 32:
            rows += [(now, car, "x", "", x[k] + rng.normal(0, 2)), (now, car, "y", "", y[k] + rng.normal(0, 2))]
        rows.append((now, car, "speed_kmh", "", 36 + rng.normal(0, 0.7)))
        rows.append((now, car, "compass_deg", "", (90 - np.degrees(course[k]) + rng.normal(0, 0.5)) % 360))
        if k % 2 == 0:
            wrong = rng.uniform(5, 20) if rng.random() < 0.05 else 0.0
            rows.append((now, car, "uwb", "gate", np.hypot(x[k] - 300, y[k] - 20) + rng.normal(0, 0.2) + wrong))
rows += [(0.0, "gate", "x", "", 300.0), (0.0, "gate", "y", "", 20.0)]
folder = Path(tempfile.mkdtemp())
table = pd.DataFrame(rows, columns=["zeit", "auto", "kind", "partner", "value"])
table.to_csv(folder / "log.csv", index=False)
pd.DataFrame(truth, columns=["t", "vehicle", "x", "y"]).to_csv(folder / "truth.csv", index=False)
table.head(6)

# %% [markdown]
# ## Read, and read what was read
#
# `columns` maps names to those of the file, `kinds` the kinds. Nothing is dropped silently: the summary counts what was
# read, what was not used and why.

# %%
log = co.read_log(
    folder / "log.csv",
    columns={"t": "zeit", "vehicle": "auto"},
    kinds={"uwb": "range"},
    sensors=co.Sensors(gnss_std=(2.0, 2.0, 2.0), velocity_std_ratio=0.03, range_std=0.2),
    truth=folder / "truth.csv",
)
print(log.summary)

# %% [markdown]
# ## Methods, where a vehicle is there
#
# A method follows a vehicle without a break. `cab` was away for four seconds: `recording.stretches` gives the steps
# in which a vehicle is there, and `between` cuts recording and truth alike. A filter starts anew in each stretch.

# %%
log.recording.stretches("cab")

# %%
METHODS = {"Kalman": co.Kalman(), "no gate": co.JointFilter(robust=False), "cooperative": co.CooperativeFilter()}
errors = {}
for name, method in METHODS.items():
    for car in ("van", "cab"):
        parts = []
        for start, stop in log.recording.stretches(car):
            track = method(log.recording.between(start, stop), [car])
            true = log.truth.between(start, stop)
            gap = track.x[0, :, 0] - true.position[:, true.index(car)]
            parts.append((track.t, np.linalg.norm(gap, axis=1)))
        errors[name, car] = parts
        every = np.concatenate([error for _, error in parts])  # the last step has no truth
        rms = np.sqrt(np.nanmean(every**2))
        print(f"{name:12s} {car:5s} {rms:.2f} m")

# %% [markdown]
# Without its gate the joint filter believes the reflected ranges; the cooperative filter gates them.
#
# ## The figure

# %%
import matplotlib.pyplot as plt

figure, axes = plt.subplots(2, sharex=True, sharey=True, figsize=(7.2, 4.2), layout="constrained")
for ax, car in zip(axes, ("van", "cab"), strict=True):
    for color, name in zip(("#E69F00", "#009E73", "#7A1FA2"), METHODS, strict=True):
        for k, (seconds, error) in enumerate(errors[name, car]):
            ax.plot(seconds, error, color=color, lw=1.2, label=None if k else name)
    ax.axvspan(25, 32, color="#E9ECEF", zorder=0)
    ax.set(title=f"{car}; grey: no fixes", ylabel="error [m]", yscale="log")
ax.set_xlabel("time [s]")
ax.legend(fontsize=8)
figure.savefig(folder / "errors.png")

# %%
ax = co.plot_recording(log.recording, step=100)
ax.legend(fontsize=8, markerscale=2)
ax.figure

# %% [markdown]
# ## Without a truth
#
# Innovations take the place of scores: the distance of the next fix from its prediction. A normalised innovation (NIS)
# near 1 means that the assumed noise agrees with the acting noise.

# %%
from coopoc.evaluate.metrics import innovation_columns

found = innovation_columns(co.Kalman("nominal")(log.recording, ["van"]), log.recording)
print(f"innovation {found['innovation_m'].mean():.2f} m, NIS {found['nis'].mean():.2f}")

# %% [markdown]
# ## The same by commands
#
# With the log and `truth.csv` in one folder, named in place of `log.csv`, these print the summary, test units against
# the geometry, and write tables with intervals and a report with the map and the errors over time:
#
#     coopoc data check "log.csv?columns=t:zeit,vehicle:auto"
#     coopoc run side_by_side --data "log.csv?columns=t:zeit,vehicle:auto"
#     coopoc report runs/side_by_side

# %% [markdown]
# ## A typical mistake

# %%
try:
    co.read_log(folder / "log.csv", columns={"t": "zeit", "vehicle": "auto"})
except co.InputError as error:
    print(textwrap.fill(str(error), 88))
