"""Entry points: names, mappings, clashes, and distributions that are broken."""

from importlib import metadata

import pytest
from conftest import refused
from shell import python

from coopoc import plugins
from coopoc.studies import lineup
from coopoc.study.study import find_study


def install(folder, name, points):
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(points)


@pytest.fixture
def site(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def test_an_entry_point_is_one_object_or_a_mapping_of_several(site):
    install(site, "one", "[some.group]\nwave = math:pi\ntable = string_table:TABLE\n")
    (site / "string_table.py").write_text("TABLE = {'a': 1, 'b': 2}\n")
    assert plugins.names("some.group") == ("a", "b", "wave")
    assert plugins.find("some.group", "wave") == pytest.approx(3.14159265)
    assert plugins.find("some.group", "b") == 2
    with refused(r"some\.group = 'wav': must be one of a, b, wave\. Did you mean wave\?"):
        plugins.find("some.group", "wav")


@pytest.mark.parametrize("group", [group for group in plugins.GROUPS if group != "coopoc.commands"])
def test_every_open_set_takes_a_file_of_ones_own_and_names_what_is_wrong_with_it(tmp_path, group):
    (tmp_path / "mine.py").write_text("def huber(x):\n    return x\n")
    own, noun = f"{tmp_path / 'mine.py'}:huber", plugins.GROUPS[group]
    assert plugins.find(group, own)(3) == 3
    with refused(rf"{noun} = .*hubr': is not in the file, which has huber\. Did you mean"):
        plugins.find(group, own.replace("huber", "hubr"))
    with refused(rf"{noun} = .*names a file that is not there"):
        plugins.find(group, own.replace("mine.py", "none.py"))
    with refused(rf"{noun} = 'no such thing': must be one of .*List all with: coopoc list"):
        plugins.find(group, "no such thing")


def test_distributions_are_read_once(site, monkeypatch):
    reads, read = [], metadata.entry_points
    monkeypatch.setattr(metadata, "entry_points", lambda **chosen: reads.append(chosen) or read(**chosen))
    install(site, "one", "[some.group]\nwave = math:pi\n")
    for _ in range(3):
        assert plugins.names("some.group") == ("wave",)
    assert len(reads) == 1


def test_what_cannot_be_loaded_hides_nothing_else(site):
    install(site, "broken", "[some.group]\nbroken = no_such_module:THING\nfine = math:pi\n")
    assert plugins.names("some.group") == ("broken", "fine")
    with refused("'broken': cannot be loaded from no_such_module:THING: No module named 'no_such_module'"):
        plugins.find("some.group", "broken")
    with refused("must be one of broken, fine"):
        plugins.find("some.group", "other")


@pytest.mark.parametrize("other", ["coopoc.nets = math:tau", "table = coopoc.plugins:GROUPS"])
def test_two_distributions_may_not_claim_one_name(site, other):
    install(site, "first", "[some.group]\ncoopoc.nets = math:pi\n")
    install(site, "second", f"[some.group]\n{other}\n")
    with refused(r"'coopoc.nets': is claimed by \S+ and \S+\. Uninstall one"):
        plugins.find("some.group", "coopoc.nets")


def test_entry_points_are_pythons_own_after_the_backport_was_imported():
    """importlib_metadata, which Dask imports, replaces the finder of the whole process."""
    code = (
        "import importlib_metadata\nfrom importlib.metadata import EntryPoint\nfrom coopoc.plugins import points\n"
        "assert all(type(p) is EntryPoint for p in points('coopoc.commands').values())\n"
        "from coopoc.cli import main\nmain(['solve', '--help'])"
    )
    pytest.importorskip("importlib_metadata")
    assert "coopoc solve" in python("-c", code)


def test_the_code_of_a_plugin_names_cells(site):
    install(site, "one", "[coopoc.methods]\nmine = own_method:Own\n")
    study, names = find_study("side_by_side").override({"method": "mine"}), []
    for gain in (1, 2):
        (site / "own_method.py").write_text(f"class Own:\n    gain = {gain}\n")
        lineup._code.cache_clear()
        names.append(study.cells()[0].name)
    assert len({*names}) == 2
