"""What a backend is: build(problem, **options) returns a Run, which takes a start and says where it ended."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from ...arrays import Floats


@dataclass(frozen=True, eq=False)
class Ended:
    """A backend's claim, which `solve` checks: x (n, width), iterations, extras of its own, "no point is feasible"."""

    x: Floats
    iterations: int
    extras: dict[str, Any] = field(default_factory=dict)
    infeasible: bool = False


Run: TypeAlias = Callable[[Floats], Ended]
