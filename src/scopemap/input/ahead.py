"""Items that are computed ahead of their use, in a thread of their own."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

_Item = TypeVar("_Item")
_END = object()


def in_thread(items: Iterable[_Item], thread: str, count: int = 2) -> Generator[_Item, None, None]:
    """Yield items in order, computed in a thread of their own, at most `count` ahead of their use.

    thread : its name. An error of an item is raised where the item would come. Closed early, the thread ends after the
    item that it computes.
    """
    source = iter(items)
    worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix=thread)
    try:
        coming = deque(worker.submit(next, source, _END) for _ in range(count))
        while (item := coming.popleft().result()) is not _END:
            coming.append(worker.submit(next, source, _END))
            yield item  # type: ignore[misc]
    finally:
        worker.shutdown(cancel_futures=True)
        if hasattr(source, "close"):
            source.close()
