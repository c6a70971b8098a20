"""Outliers: which measurements are wrong by more than noise, how often, by how much and for how long."""

from dataclasses import dataclass, fields, replace
from typing import Literal

from ..arrays import check_fields, extent, instance
from ..errors import InputError, unknown

Law = Literal["uniform", "exponential"]


@dataclass(frozen=True)
class Fault:
    r"""How often a kind of measurement is wrong, by how much, and for how long.

    Whether a sensor is at fault, and its error, are drawn anew at a step with probability $1 - e^{-dt / lasts}$ and
    stay in between. All that is wrong at one rate is wrong at a higher one, too, by the same error.

    >>> Fault(rate=0.05, size=(3.0, 20.0)).rate
    0.05
    """

    rate: float = 0.0
    """Share of the measurements, in [0, 1]."""
    size: tuple[float, float] = (0.0, 0.0)
    """(low, high) of the error: metres, of odometry a share of the speed."""
    law: Law = "uniform"
    """"uniform": between low and high. "exponential": low plus an exponential draw of mean high - low."""
    lasts: float = 0.0
    """s, time constant of the state; 0: every measurement by itself."""

    def __post_init__(self) -> None:
        lasts = (0, 1e18, ">= 0 s, 0 for every measurement by itself")
        check_fields(self, {"rate": (0, 1, "in [0, 1], 0.05 for one measurement in twenty"), "lasts": lasts})
        self.__dict__["size"] = extent("size", self.size)


@dataclass(frozen=True)
class Outliers:
    """What goes wrong beyond noise; by default nothing. Methods do not know of it.

    >>> Outliers(ranges=Fault(0.05, (3.0, 20.0))).notes
    ('5 % of the ranges 3 to 20 m too long',)
    """

    ranges: Fault = Fault(size=(3.0, 20.0))
    """Non-line-of-sight: ranges too long, the same for both vehicles of a pair."""
    angles: Fault = Fault()
    """Wrong association: azimuth and inclination are those of the vehicle nearest to the right one. The range stays:
    a radio message names its sender, a camera's or a radar's echo does not."""
    fixes: Fault = Fault(size=(10.0, 50.0), lasts=10.0)
    """Multipath: fixes displaced in a random direction. A vehicle's first fix is right."""
    outages: Fault = Fault(lasts=5.0)
    """No fix at all. A vehicle's first fix is there."""
    odometry: Fault = Fault(size=(0.2, 1.0), lasts=0.5)
    """Slip: the speed is measured too high or too low by a share of itself; wheels that lock measure none."""

    def __post_init__(self) -> None:
        check_fields(self)

    @classmethod
    def uwb_nlos(cls) -> "Outliers":
        """Ultra-wideband ranging past obstacles: 5 % of the ranges too long by 0.3 m and more, 0.42 m on average.

        Share and sizes are those of the 233 measured ranges of libRSF's Labyrinth data set, whose stated standard
        deviation is 0.1 m (5 % are more than 0.3 m too long, by 0.42 m on average and 0.66 m at most). The law is an
        exponential (Bellusci, Janssen, Yan, Tiberius, "Modeling distance and bandwidth dependency of TOA-based UWB
        ranging error for positioning", 2008; O'Lone, Dhillon, Buehrer, arXiv 1905.00603, derive it). Combine it with
        `range_std=0.1`.
        """
        return cls(ranges=Fault(0.05, (0.3, 0.42), "exponential", 0.5))

    @classmethod
    def urban_canyon(cls) -> "Outliers":
        """Dense high buildings: 10 % of the fixes off by tens of metres, 5 % missing, for seconds.

        Reflections lengthen pseudoranges by "typically a few tens of meters" and positions are off as far (Groves,
        Adjrad, GPS Solutions 21, 2017, doi 10.1007/s10291-017-0654-1); 95 % availability is missed even in mildly
        difficult streets (Kleijer, Odijk, Verbree, "Prediction of GNSS availability and accuracy in urban
        environments", 2009). The share of wrong fixes and the durations of 10 and 5 s are choices.
        """
        return cls(fixes=Fault(0.10, (10.0, 50.0), lasts=10.0), outages=Fault(0.05, lasts=5.0))

    @classmethod
    def named(cls, text: str) -> "Outliers":
        """Of presets and kinds joined by "+", as settings of studies name them; "" is none.

        A kind has a rate and may have a duration in s: ranges=0.05, ranges=0.05:2.

        Raises:
            InputError: an unknown preset or kind, a rate outside [0, 1].

        >>> Outliers.named("urban_canyon").notes[-1]
        '5 % of the fixes missing, for 5 s'
        >>> Outliers.named("urban_canyon+ranges=0.05:2").notes[0]
        '5 % of the ranges 3 to 20 m too long, for 2 s'
        >>> Outliers.named("ranges")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        coopoc.errors.InputError: outliers = 'ranges': must be one of ... Did you mean ranges=RATE?
        """
        outliers, kinds = cls(), [field.name for field in fields(cls)]
        for part in filter(None, instance("outliers", text, str).split("+")):
            name, _, numbers = part.partition("=")
            if name in PRESETS and not numbers:
                preset = PRESETS[name]()
                outliers = replace(outliers, **{k: getattr(preset, k) for k in kinds if getattr(preset, k).rate})
            elif name in kinds and numbers:
                try:
                    changes = dict(zip(("rate", "lasts"), map(float, numbers.split(":", 1)), strict=False))
                except ValueError:
                    hint = f"{name}=0.05 makes one in twenty wrong, {name}=0.05:2 for 2 s."
                    raise InputError(name, repr(numbers), "must be RATE or RATE:SECONDS", hint) from None
                outliers = replace(outliers, **{name: replace(getattr(outliers, name), **changes)})
            else:
                raise unknown("outliers", part, [*PRESETS, *(f"{kind}=RATE" for kind in kinds)])
        return outliers

    @property
    def notes(self) -> tuple[str, ...]:
        """A sentence for each kind that acts."""
        return tuple(
            TEXTS[field.name].format(100 * fault.rate, *fault.size)
            + (", exponential" if fault.law == "exponential" else "")
            + (f", for {fault.lasts:g} s" if fault.lasts else "")
            for field in fields(self)
            if (fault := getattr(self, field.name)).rate
        )


PRESETS = {"uwb_nlos": Outliers.uwb_nlos, "urban_canyon": Outliers.urban_canyon}
TEXTS = {
    "ranges": "{:g} % of the ranges {:g} to {:g} m too long",
    "angles": "{:g} % of the angles those of another vehicle",
    "fixes": "{:g} % of the fixes {:g} to {:g} m off",
    "outages": "{:g} % of the fixes missing",
    "odometry": "{:g} % of the speeds wrong by {:g} to {:g} of themselves",
}
