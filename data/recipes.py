"""Recipe: everything that decides the numbers of a generated fleet, and the recipes of the bundled ones."""

from __future__ import annotations

from dataclasses import dataclass, fields

from coopoc.errors import InputError

_CLOCKWISE = "10 0 3 2 1 8 -4 -5 -6 -7 17"
_ANTICLOCKWISE = "-17 7 6 5 4 -8 -1 -2 -3 -0 -10"


@dataclass(frozen=True)
class Recipe:
    """Settings of a SUMO run, and the part of it that is kept.

    Args:
        name: name of the fleet; vehicles are called name-00, name-01, ...
        map: OpenDRIVE file in the folder of maps.
        vehicles: number of vehicles N.
        steps: steps that are kept, one number for all or one per vehicle (absent, NaN, afterwards).
        seed: of routes, top speeds and SUMO.
        top_speed: (low, high) m/s, each vehicle's own top speed is uniform between them.
        warmup: seconds that are driven before the first kept step.
        platoon: vehicles that share one random route and start on the same edge.
        start: SUMO's departPos: "random_free" spreads a platoon over its first edge, "last" queues it.
        lights: True: netconvert guesses junctions with traffic lights, actuated; False: junctions of equal rank.
        turn_acceleration: m/s^2 of lateral acceleration that limits the speed in turns of junctions.
        tours: routes that are repeated instead of random ones, for the first vehicles: edge ids with spaces between.
        dawdle: Krauss' sigma in 0..1, how irregularly a driver keeps the speed.
        dt: sampling interval, s.
        cutoff: Hz, half-power frequency of the smoother.

    Raises:
        InputError: a number that no drive can have.

    >>> Recipe("tiny", "Town10HD.xodr", vehicles=2, steps=20, seed=1).lengths
    (20, 20)
    """

    name: str
    map: str
    vehicles: int
    steps: int | tuple[int, ...]
    seed: int
    top_speed: tuple[float, float] = (8.0, 11.0)
    warmup: float = 60.0
    platoon: int = 1
    start: str = "random_free"
    lights: bool = True
    turn_acceleration: float = 3.0
    tours: tuple[str, ...] = ()
    dawdle: float = 0.5
    dt: float = 0.1
    cutoff: float = 0.5

    def __post_init__(self) -> None:
        low, high = self.top_speed
        positive = {f.name: getattr(self, f.name) for f in fields(self) if f.name in _POSITIVE}
        for field, value in positive.items():
            if not value > 0:
                raise InputError(field, value, "must be > 0", f"Give the recipe a positive {field}.")
        if not 0 < low <= high:
            raise InputError("top_speed", self.top_speed, "must be 0 < low <= high m/s", "Order the two speeds.")
        if len(self.lengths) != self.vehicles or min(self.lengths) < 2:
            raise InputError(
                "steps", self.steps, f"must be one number >= 2, or {self.vehicles} of them", "One entry per vehicle."
            )

    @property
    def lengths(self) -> tuple[int, ...]:
        """Kept steps of each vehicle."""
        return (self.steps,) * self.vehicles if isinstance(self.steps, int) else tuple(self.steps)


_POSITIVE = ("vehicles", "platoon", "turn_acceleration", "dt", "cutoff")

RECIPES: dict[str, Recipe] = {
    recipe.name: recipe
    for recipe in (
        Recipe("town10", "Town10HD.xodr", vehicles=60, steps=900, seed=16, platoon=6),
        Recipe("town10-validation", "Town10HD.xodr", vehicles=60, steps=900, seed=32, platoon=6),
        Recipe(
            "town10-clients",
            "Town10HD.xodr",
            vehicles=4,
            steps=(1550, 4600, 1450, 1420),
            seed=50,
            top_speed=(10.7, 10.7),
            lights=False,
            dawdle=0.6,
            tours=(_CLOCKWISE, _ANTICLOCKWISE),
        ),
        Recipe(
            "town04", "Town04.xodr", vehicles=60, steps=900, seed=5, top_speed=(11.0, 13.5), platoon=10, start="last"
        ),
    )
}
