"""Waiting for frames, but not for ever: a decoder may hang, and so may a disk on a network."""

from __future__ import annotations

from collections.abc import Generator
from queue import Empty, SimpleQueue
from threading import Thread
from typing import TypeVar

_Item = TypeVar("_Item")
_END = object()


class HangingError(Exception):
    """An item has not come in time."""


def in_time(items: Generator[_Item, None, None], first_s: float, next_s: float) -> Generator[_Item, None, None]:
    """Yield items as they are, one at a time; raise `HangingError` where one does not come in time.

    first_s, next_s : how long the first and every other may take, s. Items come from a thread of their own, which is
    left to itself where it hangs: it does not keep the process from ending.
    """
    asked, found = SimpleQueue[bool](), SimpleQueue[tuple[object, BaseException | None]]()

    def answer() -> None:
        while asked.get():
            try:
                found.put((next(items, _END), None))
            except BaseException as error:
                found.put((None, error))
        items.close()

    reader, limit_s, hangs = Thread(target=answer, name="read", daemon=True), first_s, False
    reader.start()
    try:
        while True:
            asked.put(True)
            try:
                item, error = found.get(timeout=limit_s)
            except Empty:
                hangs = True
                raise HangingError(f"{limit_s:g} s") from None
            if error is not None:
                raise error
            if item is _END:
                return
            yield item  # type: ignore[misc]
            limit_s = next_s
    finally:
        asked.put(False)
        if not hangs:
            reader.join()
