"""Search: how the x0 of a problem was found, and what that took."""

from __future__ import annotations

from typing import NamedTuple


class Search(NamedTuple):
    """The search for a start; the Solution's iterations and seconds contain it.

    Attributes:
        start: name of the start, "" if the user gave x0.
        iterations: linear steps from all starts that were tried.
        seconds: to make the starts and to take those steps.

    >>> Search("odometry").iterations
    0
    """

    start: str = ""
    iterations: int = 0
    seconds: float = 0.0

    @property
    def extras(self) -> dict[str, str | int | float]:
        """For `Solution.extras`."""
        return {"start": self.start, "start_iterations": self.iterations, "start_seconds": self.seconds}
