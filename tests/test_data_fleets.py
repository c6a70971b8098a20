"""The bundled fleets: exact storage, cards that tell the truth, the properties that the studies build on."""

from itertools import combinations

import numpy as np
import pytest
from conftest import refused
from make_fleet import write_table
from numpy.linalg import norm
from scipy.spatial import cKDTree
from test_data_generate import script

from coopoc.data.registry import DATASETS, FLEETS, card, detect, load_fleet

NAMES = ("town10", "town10-clients", "town10-validation", "town04")


def test_the_four_fleets_are_bundled_in_less_than_4_mb():
    assert set(DATASETS) == set(NAMES)
    assert sum(file.stat().st_size for file in FLEETS.iterdir()) < 4e6
    assert [*DATASETS] == sorted(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_digest_source_and_licence_are_those_of_the_card(name):
    fleet, stated = load_fleet(name), card(name)
    assert fleet.digest == stated["sha256"]
    assert (fleet.name, fleet.licence) == (name, stated["map_licence"])
    assert stated["map"] in fleet.source
    assert str(stated["recipe"]["seed"]) in fleet.source
    facts = script.facts(fleet)
    assert facts == {key: stated[key] for key in facts}


@pytest.mark.parametrize("name", ["town10", "town10-validation", "town04"])
def test_card_counts_the_neighbours_that_a_kd_tree_finds(name):
    """Independent check: SciPy's cKDTree."""
    fleet = load_fleet(name)
    counts = np.array([[len(n) - 1 for n in cKDTree(x).query_ball_point(x, 30.0)] for x in fleet.position[::25]])
    assert np.mean(np.minimum(counts, 10)) == pytest.approx(card(name)["neighbours"]["mean"], rel=0.05)


def test_town10_is_dense_and_urban():
    fleet, stated = load_fleet("town10"), card("town10")
    assert fleet.position.shape == (900, 60, 3)
    assert fleet.present.all()
    assert 5 <= stated["neighbours"]["mean"] <= 7
    assert stated["speed"]["max"] < 11.1
    assert stated["speed"]["standing"] < 0.3
    assert norm(np.diff(fleet.position, axis=0), axis=2).sum(0).min() > 90, "every vehicle drives, m in 90 s"


def test_clients_have_the_papers_lengths_and_speeds():
    """Published values: section IV.A, 8.9-10.8, 9.2-10.9, 0.7-10.7 and 3.6-10.7 m/s; lengths from its figure."""
    fleet = load_fleet("town10-clients")
    assert fleet.present.sum(0).tolist() == [1550, 4600, 1450, 1420]
    assert (np.diff(fleet.present.astype(int), axis=0) <= 0).all(), "present from the start, absent after the end"
    speed = norm(fleet.velocity, axis=2)
    ranges = np.c_[np.nanmin(speed, 0), np.nanmax(speed, 0)]
    np.testing.assert_allclose(ranges, [[8.9, 10.8], [9.2, 10.9], [0.7, 10.7], [3.6, 10.7]], atol=0.6)
    words = card("town10-clients")["words"]
    assert [words[f"speed of {k}"] for k in (1, 4)] == ["8.6..10.9 m/s", "3..10.6 m/s"]


def test_town04_is_hilly():
    fleet = load_fleet("town04")
    assert np.ptp(fleet.position[..., 2]) > 10
    gap = fleet.position[:, None] - fleet.position[:, :, None]
    distance = norm(gap, axis=-1)
    near = (distance < 30) & (distance > 0)
    elevation = np.degrees(np.arcsin(abs(gap[..., 2][near] / distance[near])))
    assert np.mean(elevation > 1) > 0.15, "share of neighbours that are seen more than one degree above or below"


def test_fleets_are_disjoint():
    for one, other in combinations(map(load_fleet, NAMES), 2):
        assert not set(one.ids) & set(other.ids)
        steps = min(len(one.t), len(other.t), 900)
        for x in np.moveaxis(one.position[:steps], 1, 0):
            same = abs(other.position[:steps] - x[:, None]).max(2) < 0.5
            assert same.mean(0).max() < 0.5, "no vehicle drives where one of another fleet drives"


def test_unknown_names_and_formats_are_refused_with_the_known_ones(tmp_path):
    with refused("town10-validation"):
        load_fleet("town11")
    with refused(r"data = 'town10-client'.* Did you mean town10-clients\?"):
        load_fleet("town10-client")
    with refused(r"must be one of table, tum, fcd, mrclam, pyfg, recording, log\. Or leave it out"):
        load_fleet(tmp_path, format="bag")
    with refused(r"format = 'tabel': .* Did you mean table\?"):
        load_fleet(tmp_path, format="tabel")
    with refused(r"must end in \.csv"):
        detect(tmp_path / "drive.doc")
    with refused(r"options = \['columns'\]: town10 is bundled"):
        load_fleet("town10", columns={})
    write_table(load_fleet("town10-clients"), tmp_path / "a.csv")
    with refused(r"option = 'colums': .* Did you mean columns\?"):
        load_fleet(tmp_path / "a.csv", colums={})
    with refused("vehicle_lenght"):
        load_fleet(tmp_path / "a.csv", vehicle_lenght=4)
    with refused(r"'untl': .* Did you mean until\?"):
        load_fleet(tmp_path / "a.csv", untl=4)
