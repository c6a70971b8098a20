# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Your own logs
#
# Two cars and a road-side unit: fixes once a second, wheel speed and compass ten times a second, UWB ranges five
# times a second, and their own column layout. The first cell writes such a file, with a gap, as a logger would. The
# other cells work the same on your file; [Your data](../your_data.md) describes all kinds and columns.

# %%
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd

import coopoc as co

rng = np.random.default_rng(2)
t = np.arange(0, 60, 0.1)
rows = []
for car, lane in (("red", 0.0), ("blue", 3.5)):
    course = 0.4 * np.sin(2 * np.pi * t / 40)
    x, y = np.cumsum(np.cos(course)) + 4 * lane, np.cumsum(np.sin(course)) + lane
    for k, now in enumerate(t):
        if k % 10 == 0 and not 25 < now < 32:
            rows += [(now, car, "x", "", x[k] + rng.normal(0, 2)), (now, car, "y", "", y[k] + rng.normal(0, 2))]
        rows.append((now, car, "speed_kmh", "", 36 + rng.normal(0, 0.7)))
        rows.append((now, car, "compass_deg", "", (90 - np.degrees(course[k]) + rng.normal(0, 0.5)) % 360))
        if k % 2 == 0:
            rows.append((now, car, "uwb", "gate", np.hypot(x[k] - 300, y[k] - 20) + rng.normal(0, 0.2)))
rows += [(0.0, "gate", "x", "", 300.0), (0.0, "gate", "y", "", 20.0)]
folder = Path(tempfile.mkdtemp())
table = pd.DataFrame(rows, columns=["zeit", "auto", "kind", "partner", "value"])
table.to_csv(folder / "log.csv", index=False)
table.head(8)

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
)
print(log.summary)

# %%
co.plot_recording(log.recording, step=300).figure

# %% [markdown]
# ## Methods on it
#
# Without a truth, innovations take the place of scores: the distance of the next fix from its prediction. A normalised
# innovation (NIS) near 1 means that the assumed noise agrees with the acting noise.

# %%
from coopoc.evaluate.metrics import innovation_columns

for method in (co.Kalman("nominal"), co.JointFilter("nominal")):
    track = method(log.recording, ["red", "blue"])
    found = innovation_columns(track, log.recording)
    print(f"{method.name:8s} innovation {found['innovation_m'].mean():.2f} m, NIS {found['nis'].mean():.2f}")

# %%
co.plot_track(track, every=60).figure

# %% [markdown]
# ## The same by commands
#
# `coopoc data check "log.csv?columns=t:zeit,vehicle:auto"` prints the summary, tests the units against the geometry and
# draws a picture; `coopoc run side_by_side --data "log.csv?columns=t:zeit,vehicle:auto"` compares methods.
#
# If you have a truth, put it into a file `truth.csv` beside the log; then studies give errors and intervals.

# %% [markdown]
# ## A typical mistake

# %%
try:
    co.read_log(folder / "log.csv", columns={"t": "zeit", "vehicle": "auto"})
except co.InputError as error:
    print(error)
