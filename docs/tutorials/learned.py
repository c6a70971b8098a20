# %% [markdown]
# # Train, federate and stream a learned gain
#
# KalmanNet replaces the Kalman gain by a small recurrent net. Here vehicles train one net without sending their drives:
# each trains on its own drive, and a server averages the weights. Then the net runs on a new drive, step by step.
# The sizes are small, so that this page is built in a minute; `coopoc paper` does it in full.

# %%
import coopoc as co
from coopoc.learned import GainNet, LearnedGain, clients, federate, load_method

drives = co.load_fleet("town10-clients")
print({name: int(drives.present[:, k].sum()) for k, name in enumerate(drives.ids)}, "steps")

# %% [markdown]
# ## Five rounds of federated averaging
#
# `clients` cuts every drive into pieces of 100 steps and draws the noise of its sensors. `federate` needs a net, the
# clients and a number of rounds; rules and participation are arguments
# ([federation](../federation.md)).

# %%
fed = federate(GainNet(), clients(drives), rounds=5, seed=0)
for one in fed.history:
    print(one.number, "validation loss, mean over clients:", round(sum(one.validation_loss) / 4, 3), "m^2")

# %% [markdown]
# ## On a drive that none of them saw

# %%
fleet = co.load_fleet("town10")
seen = co.observe(fleet, co.Sensors.paper_scenario2(), co.V2X(max_neighbours=0), runs=20, seed=1, observers=[24])
for name, method in {
    "GNSS": co.GNSS(),
    "untrained net": LearnedGain(GainNet()),
    "five rounds": LearnedGain(fed.model),
    "twenty rounds (shipped)": load_method("fedkalmannet"),
    "nine learned variances (shipped)": load_method("okf"),
    "Kalman filter, nominal": co.Kalman("nominal"),
}.items():
    print(f"{name:26s}{co.rt_le(method(seen, [24]), fleet).mean():6.2f} m")

# %% [markdown]
# ## Step by step
#
# On a vehicle, measurements arrive one at a time. `start` returns a stream that takes one fix and one velocity per step
# and gives the numbers of the Track.

# %%
method = load_method("okf")
stream = method.start()
for step in range(5):
    x, covariance = stream.step(seen.gnss[0, step, 24], seen.velocity[0, step, 24], seen.dt)
    print(step, x.round(2))
