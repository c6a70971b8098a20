"""The README's table by a simulation that shares no code with the toolkit, on the fleet's arrays alone."""

import json
import re

import numpy as np
import pytest
from oracles.paper_scenario import simulate
from shell import ROOT

import coopoc as co

REFERENCE = ROOT / "studies" / "reference" / "neighbours.json"
METHODS = (("gnss", "none"), ("lkf-sa", "identity"), ("joint", "nominal"))


def published(most, method, noise_model):
    """Mean RT-LE m of the five egos, and its standard deviation from run to run."""
    for number in json.loads(REFERENCE.read_text())["numbers"]:
        where = number["where"] | {"metric": number["metric"]}
        if where | {"max_neighbours": most, "method": method, "noise_model": noise_model, "metric": "rt_le_m"} == where:
            return number["value"], number["run_std"]
    raise AssertionError((most, method, noise_model))


NAMES = {"Kalman filter": "kalman", "FedKalmanNet": "fedkalmannet", "LKF-SA": "lkf-sa", "joint filter": "joint"}


def test_the_table_of_the_answer_is_the_committed_one():
    """Errors by the reference, the robots' by the page on them."""
    readme, real = ((ROOT / page).read_text() for page in ("README.md", "docs/real.md"))
    rows = re.findall(r"^\|(\w+): (.+?)\|(\w+)\|(\S+) \[(\S+), (\S+)\]\|(.*)", readme, re.MULTILINE)
    for kind, name, noise_model, mean, low, high, rest in rows:
        most = 10 * (kind in ("decide", "both"))
        assert f"{published(most, NAMES[name], noise_model)[0]:.2f}" == mean
        assert low < mean < high
        assert all(f"| {robots} |" in real.replace("*", "") for robots in re.findall(r"[\d.]+ \[.*?\]", rest))
    assert len(rows) == 5


@pytest.mark.parametrize("most", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 4, 10))])
def test_an_independent_simulation_gives_the_published_errors(most):
    fleet = co.load_fleet("town10")
    draws = [np.random.default_rng([most, ego]) for ego in range(0, 60, 12)]
    errors = [simulate(fleet.position, fleet.velocity, 12 * k, most, rng) for k, rng in enumerate(draws)]
    for found, (method, noise_model) in zip(np.mean(errors, 0), METHODS, strict=True):
        mean, std = published(most, method, noise_model)
        assert abs(found - mean) < 4.0 * std + 0.005 * mean, (method, found, mean, std)
