"""Fixes that are missing while a vehicle drives on are inputs: of whole recordings as of streams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from coopoc import (
    LKFSA,
    MSMV,
    V2X,
    CovarianceIntersection,
    Fleet,
    InputError,
    JointFilter,
    Kalman,
    Recording,
    Sensors,
    observe,
    rt_le,
)
from coopoc.learned import CooperativeGain, GainNet, LearnedGain, NoiseNet, RecursiveFilter, RecursiveGain
from coopoc.learned.nets.cooperative import NetNoise
from coopoc.methods.drift_filter import DriftFilter
from coopoc.methods.noise_model import NoiseModel

SOLO = (Kalman(), LearnedGain(GainNet(4, 1)), RecursiveFilter(RecursiveGain()), NoiseNet().method("noise"))
STARS = (
    JointFilter(),
    JointFilter(exact=False),
    LKFSA("nominal"),
    DriftFilter(),
    CooperativeGain(NoiseNet()),
    MSMV("nominal"),
    CovarianceIntersection(split=True),
)


def holed(recording: Recording, share: float, vehicles: slice = slice(None)) -> Recording:
    """The recording without a share of the fixes; the first ones stay."""
    gnss = recording.gnss.copy()
    gone = np.random.default_rng(5).uniform(size=gnss.shape[:3]) < share
    gone[:, 0] = False
    gnss[:, :, vehicles][gone[:, :, vehicles]] = np.nan
    return replace(recording, gnss=gnss)


def test_kalman_without_fixes_predicts_as_filterpy_does(crossing: Fleet) -> None:
    seen = holed(observe(crossing, Sensors(), V2X(0), runs=1), 0.4)
    track = Kalman()(seen, [1])
    q = np.broadcast_to(NoiseModel.nominal(seen.sensors).process_variance(seen), seen.gnss.shape)[0, :, 1]
    kf = KalmanFilter(dim_x=3, dim_z=3)
    kf.x, kf.P, kf.H, kf.R, kf.F, kf.B = (
        seen.gnss[0, 0, 1][:, None],
        2.25 * np.eye(3),
        np.eye(3),
        2.25 * np.eye(3),
        np.eye(3),
        0.1 * np.eye(3),
    )
    for t in range(1, len(crossing.t)):
        kf.predict(u=seen.velocity[0, t, 1][:, None], Q=np.diag(q[t]))
        if np.isfinite(seen.gnss[0, t, 1]).all():
            kf.update(seen.gnss[0, t, 1][:, None])
        np.testing.assert_allclose(track.x[0, t, 0], kf.x[:, 0], atol=1e-9)


@pytest.mark.parametrize("method", [*SOLO, *STARS], ids=lambda m: f"{m.name}{getattr(m, 'exact', '')}")
def test_missing_fixes_cost_and_do_not_crash(crossing: Fleet, method) -> None:  # type: ignore[no-untyped-def]
    whole = observe(crossing, Sensors(gnss_std=(4, 4, 4)), V2X(4, 80.0), runs=6)
    some, few = (float(rt_le(method(holed(whole, share), [0, 3]), crossing).mean()) for share in (0.0, 0.7))
    assert np.isfinite(few)
    assert few < 4 * np.sqrt(3)
    assert method.name in ("fedkalmannet", "lkf-sa") or few > some


def test_a_missing_fix_is_one_of_boundless_variance(crossing: Fleet) -> None:
    """And not one at the origin: the joint filter that assumes 10^12 m^2 of those fixes gives the same answer."""
    whole = observe(crossing, Sensors(), V2X(4, 80.0), runs=2)
    some, known = holed(whole, 0.5), NoiseModel.nominal(whole.sensors)
    r = np.where(np.isnan(some.gnss), 1e12, 1.5**2)
    process = np.broadcast_to(known.process_variance(whole), whole.gnss.shape)
    given = NetNoise("net", whole.sensors, fix=r, process=process)
    np.testing.assert_allclose(JointFilter(known)(some, [0]).x, JointFilter(given)(whole, [0]).x, atol=1e-5)


def test_a_drive_starts_with_a_fix(crossing: Fleet) -> None:
    seen = observe(crossing, Sensors(), V2X(0), runs=1)
    gnss = seen.gnss.copy()
    gnss[:, 0] = np.nan
    with pytest.raises(InputError, match="no fix at step 0"):
        Kalman()(replace(seen, gnss=gnss), [0])
