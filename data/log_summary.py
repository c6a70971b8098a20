"""Summary of a log: what was read, what was not used and why, what is assumed, with counts."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Tally:
    """Counts that grow while a log is read.

    Attributes:
        read: what -> number.
        refused: reason -> number of measurements that are not in the Recording.
        where: reason -> place of the first.
        left: what was never meant to be read -> number.
        assumed: sentence, with {} for names -> the names, none where it is about all.
    """

    read: dict[str, int] = field(default_factory=dict)
    refused: dict[str, int] = field(default_factory=dict)
    where: dict[str, str] = field(default_factory=dict)
    left: dict[str, int] = field(default_factory=dict)
    assumed: dict[str, list[str]] = field(default_factory=dict)

    def count(self, what: str, number: int) -> None:
        """Add to what was read."""
        if number:
            self.read[what] = self.read.get(what, 0) + number

    def refuse(self, reason: str, number: int, where: str = "") -> None:
        """Add to what is not in the Recording."""
        if number:
            self.refused[reason] = self.refused.get(reason, 0) + number
            self.where.setdefault(reason, where)

    def unused(self, what: str, number: int) -> None:
        """Add to what was not meant to be read."""
        self.left[what] = self.left.get(what, 0) + number

    def assume(self, sentence: str, name: str = "") -> None:
        """Add a sentence, once, and a name that takes the place of its {}."""
        names = self.assumed.setdefault(sentence, [])
        if name and name not in names:
            names.append(name)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What is assumed, with the names.

        >>> tally = Tally()
        >>> tally.assume("{} stands", "a"), tally.assume("{} stands", "b"), tally.sentences
        (None, None, ('a, b stands',))
        """
        return tuple(sentence.format(", ".join(names)) for sentence, names in self.assumed.items())


@dataclass(frozen=True)
class Summary:
    """What became of the rows of a log.

    Args:
        name: of the log.
        grid: steps and interval in words.
        vehicles: id -> what was read of it, in words.
        read: what -> number of measurements in the Recording.
        refused: reason -> (number, place of the first) of measurements that are not in it.
        unused: what was never meant to be read -> number of cells.
        assumed: sentences on what the log does not say.

    >>> refused = {"a second fix in a step": (1, "f: row 2")}
    >>> print(Summary("drive", "3 steps of 0.1 s", {"a": "3 fixes"}, {"fixes": 3}, refused))
    drive: 3 steps of 0.1 s, 1 vehicle
      a: 3 fixes
    read: 3 fixes
    not used: 1 a second fix in a step (first: f: row 2)
    """

    name: str
    grid: str
    vehicles: dict[str, str] = field(default_factory=dict)
    read: dict[str, int] = field(default_factory=dict)
    refused: dict[str, tuple[int, str]] = field(default_factory=dict)
    unused: dict[str, int] = field(default_factory=dict)
    assumed: tuple[str, ...] = ()

    def __str__(self) -> str:
        count = len(self.vehicles)
        lines = [f"{self.name}: {self.grid}, {count} vehicle{'s' * (count != 1)}"]
        lines += [f"  {name}: {text}" for name, text in self.vehicles.items()]
        lines += [f"read: {', '.join(f'{number} {what}' for what, number in self.read.items())}"]
        for why, (number, first) in self.refused.items():
            lines.append(f"not used: {number} {why}" + (f" (first: {first})" if first else ""))
        lines += [f"not read: {what} ({number} cells)" for what, number in self.unused.items()]
        lines += [f"assumed: {sentence}" for sentence in self.assumed]
        return "\n".join(lines)
