"""PyFG and g2o files of a graph, written from the definitions of the formats: what the readers must give back."""

import numpy as np


def write_graph(graph, path):
    """Write a .pyfg file with stamps and covariances, or a .g2o file with GTSAM's symbol keys and information."""
    pyfg, d = path.suffix == ".pyfg", graph.dimension
    pose, point = f"SE{d}{':QUAT' if d == 3 else ''}", "XY" if d == 2 else "XYZ" if pyfg else "TRACKXYZ"
    tags = {"relative_pose": f"EDGE_{pose}", "relative_point": f"EDGE_SE{d}_{point}", "ranges": "EDGE_RANGE"}
    if pyfg:
        tags |= {"pose_prior": f"VERTEX_{pose}:PRIOR", "point_prior": f"VERTEX_{point}:PRIOR"}
    elif d == 2:
        tags |= {"pose_prior": "EDGE_PRIOR_SE2", "point_prior": "EDGE_PRIOR_XY"}
    else:
        tags |= {"pose_prior": "EDGE_SE3_PRIOR", "point_prior": "EDGE_POINTXYZ_PRIOR"}
    names = [name if pyfg else str((ord(name[0]) << 56) + int(name[1:])) for name in graph.names]
    lines = [] if pyfg or d == 2 else ["PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1"]

    def line(tag, stamp, ends, numbers):
        time = [repr(float(stamp))] if pyfg and np.isfinite(stamp) else []
        lines.append(" ".join([tag, *time, ends, *map(repr, numbers.tolist())]))

    for k, name in enumerate(names):
        if graph.is_pose[k]:
            line(f"VERTEX_{pose}", graph.stamps[k], name, np.concatenate([graph.position[k], graph.orientation[k]]))
        else:
            line(f"VERTEX_{point}", np.nan, name, graph.position[k])
    for kind, tag in tags.items():
        edges = getattr(graph, kind)
        for k, nodes in enumerate(edges.nodes):
            if kind == "ranges":
                values, cov = edges.distance[k : k + 1], edges.variance[k].reshape(1, 1)
            else:
                values, cov = edges.position[k], edges.covariance[k]
            if "pose" in kind:
                values = np.concatenate([values, edges.orientation[k]])
            noise = (cov if pyfg else np.linalg.inv(cov))[np.triu_indices(len(cov))]
            offset = " 0" if tag in ("EDGE_SE3_PRIOR", "EDGE_SE3_TRACKXYZ") else ""
            line(tag, edges.stamps[k], " ".join(names[n] for n in nodes) + offset, np.concatenate([values, noise]))
    lines += [] if pyfg else [f"FIX {names[k]}" for k in graph.fixed]
    path.write_text("\n".join([*lines, ""]))
