"""gtsam.IncrementalFixedLagSmoother by a plain loop, with the factors that a user of GTSAM would write."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from coopoc.arrays import Floats
from coopoc.optimize import Problem


def by_hand(parts: Sequence[Problem], lag: float, dt: float) -> Floats:
    """Newest positions (T, vehicles, 2) m of GTSAM's smoother, whose covariances are computed, too.

    Args:
        parts: pieces of consecutive steps; poses are named "id@step", landmarks otherwise.
        lag: s.
        dt: s, between pieces.
    """
    params = gtsam.ISAM2Params()
    params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
    params.setRelinearizeThreshold(0.01)
    params.relinearizeSkip = 1
    smoother, keys, found = gtsam.IncrementalFixedLagSmoother(lag, params), {}, []
    for step, part in enumerate(parts):
        graph, new, stamps = gtsam.NonlinearFactorGraph(), gtsam.Values(), {}
        for k, (name, x) in enumerate(zip(part.names, part.x0, strict=True)):
            if name not in keys:
                keys[name] = len(keys)
                new.insert(keys[name], gtsam.Pose2(x[0], x[1], np.arctan2(x[4], x[2])) if k in part.poses else x[:2])
        stamps |= {key: dt * step for name, key in keys.items() if "@" not in name or name.endswith(f"@{step}")}
        for factor in part.factors:
            std = np.broadcast_to(factor.std, (len(factor.nodes), factor.std.shape[-1]))
            for nodes, z, s in zip(factor.nodes.tolist(), factor.z, std, strict=True):
                on, model = [keys[part.names[i]] for i in nodes], gtsam.noiseModel.Diagonal.Sigmas
                posed = nodes[-1] in part.poses
                if factor.kind == "relative_pose_log":
                    graph.add(gtsam.BetweenFactorPose2(*on, gtsam.Pose2(*z[:2], np.arctan2(z[4], z[2])), model(s)))
                elif factor.kind == "pose":
                    graph.add(gtsam.PoseRotationPrior2D(on[0], gtsam.Rot2(np.arctan2(z[4], z[2])), model(s[2:])))
                elif factor.kind == "position":
                    made = gtsam.PoseTranslationPrior2D if posed else gtsam.PriorFactorPoint2
                    graph.add(made(on[0], z, model(s)))
                elif factor.kind == "range":
                    graph.add((gtsam.RangeFactorPose2 if posed else gtsam.RangeFactor2D)(*on, z[0], model(s)))
                elif factor.kind == "bearing":
                    made = gtsam.BearingFactorPose2 if posed else gtsam.BearingFactor2D
                    graph.add(made(*on, gtsam.Rot2(z[0]), model(s)))
                else:
                    made = gtsam.BearingRangeFactorPose2 if posed else gtsam.BearingRangeFactor2D
                    graph.add(made(*on, gtsam.Rot2(z[1]), z[0], model(s[::-1].copy())))
        smoother.update(graph, new, stamps)
        here = [key for name, key in keys.items() if name.endswith(f"@{step}")]
        at = smoother.calculateEstimate(here)
        found.append([at.atPose2(key).translation() for key in here])
        for key in here:
            smoother.marginalCovariance(key)
    return np.array(found)
