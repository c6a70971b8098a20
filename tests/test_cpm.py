"""CPMs against the public modules of ETSI, pycrate and bits counted by hand; what a receiver of them loses."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import coopoc as co
from coopoc.errors import MissingLibraryError
from coopoc.world import cpm
from coopoc.world.cpm_recording import cpm_received
from coopoc.world.encoded_channels import CERTIFICATE, DIGEST, HEADERS, cpm_encoded
from coopoc.world.frames import turned
from coopoc.world.spherical import to_vector

pytest.importorskip("asn1tools")
ORIGIN = (50.1, 8.6, 112.0)
PLACE, ABSENT = np.array([470001799, 80001315, 40050]), 131072
"""1e-7 degrees and cm; a z that is not sent."""
OBJECTS = {
    7: ((300, -400, 12), (98, 98, 40)),
    65535: ((-131072, 131071, ABSENT), (4095, 1, 4096)),
    0: ((1, 0, -1), (4096, 4096, 4096)),
}
"""Identifier -> cm and cm."""
PUBLIC = {
    (0, False): "020e0000000102a1e7af17d28d448c3b80745918b80b8000111894000181a5fe00",
    (
        3,
        False,
    ): "020e0000000102a1e7af17d28d448c3b80745918b80b8000111894080181a5fe21880c068000001e0030096030bfce00c3000601"
    "3a000ffff80000001ffdffff80020000000800c0003fff00007ffbffffffe0",
    (
        2,
        True,
    ): "020e0000000102a1e7af17d28d448c3b80745918b80b8000111894100181a5fe104802010a012c000e0f822400804d3e8001e003"
    "0096030bfce00c30006013ffffbf7ffefdfffbf1c23fbfffffffffddc0017234faffff80000001ffdffff8007fffbf7ffefdfffbf1c23fbfff"
    "ffffffddc0017200",
}
"""(Objects, whether they are described and the sensors sent) -> what pycrate makes of the full modules of TS 103 324
V2.1.1 and TS 102 894-2 V2.1.1, from field names and numbers that were typed for it."""


def sent(count: int) -> cpm.Elements:
    """The first of OBJECTS, seen by a vehicle that heads 84.3 degrees."""
    found = list(OBJECTS.items())[:count]
    vectors, confidence = (np.array([one[k] for _, one in found]).reshape(-1, 3) for k in (0, 1))
    return cpm.Elements(PLACE, np.array(843), np.array([name for name, _ in found], dtype=int), vectors, confidence)


@pytest.mark.parametrize(("count", "full"), PUBLIC)
def test_bytes_are_those_of_the_public_modules(count: int, full: bool) -> None:
    """ETSI's public modules, encoded by pycrate, which shares no code with the codec here: bytes and content."""
    elements = sent(count)
    message = cpm.encode(elements, (1.5,) * 3, instant=723600000.5, described=full, sensors=full)
    assert message.hex() == PUBLIC[count, full]
    for given, found in zip(elements, cpm.decode(bytes.fromhex(PUBLIC[count, full])), strict=True):
        np.testing.assert_array_equal(given, found)


def seen(count: int, seed: int) -> cpm.Elements:
    """Objects anywhere, with and without z, confidences and a heading."""
    rng = np.random.default_rng(seed)
    vectors, std = rng.uniform(-1300, 1300, (count, 3)), rng.uniform(0, 60, (count, 3))
    vectors[rng.random(count) < 0.3, 2], std[rng.random((count, 3)) < 0.1] = np.nan, np.nan
    course = np.array(np.nan if seed % 5 == 0 else rng.uniform(-np.pi, np.pi))
    return cpm.to_elements(rng.uniform(-99, 99, 3), course, rng.integers(0, 65536, count), vectors, std, ORIGIN)


def bits_of(message: bytes) -> str:
    return f"{int.from_bytes(message):0{8 * len(message)}b}"


def test_pycrate_writes_the_same_objects(tmp_path: Path) -> None:
    """The container of objects of random messages by pycrate, from the fields of `cpm.asn`."""
    asnproc: Any = pytest.importorskip("pycrate_asn1c.asnproc")
    asnproc.compile_text(Path(cpm.__file__).with_name("cpm.asn").read_text())
    asnproc.generate_modules(asnproc.PycrateGenerator, str(tmp_path / "by_pycrate.py"))
    source: Any = importlib.util.spec_from_file_location("by_pycrate", tmp_path / "by_pycrate.py")
    module: Any = importlib.util.module_from_spec(source)
    source.loader.exec_module(module)
    container = module.Cpm.PerceivedObjectContainer
    for seed in range(40):
        elements = seen(seed, seed)
        container.set_val(cpm.perceived(elements, described=bool(seed % 2)))
        wanted, message = bits_of(container.to_uper()), cpm.encode(elements, (1.5,) * 3, described=bool(seed % 2))
        assert wanted in bits_of(message) if seed else len(message) == 33


@pytest.mark.parametrize(("described", "bits"), [(False, 134), (True, 294)])
def test_sizes_are_the_bits_of_the_fields(described: bool, bits: int) -> None:
    """By hand, X.691: an object is 15 bits of extension and presence, 16 of identifier, 12 of time, 1 + 3 x 30 of
    position; described, 68 of velocity, 21 of angle, 39 of dimensions, 11 of age, 4 of quality and 17 of class more.
    Around them are 18 bits of the container in whole octets, 4 of its identifier, 8 or 16 of its length, and 257."""
    for count in (1, 2, 6, 7, 8, 30, 255):
        octets = -(-(18 + count * bits) // 8)
        whole = 257 + 4 + (8 if octets < 128 else 16) + 8 * octets
        several, std = np.arange(count), np.full((count, 3), 0.5)
        elements = cpm.to_elements(np.zeros(3), np.array(0.1), several, np.ones((count, 3)), std, ORIGIN)
        assert len(cpm.encode(elements, (1.5,) * 3, described=described)) == -(-whole // 8)


def test_what_is_decoded_is_what_was_encoded() -> None:
    for seed in range(60):
        elements = seen(seed, seed)
        for given, found in zip(elements, cpm.decode(cpm.encode(elements, (1.5,) * 3, 1.0, True, True)), strict=True):
            np.testing.assert_array_equal(given, found)


def test_fields_that_are_never_sent_here_are_read_over() -> None:
    """ETSI's public modules by pycrate: a segment and rates, pitch and roll, a road-side unit's container, polar and
    Cartesian velocities and accelerations, three angles, a yaw rate, one dimension, a list of sensors, two classes."""
    message = (
        "020e0000000132a1e7af17d28d448c3b80745918b80b800011189422028984010c697f8050400a0802020089e09013a060007800c02580"
        "c2ff38030c001804e89a40805043b2d04860501410940af84020204581591625e2c7fffc0000000ffeffffc002765a09d9682d28152815"
        "281701410028200504160431b800"
    )
    for given, found in zip(sent(2), cpm.decode(bytes.fromhex(message)), strict=True):
        np.testing.assert_array_equal(given, found)


def test_a_receiver_has_all_but_half_a_unit() -> None:
    rng = np.random.default_rng(3)
    position, course, several = rng.uniform(-900, 900, (300, 3)), rng.uniform(-np.pi, np.pi, 300), np.zeros((300, 4))
    vectors, std = rng.uniform(-1300, 1300, (300, 4, 3)), rng.uniform(0.01, 20.0, (300, 4, 3))
    elements = cpm.to_elements(position, course, several.astype(int), vectors, std, ORIGIN)
    place, heading, found, stated = cpm.from_elements(elements, ORIGIN)
    turn = np.abs(np.angle(np.exp(1j * (heading - course))))
    for gap, unit in ((np.abs(place - position), 0.0112), (turn, np.deg2rad(0.1)), (np.abs(found - vectors), 0.01)):
        assert 0.3 * unit < gap.max() <= 0.5001 * unit
    more = 196 * (stated - std)  # whole cm that hold 95 %, none less than it should be
    assert more.min() > -1e-9
    assert 0.99 < more.max() < 1 + 1e-9


def test_what_is_out_of_range_is_unavailable() -> None:
    vectors, std = np.array([[1310.0, 0.0, 0.0], [1311.0, 0.0, 0.0], [0.0, -2000.0, 0.0]]), np.ones((3, 3))
    std[0, 1] = 20.9  # times 1.96 is more than the 40.94 m that can be stated
    elements = cpm.to_elements(np.zeros(3), np.array(0.0), np.arange(3), vectors, std, ORIGIN)
    _, _, found, stated = cpm.from_elements(cpm.decode(cpm.encode(elements, (1.5,) * 3)), ORIGIN)
    assert np.isnan(found).any(axis=1).tolist() == [False, True, True]
    assert np.isnan(stated).any(axis=1).tolist() == [True, False, False]


@pytest.mark.parametrize("frame", ["world", "body"])
def test_only_what_others_measured_of_each_other_is_changed(crossing: co.Fleet, frame: Any) -> None:
    """By hand: 5 mm on each axis; in body frames the sender turns with its compass, the receiver with 0.1 degrees."""
    given = co.observe(crossing, co.Sensors(heading_std=0.1), co.V2X(4, 60.0), runs=2, frame=frame)
    got, cam = cpm_received(given, 2, ORIGIN), co.cam_received(given, 2, ORIGIN)
    np.testing.assert_array_equal(got.gnss, cam.gnss)
    np.testing.assert_array_equal(got.velocity, cam.velocity)
    own = given.links.observer == 2
    np.testing.assert_array_equal(got.relative[:, own], given.relative[:, own])
    here, there = (to_vector(one.relative[:, ~own]) for one in (got, given))
    if frame == "body":
        step, observer = given.links.step[~own], given.links.observer[~own]
        assert given.body is not None
        course = given.body.heading[:, step, observer]
        read = np.deg2rad(np.rint(np.rad2deg(course) * 10) / 10)
        here, there = turned(here, read), turned(there, course)
    gap = np.abs(here - there)
    assert 0.0045 < gap.max() < 0.005 + 1e-9


def test_what_a_cpm_cannot_hold_is_missing(crossing: co.Fleet) -> None:
    given = co.observe(crossing, co.Sensors(), co.V2X(4, 60.0), frame="body")
    own, relative = given.links.observer == 0, given.relative.copy()
    relative[:, ::3, 2], relative[:, 1::3, 1], relative[:, 2::9, 0] = np.nan, np.nan, np.nan
    got = cpm_received(replace(given, relative=relative), 0).relative
    whole = np.isfinite(relative[..., :2]).all(axis=-1)
    assert np.isnan(got[:, ~own][~whole[:, ~own]]).all()
    kept = whole & ~own
    np.testing.assert_array_equal(np.isnan(got[kept]), np.isnan(relative[kept]))
    np.testing.assert_allclose(got[kept][:, 0], relative[kept][:, 0], atol=0.01)
    blind = co.observe(crossing, co.Sensors(compass=False), co.V2X(4, 60.0), frame="body")
    assert np.isnan(cpm_received(blind, 0).relative[:, ~own]).all()
    assert np.isfinite(cpm_received(blind, 0).relative[:, own]).all()


def test_cpms_cost_a_filter_of_the_whole_fleet_millimetres(crossing: co.Fleet) -> None:
    given = co.observe(crossing, co.Sensors(), co.V2X(4, 60.0), runs=4)
    quantised, exact = (co.rt_le(co.CentralFilter()(r, [0]), crossing).mean() for r in (cpm_received(given, 0), given))
    assert 0 < abs(quantised - exact) < 0.02


def test_the_channel_has_the_bytes_of_a_message() -> None:
    """By hand: 1093 bits with the positions of six objects, 84 more with a sensor; at 5 Hz each fifth message has the
    sensor and a certificate; 20 B of a fix, an id and a time are in it."""
    six, sensor = 137, 148 - 137
    wanted = HEADERS + DIGEST + six + (CERTIFICATE - DIGEST + sensor) / 5 - 20
    assert cpm_encoded(6) == replace(co.V2X.cpm(6), overhead=round(wanted))
    assert cpm_encoded(0).overhead == cpm_encoded(6, objects=0).overhead < cpm_encoded(6).overhead


def test_a_missing_codec_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    cpm._codec.cache_clear()
    monkeypatch.setitem(sys.modules, "asn1tools", None)
    with pytest.raises(MissingLibraryError, match=r"coopoc\[etsi\]"):
        cpm.encode(sent(1), (1.5,) * 3)


MAP = "020e0000000102a1e7af17d28d448c3b80745918b80b8000111894020a804028004001e0030096030bfce00c30006013900c00"
"""An object with a position on a map, by pycrate from the public modules."""


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: cpm.decode(b"\x02\x0e\x00"), "is no CPM"),
        (lambda: cpm.decode(b"\x02\x02" + bytes.fromhex(PUBLIC[0, False])[2:]), "messageId 2"),
        (lambda: cpm.decode(bytes.fromhex(MAP)), "fields that are not read here"),
        (lambda: cpm.encode(sent(3)._replace(identifiers=np.arange(3) + 65535), (1.5,) * 3), "cannot be encoded"),
        (lambda: cpm.encode(sent(1)._replace(vectors=np.array([[ABSENT, 0, 0]])), (1.5,) * 3), "cannot be encoded"),
        (lambda: cpm_encoded(6, objects=256), r"must be in 0\.\.255"),
    ],
)
def test_mistakes_are_named(make: Any, words: str) -> None:
    with pytest.raises(co.InputError, match=words):
        make()
