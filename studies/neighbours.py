"""Collaborative training against collaborative decision: RT-LE against neighbours and against bytes (paper, Fig. 5)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from coopoc.evaluate.bounds import bound_rt_le, posterior_bound
from coopoc.study.environment import revision
from coopoc.study.study import Params, Row, Study
from coopoc.world.sensing import find_links

from . import lineup, scene, weights

if TYPE_CHECKING:
    from coopoc.study.figures import Plot
    from coopoc.study.results import Results
    from coopoc.study.tables import Table

NEIGHBOURS = (0, 1, 2, 3, 4, 6, 8, 10)
RATES_HZ = (5.0, 2.0, 1.0)
CAPS = (300.0, 600.0, 1200.0)
TRAINED = ("okf", "fedkalmannet", "centralised")


def _grid() -> list[dict[str, Any]]:
    """Every method at every K over an ideal channel, then the cooperative ones at K = 10 under rates and byte caps."""
    pairs = [("gnss", "nominal"), *((m, "trained") for m in TRAINED), ("bound", "bound")]
    pairs += [("kalman", k) for k in ("identity", "nominal", "fitted")]
    shared = [(m, k) for m in lineup.COOPERATIVE for k in ("identity", "nominal", "fitted")]
    free = {"rate_hz": 10.0, "cap_bytes_per_second": None}
    grid = [
        {"max_neighbours": k, **free, "method": m, "knowledge": known}
        for k in NEIGHBOURS for m, known in [*pairs, *shared]
    ]  # fmt: skip
    tight = [{"rate_hz": rate, "cap_bytes_per_second": None} for rate in RATES_HZ]
    tight += [{"rate_hz": 10.0, "cap_bytes_per_second": cap} for cap in CAPS]
    budget = [(m, k) for m, k in shared if m in ("lkf-sa", "joint")]
    grid += [{"max_neighbours": 10, **t, "method": m, "knowledge": known} for t in tight for m, known in budget]
    return grid


def _meaningful(p: Params) -> bool:
    """No more neighbours than there are vehicles; no bound for real data, whose noise nobody knows; no exact step
    without a noise model."""
    if p["max_neighbours"] >= len(scene.fleet(p["data"]).ids):
        return False
    return not (p["method"] == "bound" and scene.is_real(p["data"])) and not (
        p["method"] == "joint" and p["knowledge"] == "identity"
    )


def cell(p: Params) -> list[Row]:
    """Rows of one method at one K and budget; of the bound, one row per ego."""
    if p["method"] != "bound":
        return lineup.rows(p)
    drive, acting = scene.fleet(p["data"]), scene.sensors(p)
    found = []
    for ego in scene.egos(p["data"], str(p["egos"])):
        column = drive.index(ego)
        bound = bound_rt_le(posterior_bound(drive, acting, column, scene.channel(p)))
        links = find_links(drive, [column], p["max_neighbours"], float(p["radius_m"]), acting.min_range)
        found.append({"run": 0, "ego": ego, "rt_le_m": bound, "neighbours_mean": len(links) / len(drive.t)})
    return found


def key(p: Params) -> dict[str, str]:
    """What else changes the numbers."""
    scene.channel(p)
    extra = {"fleet": scene.fleet(p["data"]).digest, "code": revision("coopoc.world", "coopoc.methods", "coopoc.optimize")}
    if p["method"] in weights.LEARNED:
        extra["weights"] = weights.key(p["method"], p)
    return extra
