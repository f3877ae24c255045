"""A data set as Python's own sequences: what is in it comes one by one, or by its number."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Generic, TypeVar

from lidarflow.checks import is_whole
from lidarflow.errors import InputError, OutOfRangeError

Item = TypeVar("Item")


class OneByOne(ABC, Generic[Item]):
    """Items that are read when they are asked for; none is kept.

    name  what messages call the data set
    item  what they call one of its items
    """

    name: str
    item: str

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def _item(self, index: int) -> Item:
        """The item at `index`, from 0 to the length less one."""

    def __iter__(self) -> Iterator[Item]:
        return (self._item(index) for index in range(len(self)))

    def __getitem__(self, index: int) -> Item:
        """The item at `index`, from the end where it is negative.

        OutOfRangeError, a DataError and an IndexError, where there is none; InputError unless it is whole.
        """
        self._check_whole(index)
        return self._item(self.check_index(index + len(self) if -len(self) <= index < 0 else index))

    def check_index(self, index: int) -> int:
        """`index` as an int of Python; OutOfRangeError where no item has it, InputError unless whole."""
        self._check_whole(index)
        if not 0 <= index < len(self):
            raise OutOfRangeError(f"{self.name}: no {self.item} {index}; there are {len(self)}, from 0 on")
        return int(index)

    def _check_whole(self, index: int) -> None:
        if not is_whole(index):
            raise InputError(f"{self.name}: {self.item} {index!r}; expected the number of a {self.item}, "
                             "from 0 on")
