# %% [markdown]
# # Compare methods on a drive
#
# Sixty vehicles drive through a town. The position of one of them, the ego, is estimated by solo filters, by filters
# that use messages of its neighbours, and by a net that was trained on four other vehicles. All use the same noise
# draws, and the posterior Cramér-Rao bound is the least error that any filter with the same measurements can have.

# %%
import coopoc as co
from coopoc.learned import load_method

fleet = co.load_fleet("town10")
sensors, v2x, ego = co.Sensors.paper_scenario2(), co.V2X(max_neighbours=4), "town10-24"
seen = co.observe(fleet, sensors, v2x, runs=20, seed=0, observers=[ego])
seen

# %% [markdown]
# A `Recording` contains the measurements of all vehicles in 20 noise draws, and no truth. Dots are fixes; lines connect
# the ego with the neighbours that it measures at one step.

# %%
co.plot_recording(seen.between(0, 300), step=150).figure

# %% [markdown]
# ## Six methods
#
# RT-LE is the root of the time-averaged squared error. The noise model is the noise that a method assumes: `identity`
# has unit covariances, as the paper's baselines do; `nominal` has the acting standard deviations.

# %%
methods = {
    "GNSS": co.GNSS(),
    "Kalman filter, identity": co.Kalman("identity"),
    "Kalman filter, nominal": co.Kalman("nominal"),
    "FedKalmanNet": load_method("fedkalmannet"),
    "LKF-SA, identity": co.LKFSA("identity"),
    "joint filter, nominal": co.JointFilter("nominal"),
}
tracks = {name: method(seen, [ego]) for name, method in methods.items()}
for name, track in tracks.items():
    rate = track.received_bytes.mean() / (len(track.t) * seen.dt)
    print(f"{name:25s}{co.rt_le(track, fleet).mean():6.2f} m {rate:8.0f} B/s")
bound = co.bound_rt_le(co.posterior_bound(fleet, sensors, ego, v2x))
print(f"{'bound of the star':25s}{bound:6.2f} m")

# %% [markdown]
# ## Is the difference real?
#
# Draws are paired: both methods have the same noise, so that the interval of their difference is narrow.

# %%
solo = co.rt_le(tracks["Kalman filter, nominal"], fleet)
joint = co.rt_le(tracks["joint filter, nominal"], fleet)
print(co.paired_difference(joint, solo))

# %% [markdown]
# ## Is its covariance consistent?
#
# NEES, the squared error in units of the claimed covariance, is 3 on average for a consistent position in space.

# %%
for name in ("Kalman filter, identity", "Kalman filter, nominal", "joint filter, nominal"):
    print(f"{name:25s} NEES {co.nees(tracks[name], fleet).mean():6.2f}")

# %%
co.plot_track(tracks["joint filter, nominal"], fleet=fleet, every=45).figure

# %% [markdown]
# ## In your own notebook
#
# `to_frame` gives a track or a fleet as a long table of pandas, with a row per run, step and vehicle.

# %%
table = tracks["joint filter, nominal"].to_frame()
truth = fleet.to_frame().rename(columns={"vehicle": "ego"})
both = table.merge(truth, on=["step", "t", "ego"], suffixes=("", "_true"))
both["error"] = sum((both[axis] - both[f"{axis}_true"]) ** 2 for axis in "xyz") ** 0.5
both.loc[both.run == 0, ["t", "ego", "x", "y", "std_x", "std_y", "error"]].iloc[::180].round(2)

# %% [markdown]
# `write_tum` writes the path of one run for other programs, such as evo.

# %%
import tempfile
from pathlib import Path

folder, track = Path(tempfile.mkdtemp()), tracks["joint filter, nominal"]
co.write_tum(folder / "joint.tum", track.t, track.x[0, :, 0])
co.write_tum(folder / "truth.tum", fleet.t, fleet.position[:, fleet.index(ego)])
print((folder / "joint.tum").read_text()[:67])

# %% [markdown]
# `evo_ape tum truth.tum joint.tum` then gives the absolute error of the path.
#
# ## Over neighbours, with tables and figures
#
# A study does this over a grid, resumes after Ctrl-C, and writes tables and figures for a paper:
#
#     coopoc run neighbours --set runs=30
#     coopoc table runs/neighbours --format latex
