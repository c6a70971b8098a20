"""The sections of docs/extend.md on nets and recipes, as they stand: trained, federated, saved, streamed, studied."""

import re

import pytest
import torch
from conftest import refused
from export_onnx import to_onnx
from shell import python
from test_extend import blocks, commands, shell

from coopoc.learned import Checkpoint, load, save
from coopoc.learned.nets.gain import flatten
from coopoc.learned.recipes import recipe_of
from coopoc.plugins import find

NET = "constant_gain.py:ConstantGain"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (text,) = (text for text in blocks("python") if text.startswith("# constant_gain.py"))
    (tmp_path / "constant_gain.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_net_of_ones_own_federates_saves_loads_and_streams(folder):
    (block,) = (text for text in blocks("python") if "load_method" in text)
    script = folder / "own_net.py"
    script.write_text(f"{block}\nassert abs(x - track.x[0, -1, 0]).max() < 1e-4\n")
    python("-W", "error", script, cwd=folder)


@pytest.mark.slow
def test_a_recipe_of_ones_own_trains_and_runs_beside_others(folder):
    trained, ran = (line for line in commands("constant_gain.py"))
    assert "constant_gain.RECIPE-gnss-axis-0.safetensors  3 parameters" in shell(trained, folder)
    table = shell(ran, folder)
    assert float(dict(re.findall(r"^\| (\S.*?) +\| +\**([\d.]+)\** \[", table, flags=re.MULTILINE))["RECIPE"]) < 2.0, (
        table
    )


def test_a_checkpoint_of_a_file_runs_no_file_by_itself(folder):
    net = find("coopoc.nets", NET)()
    path = save(folder / "own.safetensors", Checkpoint(net, {}))
    with refused("names a file, whose code does not run"):
        load(path)
    assert torch.equal(flatten([load(path, NET).model]), flatten([net]))
    with refused("must be a GainNet"):
        to_onnx(net, folder / "own.onnx")


def test_what_is_neither_recipe_nor_net_is_refused(folder):
    assert recipe_of(NET).net == NET
    with refused("no Recipe and no net"):
        recipe_of("constant_gain.py:nn")
    with refused("Did you mean fedokf"):
        recipe_of("fedokfs")
