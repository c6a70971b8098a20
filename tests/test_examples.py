"""The examples run as they stand; the lazy names of the package are those that types see."""

import ast

import judge
import numpy as np
import pytest
import star
from architecture import layers
from numpy.testing import assert_allclose
from shell import ROOT, python
from torch.nn import GRUCell

import coopoc
from coopoc.learned.nets.gain_net import GainNet
from coopoc.studies.world_faults import KINDS
from coopoc.studies.worlds import world


def test_first_steps_runs():
    out = python("-W", "error", ROOT / "examples" / "first_steps.py")
    assert out.count("SOLVED") == 4
    assert "FedKalmanNet" in out


def test_the_net_is_drawn_from_itself():
    """The paper's order of three GRUs (section II.B), of which the gain takes the last two."""
    made, takes, kept = layers(GainNet(in_mult=2))
    assert [name for name, layer in made.items() if isinstance(layer, GRUCell)] == ["process", "prior", "innovation"]
    assert takes["gain_hidden"] == ["prior", "innovation"]
    assert kept == {"process": "process", "prior": "posterior", "innovation": "innovation"}


def test_lazy_names_are_the_typed_names():
    tree = ast.parse((ROOT / "coopoc" / "__init__.pyi").read_text())
    typed = {alias.asname for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert typed - {None} == set(coopoc.__all__)
    for name in coopoc.__all__:
        assert getattr(coopoc, name).__name__.split(".")[-1] == name


WITH_AND_WITHOUT = (world(9, "development", without=[*KINDS]), world(12, "development"))


@pytest.mark.parametrize("drawn", WITH_AND_WITHOUT, ids=("nothing wrong", "faults"))
def test_a_judge_of_ones_is_the_textbook_filter(drawn):
    expected = coopoc.JointFilter(robust=False)(drawn.recording, list(drawn.egos))
    believing = judge.begin(0)
    believing[:, -star.HIDDEN[1] - 1 : -1] = 0.0
    for e, ego in enumerate(drawn.egos):
        stars = star.pack(drawn.recording, ego, drawn.fleet)
        for one in (star.Judge(star.NONE), star.Judge(star.NET, believing)):
            x, covariance, _ = star.follow(stars, one)
            assert_allclose(x, expected.x[:, :, e], atol=1e-7)
            assert_allclose(covariance, expected.covariance[:, :, e], atol=1e-9, rtol=1e-6)


def test_a_judge_learns_its_targets():
    rows = judge.rows_of(
        [star.pack(drawn.recording, drawn.egos[0], drawn.fleet) for drawn in WITH_AND_WITHOUT], star.Judge(star.NONE), 0
    )
    assert sum(map(len, rows)) > 100
    assert all(np.isfinite(each).all() for each in rows)
    before = judge.begin(0)
    after = judge.fit(before, rows, 100, 0)

    def loss(weights, head):
        every = np.tile(rows[head], (star.HEADS, 1, 1))
        found = judge.logarithms(*map(judge.torch.from_numpy, (weights.astype(np.float32), every[:, :, :-1])))
        return float(abs(found[head].numpy() - every[head, :, -1]).mean())

    for head in (star.OWN, star.MOTION):
        assert loss(after, head) < loss(before, head)
