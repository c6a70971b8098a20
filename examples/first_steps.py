"""The three uses in one file: observe a drive, solve one snapshot, compare filters with the bound."""

import coopoc as co
from coopoc.learned import load_method


def main() -> None:
    """Print a solved snapshot and a small comparison."""
    fleet = co.load_fleet("town10")
    sensors, v2x, ego = co.Sensors.paper_scenario2(), co.V2X(max_neighbours=6), "town10-24"
    seen = co.observe(fleet, sensors, v2x, runs=10, seed=0, observers=[ego])

    problem = co.Problem.from_snapshot(seen, step=100, ego=fleet.index(ego))
    for backend in ("gauss-newton", "gtsam", "casadi", "osqp"):
        print(f"{backend:13s}{co.solve(problem, backend=backend)}")

    methods = {
        "GNSS": co.GNSS(),
        "Kalman, identity": co.Kalman("identity"),
        "Kalman, nominal": co.Kalman("nominal"),
        "FedKalmanNet": load_method("fedkalmannet"),
        "LKF-SA, identity": co.LKFSA("identity"),
        "Joint filter, nominal": co.JointFilter("nominal"),
    }
    for name, method in methods.items():
        track = method(seen, [ego])
        rate = track.received_bytes.mean() / (len(track.t) * seen.dt)
        print(f"{name:22s} RT-LE {co.rt_le(track, fleet).mean():5.2f} m, receives {rate:5.0f} B/s")
    bound = co.bound_rt_le(co.posterior_bound(fleet, sensors, fleet.index(ego), v2x))
    print(f"{'bound of the star':22s}       {bound:5.2f} m")


if __name__ == "__main__":
    main()
