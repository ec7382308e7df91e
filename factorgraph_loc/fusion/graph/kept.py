"""A list whose oldest items can be forgotten while the others keep their numbers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Generic, TypeVar, overload

T = TypeVar("T")


class Kept(Sequence[T], Generic[T]):
    """Items by number. The length counts those that were forgotten; only the others can be had, by number, slice or iteration."""

    def __init__(self, items: Iterable[T] = ()) -> None:
        self._items = list(items)
        self.first = 0  # the number of the oldest that is kept

    def __len__(self) -> int:
        return self.first + len(self._items)

    def __iter__(self) -> Iterator[T]:
        return iter(self._items)

    @overload
    def __getitem__(self, number: int) -> T: ...
    @overload
    def __getitem__(self, number: slice) -> list[T]: ...
    def __getitem__(self, number: int | slice) -> T | list[T]:
        return self._items[self._place(number)]

    def __setitem__(self, number: int, item: T) -> None:
        self._items[self._place(number)] = item

    def __delitem__(self, numbers: slice) -> None:
        del self._items[self._place(numbers)]

    @property
    def last(self) -> T:
        """The newest item."""
        return self._items[-1]

    def append(self, item: T) -> None:
        """Add one at the end."""
        self._items.append(item)

    def __iadd__(self, items: Iterable[T]) -> Kept[T]:
        self._items += items
        return self

    def copy(self) -> Kept[T]:
        """A list of its own with the same items and numbers."""
        out = Kept(self._items)
        out.first = self.first
        return out

    def forget(self, before: int) -> None:
        """Forget the items with numbers below ``before``."""
        count = min(max(0, before - self.first), len(self._items))
        del self._items[:count]
        self.first += count

    @overload
    def _place(self, number: int) -> int: ...
    @overload
    def _place(self, number: slice) -> slice: ...
    def _place(self, number: int | slice) -> int | slice:
        """Where a number, or a slice of successive ones, stands among those that are kept."""
        if isinstance(number, slice):
            start, stop, _ = number.indices(len(self))
            return slice(max(0, start - self.first), max(0, stop - self.first))
        place = number + len(self._items) if number < 0 else number - self.first
        if place < 0:
            raise IndexError(f"item {number} was forgotten")
        return place
