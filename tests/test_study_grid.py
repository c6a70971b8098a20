"""Study: what names a cell, and how --set changes a study."""

import hashlib

import pytest

from coopoc.errors import InputError
from coopoc.study.cell import assignments, parse
from coopoc.study.study import Study, digest


def study(**changes: object) -> Study:
    options = {"grid": {"k": (0, 1), "method": ("a", "b")}, "settings": {"runs": 3, "egos": (0, 1), "ratio": 0.1}}
    return Study(**{"name": "s", "question": "?", "cell": dict, **options, **changes})  # type: ignore[arg-type]


def names(**changes: object) -> list[str]:
    return [cell.name for cell in study(**changes).cells()]


def test_the_grid_is_the_product_in_order() -> None:
    assert [tuple(c.params.values()) for c in study().cells()] == [(0, "a"), (0, "b"), (1, "a"), (1, "b")]
    assert study().cells()[0].given == {"runs": 3, "egos": (0, 1), "ratio": 0.1, "k": 0, "method": "a"}
    assert len(study(where=lambda p: p["k"] > 0 or p["method"] == "a").cells()) == 3


def test_a_list_of_cells_is_taken_as_it_stands() -> None:
    listed = study(grid=[{"k": 1, "method": "a"}, {"k": 0, "method": "b"}])
    assert listed.axes == ("k", "method")
    assert [c.params["k"] for c in listed.cells()] == [1, 0]
    assert [c.params["method"] for c in listed.override({"k": "0"}).cells()] == ["b"]
    with pytest.raises(InputError, match=r"k = 7: must be among \[1, 0\]"):
        listed.override({"k": 7})


def test_all_that_changes_the_numbers_changes_the_name_and_nothing_else_does() -> None:
    base = names()
    assert len(set(base)) == 4
    assert names() == base
    assert names(question="Another wording?", limitations=("x",), minutes=3.0) == base
    assert names(settings={"ratio": 0.1, "egos": [0, 1], "runs": 3}) == base
    for changed in ({"settings": {"runs": 4, "egos": (0, 1), "ratio": 0.1}}, {"key": lambda p: {"fleet": "f00d"}}):
        assert not set(names(**changed)) & set(base)


def test_names_are_stable_between_processes() -> None:
    text = b'{"data":"town10","ratio":0.1,"runs":3}'
    assert digest({"runs": 3, "data": "town10", "ratio": 0.1}) == hashlib.sha256(text).hexdigest()[:20]


def test_settings_are_read_as_the_type_of_their_default() -> None:
    changed = study().override({"runs": "100", "egos": "4,5,6", "ratio": "0.15", "k": "2"})
    assert changed.settings == {"runs": 100, "egos": (4, 5, 6), "ratio": 0.15}
    assert [c.params["k"] for c in changed.cells()] == [2, 2]
    assert study().override({"ratio": 1}).settings["ratio"] == 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rums": "1"}, r"setting = 'rums': must be one of .*Did you mean runs\?"),
        ({"runs": "many"}, "runs = 'many': must be a whole number"),
        ({"runs": "2.5"}, "runs = '2.5': must be a whole number"),
        ({"ratio": "high"}, "ratio = 'high': must be a number"),
        ({"egos": "0,x"}, "egos = 'x': must be a whole number"),
    ],
)
def test_a_setting_that_cannot_be_is_named(changes: dict[str, str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        study().override(changes)


def test_grids_that_cannot_be() -> None:
    with pytest.raises(InputError, match="must not name an axis"):
        study(settings={"k": 1})
    with pytest.raises(InputError, match="must have at least one"):
        study(where=lambda p: False).cells()
    with pytest.raises(InputError, match=r"grid = \{'k': 4, 'method': 'a'\}: must not be there twice"):
        study().override({"k": "4,4"}).cells()
    with pytest.raises(InputError, match="must be a number, a word"):
        study(grid={"k": ({"x": 1},)}).cells()
    with pytest.raises(InputError, match="lists of them"):
        study(settings={"fleet": object()}).cells()


def test_assignments() -> None:
    assert assignments(["a=1", "b=x=y"]) == {"a": "1", "b": "x=y"}
    with pytest.raises(InputError, match="must be key=value"):
        assignments(["runs"])
    with pytest.raises(InputError, match="gives a twice"):
        assignments(["a=1", "a=2"])
    assert parse("flag", "yes", False) is True
    assert [parse("x", text, None) for text in ("none", "3", "0.5", "word")] == [None, 3, 0.5, "word"]
