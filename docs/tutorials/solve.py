# %% [markdown]
# # Solve a cooperative localization problem
#
# Three vehicles and a road-side unit in the plane. Each vehicle has a fix, all measure ranges and bearings, one range
# is wrong by twenty metres, and a wall bounds the position of one vehicle. You will build the factor graph, solve it,
# find the outlier, add the wall, and check one solver against another.

# %%
import numpy as np

import coopoc as co

# %% [markdown]
# ## Nodes and factors
#
# A `Problem` has named nodes: points, or poses with a heading. `add` puts measurements between them; `std` is one
# standard deviation in metres or radians. Poses need a start, which `pose(position, angle)` writes.

# %%
truth = {"rsu": (0.0, 0.0, 0.0), "red": (30.0, 5.0, 0.1), "green": (45.0, 12.0, 0.4), "blue": (70.0, 4.0, 3.1)}
names = tuple(truth)
start = np.stack([co.pose(np.add(at[:2], (2.0, -1.5)), at[2] + 0.2) for at in truth.values()])

problem = co.Problem(names, dimension=2, poses=names, x0=start).add(
    "pose", "rsu", co.pose((0.0, 0.0), 0.0), std=[0.01, 0.01, 0.001]
)
fixes = np.array([[31.2, 3.1], [44.1, 13.6], [71.9, 2.9]])
problem = problem.add("position", names[1:], fixes, std=2.0)
problem


# %% [markdown]
# Ranges and bearings as each sees the others in its own body frame. We draw them from the truth with 0.3 m and
# 1 degree of noise; the range from red to blue is 20 m too long, as a reflection makes it.


# %%
def seen(a: str, b: str) -> tuple[float, float]:
    """Range m and bearing rad of b in the frame of a."""
    gap = np.subtract(truth[b][:2], truth[a][:2])
    return float(np.hypot(*gap)), float((np.arctan2(gap[1], gap[0]) - truth[a][2] + np.pi) % (2 * np.pi) - np.pi)


rng = np.random.default_rng(4)
pairs = [("rsu", "red"), ("red", "green"), ("green", "blue"), ("blue", "rsu"), ("red", "blue"), ("green", "rsu")]
ranges = np.array([[seen(a, b)[0] + rng.normal(0, 0.3)] for a, b in pairs])
bearings = np.array([[seen(a, b)[1] + rng.normal(0, np.deg2rad(1))] for a, b in pairs])
ranges[4] += 20.0

honest = problem.add("range", pairs, ranges, std=0.3).add("bearing", pairs, bearings, std=np.deg2rad(1))
solution = co.solve(honest)
print(solution)

# %% [markdown]
# The cost is half the sum of squared, whitened residuals. With 21 numbers and 12 unknowns it should be near 4.5.
# The outlier raises it to hundreds and shifts all vehicles.

# %%
error = np.linalg.norm(solution.position - [at[:2] for at in truth.values()], axis=1)
dict(zip(names, error.round(2).tolist(), strict=True))

# %% [markdown]
# ## An outlier
#
# The solution's note compares the cost with what the stated noise explains. A robust loss discounts
# large residuals. With one that rejects, `solve` starts by graduated non-convexity (Yang et al., RA-L 2020), from least
# squares with a loss that tightens; a measurement that ends with weight zero is an outlier. It still adds its truncated
# loss, 3²/2 = 4.5, to the cost.

# %%
robust = problem.add("range", pairs, ranges, std=0.3, loss=co.optimize.Loss("truncated", 3.0)).add(
    "bearing", pairs, bearings, std=np.deg2rad(1)
)
solution = co.solve(robust)
print(solution)
error = np.linalg.norm(solution.position - [at[:2] for at in truth.values()], axis=1)
dict(zip(names, error.round(2).tolist(), strict=True))

# %%
co.plot_solution(solution, problem=robust).figure

# %% [markdown]
# ## A wall
#
# Bounds are constraints on measurements. Without the bad range the estimate of blue is y = 2.1 m, but a wall at 1.5 m
# lies north of it. osqp takes linear constraints, casadi any, and `solve` chooses where no solver is named; another one
# raises an error that names these two.

# %%
good = [k for k in range(len(pairs)) if k != 4]
clean = problem.add("range", [pairs[k] for k in good], ranges[good], std=0.3).add(
    "bearing", pairs, bearings, std=np.deg2rad(1)
)
walled = clean.constrain("position", "blue", lower=[-np.inf, -np.inf], upper=[np.inf, 1.5])
for name, one in (("free", co.solve(clean)), ("walled", co.solve(walled))):
    print(f"{name:7s}", one.status.name, one["blue"][:2].round(2), f"cost {one.cost:.2f}")

# %%
try:
    co.solve(walled, backend="gtsam")
except co.InputError as error:
    print(error)

# %% [markdown]
# ## Another opinion
#
# Every backend solves the same problem, and the same checks, independent of the solver, verify its solution.

# %%
for backend in ("gauss-newton", "gtsam", "osqp"):
    other = co.solve(robust, backend=backend, throw=False)
    print(f"{backend:13s}", other.status.name, f"cost {other.cost:.6f}")
