"""What the interpreter shows of a result: one line with its kind and sizes, never its numbers by the thousand."""

import dataclasses
import importlib
import re

import numpy as np
import pytest

import coopoc as co
from coopoc.learned import GainNet, LearnedGain, clients, federate, load, save
from coopoc.learned.checkpoint import Checkpoint

LINE = 400
"""Characters that a result may take in an interpreter."""


def one_line(result):
    """The repr of a result, checked."""
    shown = repr(result)
    assert shown.startswith(type(result).__name__), shown[:LINE]
    assert "\n" not in shown, shown[:LINE]
    assert len(shown) <= LINE, shown[:LINE]
    return shown


@pytest.fixture(scope="module")
def recording():
    fleet = co.load_fleet("town10").between(0, 60)
    return co.observe(fleet, co.Sensors.paper_scenario2(), co.V2X(max_neighbours=6), runs=8, observers=[24])


def test_tracks_and_methods_show_their_sizes(recording):
    track = co.Kalman("nominal", x0=np.zeros((8, 1, 3)))(recording, egos=[24])
    assert "x (8, 60, 1, 3)" in one_line(track)
    assert "egos=(24,)" in repr(track)
    assert "x0 (8, 1, 3)" in one_line(co.Kalman("nominal", x0=np.zeros((8, 1, 3))))
    assert "begin (8, 60, 4)" in one_line(co.PoseFilter("fleet", begin=np.zeros((8, 60, 4))))
    one_line(co.NoiseModel.nominal(recording.sensors))
    one_line(recording)


def test_solutions_show_status_and_cost(recording):
    solution = co.solve(co.Problem.from_snapshot(recording, step=20, ego=24))
    assert "status=SOLVED" in one_line(solution)
    assert f"cost={solution.cost:.6g}" in repr(solution)


def test_trained_nets_do_not_show_their_weights(tmp_path):
    drives = co.load_fleet("town10-clients").between(0, 400)
    federation = federate(GainNet(), clients(drives), rounds=1, local_epochs=1, seed=0)
    assert "history=2 x Round" in one_line(federation)
    assert "rejected" not in one_line(federation.history[1])
    one_line(LearnedGain(federation.model))
    assert "history" not in one_line(load(save(tmp_path / "net.safetensors", Checkpoint(federation.model, {}))))


def test_exported_dataclasses_of_arrays_show_shapes():
    """All that `co`, `co.optimize` and `co.learned` export, whether a test above makes one or not."""
    made_by_users = "Measurement$|^SolverResult$"  # a user or a solver makes these of a few numbers
    for module in ("coopoc", "coopoc.optimize", "coopoc.optimize.convex", "coopoc.learned"):
        package = importlib.import_module(module)
        for name in package.__all__:
            kind = getattr(package, name)
            if isinstance(kind, type) and dataclasses.is_dataclass(kind) and not re.search(made_by_users, name):
                types = {str(field.type) for field in dataclasses.fields(kind) if field.repr}
                if any(re.search("Floats|Ints|Bools|DataFrame|Tensor", one) for one in types):
                    assert not hasattr(kind.__repr__, "__wrapped__"), name  # which the repr of dataclasses has
