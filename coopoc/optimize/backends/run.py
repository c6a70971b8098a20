"""What a backend is: build(problem, **options) returns a Run, which takes a start and says where it ended."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from ...arrays import Floats


@dataclass(frozen=True, eq=False)
class Ended:
    """A backend's claim, which `solve` checks: x (n, 3) m, iterations, and extras of its own."""

    x: Floats
    iterations: int
    extras: dict[str, Any] = field(default_factory=dict)


Run: TypeAlias = Callable[[Floats], Ended]
