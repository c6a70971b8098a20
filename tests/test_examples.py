"""The examples run as they stand; the lazy names of the package are those that types see."""

import ast
import sys
from pathlib import Path

from architecture import layers
from shell import ran
from torch.nn import GRUCell

import coopoc
from coopoc.learned.nets.gain_net import GainNet

ROOT = Path(__file__).resolve().parents[1]


def test_first_steps_runs() -> None:
    script = ROOT / "examples" / "first_steps.py"
    out = ran([sys.executable, "-W", "error", script], check=True).stdout
    assert out.count("SOLVED") == 4
    assert "FedKalmanNet" in out


def test_the_net_is_drawn_from_itself() -> None:
    """The paper's order of three GRUs (section II.B), of which the gain takes the last two."""
    made, takes, kept = layers(GainNet(in_mult=2))
    assert [name for name, layer in made.items() if isinstance(layer, GRUCell)] == ["process", "prior", "innovation"]
    assert takes["gain_hidden"] == ["prior", "innovation"]
    assert kept == {"process": "process", "prior": "posterior", "innovation": "innovation"}


def test_lazy_names_are_the_typed_names() -> None:
    tree = ast.parse((ROOT / "coopoc" / "__init__.pyi").read_text())
    typed = {alias.asname for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert typed - {None} == set(coopoc.__all__)
    for name in coopoc.__all__:
        assert getattr(coopoc, name).__name__.split(".")[-1] == name
