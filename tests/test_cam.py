"""CAMs against asn1tools, which shares no code with pycrate, and pymap3d; what a receiver of them loses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import coopoc as co
from coopoc.world import cam
from coopoc.world.cam_recording import cam_received
from coopoc.world.data_dictionary import confidence

pytest.importorskip("pycrate_asn1dir")
ORIGIN = (50.1, 8.6, 112.0)
CAR = """
Cam DEFINITIONS AUTOMATIC TAGS ::= BEGIN
CAM ::= SEQUENCE { header Header, cam Awareness }
Header ::= SEQUENCE { version INTEGER (0..255), kind INTEGER (0..255), station INTEGER (0..4294967295) }
Awareness ::= SEQUENCE { time INTEGER (0..65535), parameters Parameters }
Parameters ::= SEQUENCE { basic Basic, fast Fast, slow Slow OPTIONAL, special NULL OPTIONAL, ... }
Basic ::= SEQUENCE { station INTEGER (0..255), place Place, ... }
Place ::= SEQUENCE { latitude INTEGER (-900000000..900000001), longitude INTEGER (-1800000000..1800000001),
  ellipse SEQUENCE { major INTEGER (0..4095), minor INTEGER (0..4095), orientation INTEGER (0..3601) },
  altitude SEQUENCE { value INTEGER (-100000..800001), confidence INTEGER (0..15) } }
Fast ::= CHOICE { car Car, unit NULL, ... }
Slow ::= CHOICE { car SEQUENCE { role INTEGER (0..15), lights BIT STRING (SIZE (8)), history History }, ... }
History ::= SEQUENCE (SIZE (0..40)) OF SEQUENCE {
  place SEQUENCE { latitude INTEGER (-131071..131072), longitude INTEGER (-131071..131072),
    altitude INTEGER (-12700..12800) }, time INTEGER (1..65535, ...) OPTIONAL }
Car ::= SEQUENCE {
  heading SEQUENCE { value INTEGER (0..3601), confidence INTEGER (1..127) },
  speed SEQUENCE { value INTEGER (0..16383), confidence INTEGER (1..127) },
  direction INTEGER (0..2),
  length SEQUENCE { value INTEGER (1..1023), trailer INTEGER (0..4) },
  width INTEGER (1..62),
  acceleration SEQUENCE { value INTEGER (-160..161), confidence INTEGER (0..102) },
  curvature SEQUENCE { value INTEGER (-1023..1023), confidence INTEGER (0..7) },
  mode ENUMERATED { used, unused, unavailable, ... },
  rate SEQUENCE { value INTEGER (-32766..32767), confidence INTEGER (0..8) },
  control NULL OPTIONAL, lane NULL OPTIONAL, wheel NULL OPTIONAL, lateral NULL OPTIONAL, vertical NULL OPTIONAL,
  class NULL OPTIONAL, toll NULL OPTIONAL }
END
"""
"""Fields, ranges and extension marks of a car's CAM (EN 302 637-2 annex A, TS 102 894-2), under names of our own: PER
holds no names, and an enumeration without extension takes the bits of its index."""


def states(count: int = 200) -> cam.Elements:
    rng = np.random.default_rng(1)
    position = rng.uniform(-2000, 2000, (count, 3)) * [1, 1, 0.1]
    course, speed, rate = rng.uniform(-np.pi, np.pi, count), rng.uniform(0, 60, count), rng.normal(0, 0.5, count)
    position[::7], course[::5], speed[::6], rate[::4] = np.nan, np.nan, np.nan, np.nan
    return cam.to_elements(position, course, speed, rate, ORIGIN)


def one(elements: cam.Elements, k: int) -> cam.Elements:
    return cam.Elements(*(values[k] for values in elements))


@pytest.mark.parametrize("path", [0, 10, 23])
def test_asn1tools_writes_the_same_bytes(path: int) -> None:
    """From the fields of the standard, by asn1tools, which shares no code with the codec that encodes CAMs here."""
    spec: Any = pytest.importorskip("asn1tools").compile_string(CAR, "uper")
    elements = states()
    for k in range(0, 200, 9):
        state = one(elements, k)
        latitude, longitude, altitude = state.place.tolist()
        ellipse, height = confidence((1.5, 1.5, 1.5))
        place = {
            "latitude": latitude,
            "longitude": longitude,
            "ellipse": {"major": ellipse, "minor": ellipse, "orientation": 0},
            "altitude": {"value": altitude, "confidence": height},
        }
        car = {
            "heading": {"value": int(state.heading), "confidence": 127},
            "speed": {"value": int(state.speed), "confidence": 127},
            "direction": int(state.direction),
            "length": {"value": 45, "trailer": 0},
            "width": 18,
            "acceleration": {"value": 161, "confidence": 102},
            "curvature": {"value": 1023, "confidence": 7},
            "mode": "used",
            "rate": {"value": int(state.yaw_rate), "confidence": 8},
        }
        point = {"place": {"latitude": 500, "longitude": 500, "altitude": 0}, "time": 50}
        slow = {"role": 0, "lights": (b"\x00", 8), "history": [point] * path}
        parameters: dict[str, Any] = {"basic": {"station": 5, "place": place}, "fast": ("car", car)}
        if path:
            parameters["slow"] = ("car", slow)
        header = {"version": 2, "kind": 2, "station": 1}
        wanted = spec.encode("CAM", {"header": header, "cam": {"time": 700, "parameters": parameters}})
        assert cam.encode(state, (1.5, 1.5, 1.5), instant=0.7, path=path) == wanted


def test_what_is_decoded_is_what_was_encoded() -> None:
    elements = states()
    for k in range(len(elements.heading)):
        for sent, found in zip(one(elements, k), cam.decode(cam.encode(one(elements, k), (1.5,) * 3)), strict=True):
            np.testing.assert_array_equal(sent, found)


def test_places_are_those_of_pymap3d() -> None:
    """WGS84 within 300 m of the origin, to the 0.04 m that a flat frame leaves."""
    pymap3d = pytest.importorskip("pymap3d")
    position = np.random.default_rng(2).uniform(-300, 300, (50, 3)) * [1, 1, 0]
    nothing = np.zeros(50)
    place = cam.to_elements(position, nothing, nothing, nothing, ORIGIN).place
    wanted = np.stack(pymap3d.enu2geodetic(*position.T, *ORIGIN), axis=1)
    assert np.abs(place / [1e7, 1e7, 100] - wanted)[:, :2].max() * 111e3 < 0.04
    assert np.abs(place[:, 2] / 100 - wanted[:, 2]).max() < 0.02


def test_a_unit_of_latitude_or_longitude_is_as_long_as_in_pymap3d() -> None:
    """WGS84, to a millionth: central differences over 220 m, so that the flat frame's error cancels."""
    pymap3d = pytest.importorskip("pymap3d")
    nothing = np.array(0.0)
    start = cam.to_elements(np.zeros(3), nothing, nothing, nothing, ORIGIN)
    for axis, enu in ((0, 1), (1, 0)):
        ends = []
        for side in (-10_000, 10_000):
            place = start.place.copy()
            place[axis] += side
            degrees = np.array([place[0] / 1e7, place[1] / 1e7])
            ours = cam.from_elements(start._replace(place=place), ORIGIN)[0]
            ends.append((ours[enu], pymap3d.geodetic2enu(*degrees, ORIGIN[2], *ORIGIN)[enu]))
        assert ends[1][0] - ends[0][0] == pytest.approx(ends[1][1] - ends[0][1], rel=1e-6)


def test_a_receiver_has_all_but_half_a_unit() -> None:
    rng = np.random.default_rng(3)
    position, course = rng.uniform(-900, 900, (500, 3)), rng.uniform(-np.pi, np.pi, 500)
    speed, rate = rng.uniform(-60, 60, 500), rng.normal(0, 0.5, 500)
    back = cam.from_elements(cam.to_elements(position, course, speed, rate, ORIGIN), ORIGIN)
    for found, given, unit in zip(
        back, (position, course, speed, rate), (0.0112, np.deg2rad(0.1), 0.01, np.deg2rad(0.01)), strict=True
    ):
        gap = np.abs(found - given)
        if given is course:
            gap = np.minimum(gap, 2 * np.pi - gap)
        assert gap.max() <= 0.5001 * unit
        assert gap.max() > 0.3 * unit


def test_only_what_others_send_is_changed(crossing: co.Fleet) -> None:
    for frame in ("world", "body"):
        seen = co.observe(crossing, co.Sensors(), co.V2X(4, 60.0), runs=2, frame=frame)  # type: ignore[arg-type]
        got = cam_received(seen, 2, ORIGIN)
        np.testing.assert_array_equal(got.gnss[:, :, 2], seen.gnss[:, :, 2])
        np.testing.assert_array_equal(got.velocity[:, :, 2], seen.velocity[:, :, 2])
        gap = np.abs(got.gnss - seen.gnss)
        assert 0.003 < gap.max() < 0.0057
        level = np.abs(got.velocity - seen.velocity)[..., 0].max()
        assert 0.002 < level < 0.06  # 0.05 degrees at 14 m/s, half a cm/s
        assert got.sensors.gnss_std == pytest.approx((1.503, 1.503, 2.551), abs=1e-3)


def test_a_cam_costs_a_filter_millimetres(crossing: co.Fleet) -> None:
    seen = co.observe(crossing, co.Sensors(), co.V2X(4, 60.0), runs=10, observers=[0])
    sent, exact = (co.rt_le(co.JointFilter()(r, [0]), crossing).mean() for r in (cam_received(seen, 0), seen))
    assert abs(sent - exact) < 0.02


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: cam.decode(b"\x02\x02\x00"), "is no CAM"),
        (lambda: cam.encode(one(states(), 0)._replace(speed=np.array(-5)), (1.5,) * 3), "cannot be encoded"),
        (lambda: cam.encode(one(states(), 0), (1.5,) * 3, path=99), "cannot be encoded"),
    ],
)
def test_mistakes_are_named(make: Any, words: str) -> None:
    with pytest.raises(co.InputError, match=words):
        make()
