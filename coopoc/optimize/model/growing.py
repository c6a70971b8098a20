"""A sequence that is extended by one item in constant time: what it shares with its extensions is stored once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from threading import Lock
from typing import Generic, TypeVar, overload

Item = TypeVar("Item")


class Growing(Sequence[Item], Generic[Item]):
    """An immutable sequence, the first `count` items of a list that its extensions share.

    The first extension of the longest appends to the list; any other copies it.

    >>> one = Growing(["a"])
    >>> two, other = one.plus("b"), one.plus("c")
    >>> list(one), list(two), list(other)
    (['a'], ['a', 'b'], ['a', 'c'])
    """

    __slots__ = ("_count", "_items", "_lock")

    def __init__(self, items: Iterable[Item]) -> None:
        self._items, self._lock = list(items), Lock()
        self._count = len(self._items)

    def plus(self, item: Item) -> Growing[Item]:
        """The sequence and one more item."""
        with self._lock:
            if len(self._items) > self._count:
                return Growing([*islice(self._items, self._count), item])
            self._items.append(item)
        longer: Growing[Item] = Growing.__new__(Growing)
        longer._items, longer._lock, longer._count = self._items, self._lock, self._count + 1
        return longer

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Item]:
        return islice(self._items, self._count)

    @overload
    def __getitem__(self, place: int) -> Item: ...
    @overload
    def __getitem__(self, place: slice) -> Sequence[Item]: ...
    def __getitem__(self, place: int | slice) -> Item | Sequence[Item]:
        if isinstance(place, slice):
            return self._items[: self._count][place]
        return self._items[range(self._count)[place]]

    def __repr__(self) -> str:
        return repr(tuple(self))
