"""Graph -> lines: shared by the writers of PyFG and g2o."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..arrays import Floats, Ints
from ..errors import InputError
from .edges import ENDS, PoseEdges, RangeEdges
from .graph import Graph
from .lines import to_text
from .noise import inverse, upper_triangle
from .records import Grammar, Record


def to_lines(graph: Graph, grammar: Grammar, label: Callable[[str], str]) -> list[str]:
    """Lines of a graph: vertices in its order, then what was measured, kind by kind.

    Args:
        label: name of a vertex -> the word for it.

    Raises:
        InputError: a position or stamp that the format needs and the graph lacks, a stamp that the format could not
            keep, or a singular covariance where it wants information.
    """
    records = {r.kind: (tag, r) for tag, r in grammar.records.items() if r.dimension in (0, graph.dimension)}
    words = [label(name) for name in graph.names]
    out: list[str] = [""] * len(words)
    for kind in ("pose", "point"):
        own = np.flatnonzero(graph.is_pose == (kind == "pose"))
        values = np.hstack([graph.position, graph.orientation] if kind == "pose" else [graph.position])[own]
        _refuse(graph, grammar, *records[kind], graph.stamps[own], own, values)
        for k, line in zip(own, _lines(*records[kind], graph.stamps[own], own[:, None], words, values), strict=True):
            out[k] = line
    for kind in ENDS:
        edges, values = getattr(graph, kind), _numbers(graph, kind, grammar)
        _refuse(graph, grammar, *records[kind], edges.stamps, edges.nodes[:, 0], values)
        out += _lines(*records[kind], edges.stamps, edges.nodes, words, values)
    return out


def _numbers(graph: Graph, kind: str, grammar: Grammar) -> Floats:
    """(M, C) what an edge measures, and the upper triangle of its noise."""
    edges = getattr(graph, kind)
    if isinstance(edges, RangeEdges):
        values, noise = edges.distance[:, None], edges.variance[:, None, None]
    else:
        values, noise = edges.position, edges.covariance
    if isinstance(edges, PoseEdges):
        values = np.hstack([values, edges.orientation])
    if grammar.noise == "information":
        noise = inverse(noise, lambda row: f"{kind}[{row}]", "covariance")
    return np.hstack([values, upper_triangle(noise)])


def _refuse(
    graph: Graph, grammar: Grammar, tag: str, record: Record, stamps: Floats, nodes: Ints, values: Floats
) -> None:
    missing = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(missing):
        raise InputError(
            f"vertex {graph.names[nodes[missing[0]]]}",
            "NaN",
            f"must be known: {tag} holds it",
            "Give it a position and an orientation, such as an initial guess.",
        )
    off = np.flatnonzero(np.isfinite(stamps) != record.stamped)
    if len(off):
        needs, value = ("must be given", "t") if record.stamped else ("has no place", "np.nan")
        raise InputError(
            f"stamp of {record.kind} of {graph.names[nodes[off[0]]]}",
            stamps[off[0]],
            f"{needs} in a line {tag} of {grammar.format}",
            f"Write graph.stamped({value}), or replace the stamps.",
        )


def _lines(tag: str, record: Record, stamps: Floats, nodes: Ints, words: Sequence[str], values: Floats) -> list[str]:
    stamp = [f" {t!r}" if record.stamped else "" for t in stamps.tolist()]
    ends = [" ".join(words[k] for k in pair) + " 0" * record.offset for pair in nodes.tolist()]
    return [f"{tag}{t} {names} {text}" for t, names, text in zip(stamp, ends, to_text(values), strict=True)]
