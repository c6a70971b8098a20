"""No array reaches compiled code that does not fit: a wrong recording is refused where it is made."""

import os
import sys
from pathlib import Path

import corrupted
import numpy as np
import pytest
from conftest import refused, standing
from shell import python, ran

from coopoc import V2X, InputError, JointFilter, Sensors, observe

KERNELS = ("kalman", "lkf-sa", "msmv-r", "joint", "ci", "batch-smoother")


@pytest.mark.parametrize("whole", [True, False], ids=["complete", "with gaps"])
def test_arrays_that_do_not_fit_are_refused(whole):
    """Every field cut, shifted, reordered, of another kind, or not finite: an InputError, by `replace` too."""
    valid, cases = corrupted.recording(whole=whole), 0
    for what, parts in corrupted.wrong(valid):
        with pytest.raises(InputError) as caught:
            corrupted.with_parts(valid, **parts)
        assert caught.value.hint, what
        cases += 1
    assert cases > 200


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"arrival": np.full((1, 72), -1)}, r"arrival = shape \(1, 72\): must have shape \(R, L\) = \(4, 72\)"),
        ({"neighbour": 1000 + np.arange(72)}, r"links\.neighbour\[0\] = 1000: must be in 0\.\.2"),
        ({"arrival": np.full((4, 72), -7)}, r"arrival\[0, 0\] = -7: must be -1"),
        ({"broadcasts": np.ones((12, 3))}, "broadcasts = dtype float64: must be an array of booleans"),
        ({"t": [0.0, 0.1]}, r"gnss = shape .*\(R, T, N, 3\) = \(any, 2, 3, 3\)"),
        ({"sensors": V2X()}, "sensors = V2X"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_the_error_names_field_value_and_allowed(parts, words):
    with refused(words):
        corrupted.with_parts(corrupted.recording(), **parts)


def program(*given, **env: str):
    """What tests/corrupted.py complains about, in a process that may crash."""
    done = ran([sys.executable, str(Path(corrupted.__file__)), *given], env={**os.environ, **env})
    assert done.returncode in (0, 1), f"{given}: ended by signal {-done.returncode}\n{done.stderr[-2000:]}"
    return done.stdout


@pytest.mark.slow
def test_every_method_reads_any_memory_layout_and_survives_odd_recordings():
    """Views, Fortran order, unaligned and swapped bytes give the digits of the valid recording; none crashes."""
    assert program("odd", *KERNELS) == ""


def test_what_is_held_cannot_be_written_to():
    valid = corrupted.recording()
    given = {name: np.array(array) for name, array in corrupted.arrays(valid).items()}
    for name, array in corrupted.arrays(corrupted.with_parts(valid, **given)).items():
        given[name][...] = 0
        np.testing.assert_array_equal(array, corrupted.arrays(valid)[name])
        assert array.flags.c_contiguous
        assert not array.flags.writeable


def test_whole_numbers_are_as_good_as_floats():
    given = Sensors(gnss_std=[2, 2, 2], range_std=1, min_range=2, gnss_drift_time=np.int64(9))  # type: ignore[arg-type]
    assert isinstance(given.min_range, float)
    assert given == Sensors((2.0,) * 3, range_std=1.0, min_range=2.0, gnss_drift_time=9.0)
    seen = observe(standing([[0, 0, 0], [9, 0, 0]]), given, V2X(radius=30, rate=10, latency=0), runs=np.int64(2))  # type: ignore[arg-type]
    assert JointFilter()(seen, [0]).x.shape == (2, 2, 1, 3)


CODE = """
import numpy as np
from coopoc.kernels.compiling.vectors import put, take
from coopoc.kernels.compiling.compile import as_written, part

@part
def copied(array, at):
    put(array, np.uint64(0), take(array, np.uint64(at)))

@part
def plain(array, at):
    array[at] = 0.0

@as_written
def call(which, array, at):
    if which == 0:
        copied(array, at)
    else:
        plain(array, at)

for which, (name, last) in enumerate((("copied", 2), ("plain", 11))):
    call(which, np.zeros(12), last)
    try:
        call(which, np.zeros(12), last + 1)
    except IndexError:
        print(name, "checks")
"""


def test_under_the_switch_scalar_and_vector_access_is_checked():
    """NUMBA_BOUNDSCHECK=1 holds for the intrinsics, which work on pointers, too."""
    said = python("-c", CODE, env={**os.environ, "NUMBA_BOUNDSCHECK": "1"})
    assert said.split("\n")[:-1] == ["copied checks", "plain checks"]
