"""A seeded sampler of wrong, odd and rearranged recordings, and the answer of every method; a program of its own."""

import sys
import warnings
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy import inf, nan

from coopoc import V2X, Fleet, InputError, Links, Sensors, observe
from coopoc.methods.catalogue import METHODS

ARRAYS = ("t", "gnss", "velocity", "relative", "broadcasts", "arrival")
COLUMNS = ("step", "observer", "neighbour")


def drive(steps=12, vehicles=5):
    """Vehicles that drive side by side and apart; one joins late, one leaves early."""
    t = 0.1 * np.arange(steps)
    velocity = np.tile([8.0, 1.0, 0.0], (steps, vehicles, 1))
    velocity[:, 1::2, 1] *= -1
    place = np.c_[7.0 * np.arange(vehicles), 4.0 * (np.arange(vehicles) % 3), np.zeros(vehicles)]
    position = place + t[:, None, None] * velocity
    for array in (position, velocity):
        array[:3, 3], array[9:, 4] = nan, nan
    return Fleet(tuple("abcdefgh"[:vehicles]), t, position, velocity)


def recording(runs=4, whole=True):
    """A valid one; `whole`: every vehicle is there all the time, its channel late and lossy."""
    fleet = drive()
    if whole:
        fleet = fleet.select([0, 1, 2])
    return observe(fleet, Sensors.paper_scenario2(), V2X(max_neighbours=3, loss=0.2, latency=0.1), runs=runs, seed=5)


def with_parts(valid, **parts: Any):
    """The recording with other arrays; `step`, `observer` and `neighbour` are those of its links."""
    links = {name: parts.pop(name) for name in COLUMNS if name in parts}
    return replace(valid, **(parts | ({"links": replace(valid.links, **links)} if links else {})))


def arrays(valid):
    """All arrays by name."""
    return {n: getattr(valid, n) for n in ARRAYS} | {n: getattr(valid.links, n) for n in COLUMNS}


def wrong(valid):
    """Arrays that no recording may have."""
    for name, good in arrays(valid).items():
        for axis in range(good.ndim):
            for cut in (slice(0, 0), slice(0, -1), slice(0, 1)):
                yield f"{name} axis {axis} {cut}", {name: good[(slice(None),) * axis + (cut,)]}
            yield f"{name} axis {axis} doubled", {name: np.concatenate([good, good], axis=axis)}
        yield f"{name} one axis more", {name: good[None]}
        yield f"{name} one axis less", {name: good.ravel() if good.ndim > 1 else good[0]}
        for odd in (object, complex, "U8", "datetime64[s]" if good.dtype.kind == "i" else "S8"):
            yield f"{name} as {odd}", {name: good.astype(odd)}
        yield f"{name} as ragged lists", {name: [[1, 2], [3]]}
        yield f"{name} is None", {name: None}
    for name in ("arrival", *COLUMNS):
        yield f"{name} as floats", {name: arrays(valid)[name].astype(float)}
    yield "broadcasts as numbers", {"broadcasts": valid.broadcasts.astype(int)}
    for name in COLUMNS:
        good = arrays(valid)[name]
        for shift in (-1000, -1, 1000, 2**40, 2**62):
            yield f"{name} {shift:+}", {name: good + shift}
            for at in (0, len(good) // 2, -1):
                changed = good.copy()
                changed[at] += shift if shift != -1 else -1 - changed[at]
                yield f"{name}[{at}] {shift:+}", {name: changed}
    yield "links backwards", {name: getattr(valid.links, name)[::-1] for name in COLUMNS}
    yield "neighbour is observer", {"neighbour": valid.links.observer}
    yield "arrival before sending", {"arrival": np.where(valid.arrival >= 0, valid.links.step - 1, -1)}
    yield "arrival far below", {"arrival": valid.arrival - 1000}
    for name, value in (("gnss", inf), ("velocity", -inf), ("relative", inf), ("t", nan), ("t", inf)):
        bad = arrays(valid)[name].copy()
        bad.ravel()[3] = value
        yield f"{name} holds {value}", {name: bad}
    for name in ("gnss", "velocity"):
        bad = arrays(valid)[name].copy()
        bad[0, 1, 0, 1] = nan
        yield f"{name} without y", {name: bad}
    absent = valid.velocity.copy()
    absent[:, valid.links.step[0], valid.links.neighbour[0]] = nan
    yield "a link to an absent vehicle", {"velocity": absent}
    once = valid.velocity.copy()
    once[1, 4, 0] = nan
    yield "absent in one run", {"velocity": once}
    yield "negative range", {"relative": valid.relative * [-1, 1, 1]}
    yield "t backwards", {"t": valid.t[::-1]}
    yield "t uneven", {"t": valid.t**2}
    yield "observers beyond", {"observers": (0, 1, 99)}
    yield "observers below", {"observers": (-1, 0, 1, 2)}
    yield "observers fewer than observe", {"observers": (0,)}
    yield "ids fewer", {"ids": valid.ids[:-1]}
    yield "ids twice", {"ids": (valid.ids[0],) * len(valid.ids)}
    yield "more neighbours than K", {"v2x": replace(valid.v2x, max_neighbours=1)}


def rearranged(valid):
    """The same numbers in other memory."""
    same = arrays(valid)

    def all_of(change):
        return {name: change(array) for name, array in same.items()}

    def strided(array):
        room = np.zeros(tuple(2 * n for n in array.shape), array.dtype)
        view = room[tuple(slice(None, None, 2) for _ in array.shape)]
        view[...] = array
        view.flags.writeable = False
        return view

    def unaligned(array):
        view = np.zeros(array.nbytes + 1, np.uint8)[1:].view(array.dtype).reshape(array.shape)
        view[...] = array
        view.flags.writeable = False
        return view

    yield "Fortran order", all_of(np.asfortranarray)
    yield "strided views", all_of(strided)
    yield "negative strides", all_of(lambda a: a[::-1].copy()[::-1])
    yield "unaligned", all_of(unaligned)
    yield "swapped bytes", all_of(lambda a: a.astype(a.dtype.newbyteorder()))
    yield "writeable", all_of(np.array)
    yield "lists", all_of(lambda a: a.tolist())
    yield "small integers", {name: same[name].astype(np.int16) for name in ("arrival", *COLUMNS)}
    yield "unsigned links", {name: same[name].astype(np.uint64) for name in COLUMNS}


def allowed(valid, rng):
    """Odd recordings that hold nothing wrong: every method answers or says why it cannot."""
    links, runs = len(valid.links), valid.runs
    far, lost = valid.links.step + rng.integers(0, 40, (runs, links)), np.full((runs, links), -1)
    yield "arrival at any later step", {"arrival": far}
    yield "arrival far beyond the end", {"arrival": far + 2**40}
    yield "everything lost", {"arrival": lost}
    yield "nothing sent", {"broadcasts": np.zeros_like(valid.broadcasts), "arrival": lost}
    for size in (0, 1, links // 2):
        chosen = np.sort(rng.permutation(links)[:size])
        parts: dict[str, Any] = {name: getattr(valid.links, name)[chosen] for name in COLUMNS}
        yield f"{size} links", {**parts, "relative": valid.relative[:, chosen], "arrival": valid.arrival[:, chosen]}
    for name, mask in (("gnss", (runs, *valid.gnss.shape[1:3], 1)), ("relative", (runs, links, 1))):
        yield f"{name} at times", {name: np.where(rng.random(mask) < 0.3, nan, arrays(valid)[name])}
    yield "never a fix", {"gnss": np.full_like(valid.gnss, nan)}
    yield "no azimuth", {"relative": np.where([False, True, False], nan, valid.relative)}
    yield "zero ranges", {"relative": valid.relative * [0, 1, 1]}
    yield "far away", {"gnss": valid.gnss + 1e7}


def answers(valid, only=()):
    """(method, what it answers): positions, or the exception."""
    for name, make in METHODS.items():
        if not only or name in only:
            try:
                yield name, make("nominal")(valid, [0, 1]).x
            except Exception as error:
                yield name, error


def complaints(only=(), odd=True):
    """What is not as it should be, line by line."""
    for whole in (True, False):
        valid = recording(whole=whole)
        for what, parts in wrong(valid):
            try:
                with_parts(valid, **parts)
            except InputError:
                continue
            except Exception as error:
                yield f"{what}: {type(error).__name__} in place of InputError: {error}"
            else:
                yield f"{what}: accepted"
        wanted = dict(answers(valid, only))
        for name, answer in wanted.items():
            if isinstance(answer, Exception) and not isinstance(answer, InputError):
                yield f"{name} on a valid recording: {answer!r}"
        for what, parts in rearranged(valid):
            for name, answer in answers(with_parts(valid, **parts), only):
                good = wanted[name]
                same = type(answer) is type(good) if isinstance(good, Exception) else np.array_equal(good, answer)
                if not same:
                    yield f"{what}, {name}: {answer!r:.200}"
        for what, parts in allowed(valid, np.random.default_rng(7)) if odd else ():
            for name, answer in answers(with_parts(valid, **parts), only):
                if isinstance(answer, Exception) and not isinstance(answer, InputError):
                    yield f"{what}, {name}: {answer!r:.200}"


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    assert {f.name for f in fields(Links)} == set(COLUMNS)
    odd, *methods = sys.argv[1:]
    count = 0
    for line in complaints(tuple(methods), odd == "odd"):
        print(line, flush=True)
        count += 1
    sys.exit(count > 0)
