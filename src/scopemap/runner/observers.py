"""What may look at a run while it goes on, and end it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol, runtime_checkable

from scopemap.engine.frame import Frame
from scopemap.engine.odometry import Step

Observer = Callable[[Step], bool | None]
"""Called with each step; True: no further frame is read, and the result is of the frames until then."""


@runtime_checkable
class LastingObserver(Protocol):
    """An `Observer` that sees all frames where a run is resumed, too, and is saved with the result."""

    def __call__(self, step: Step) -> bool | None:
        """Take a step."""

    def again(self, step: Step) -> None:
        """Take a step that was made before the run was resumed, its frame as stored: colours to a few levels.

        Of a frame that was skipped there is no picture.
        """

    def save(self, run: Path) -> None:
        """Write what was observed to the folder of the result."""


@runtime_checkable
class FinalFrameObserver(Protocol):
    """An `Observer` that also sees each frame with its final depth and pose, as it is written."""

    def __call__(self, step: Step) -> bool | None:
        """Take a step."""

    def final(self, frame: Frame) -> None:
        """Take a frame whose depth and pose are final."""


@runtime_checkable
class RestartedObserver(Protocol):
    """An `Observer` that forgets what it has seen where a run begins again at its first frame."""

    def __call__(self, step: Step) -> bool | None:
        """Take a step."""

    def forget(self) -> None:
        """Begin anew."""


Progress = Callable[[str, int, int], None]
"""Called with what is done outside of tracking (such as "fusing"), frames done, and all frames; 0: not in frames."""
FrameWriter = Callable[[Frame], None]
"""Writes something of a frame whose depth is final."""


class RunStopped(Exception):
    """Raised by an observer to end a run without a result.

    No further frame is read, the state after those that were read is kept in `out`, and `reconstruct` raises it, too.
    The same call goes on from there.
    """
