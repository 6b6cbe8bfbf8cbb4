"""What a run may keep in memory at once, by `run.memory_mb`: what its buffers, adjustment and surface may hold.

The limit less a base and so much for each pixel and frame (peaks of runs of 160x128 to 640x512 px, rounded up) goes
half to the observations, half and what these leave to the volume with its mesh.
"""

from __future__ import annotations

import ctypes
import gc
from contextlib import suppress
from dataclasses import dataclass

from scopemap.engine.config import Config
from scopemap.engine.errors import InputError, SettingsError
from scopemap.engine.flow.flows import FLOWS
from scopemap.engine.mapping.mapper import MOST_OBSERVATIONS
from scopemap.engine.notices import Notice
from scopemap.input.sequence import Sequence
from scopemap.runner.depth_networks import needs_weights

_MB = 1_000_000
_M_TRIM_THRESHOLD = -1  # of glibc's malloc.h
_M_MMAP_THRESHOLD = -3  # the same
_M_ARENA_MAX = -8  # the same
_ARENAS = 2  # measured on 60 frames of 1080p on two cores: with one for each thread the peak is higher by a tenth
# Up to what size the memory of a freed array is kept for the next one. While frames come: what glibc comes to by
# itself; less takes 3 to 6 % more time, since the system has to clear it.
_KEPT_BYTES = 32 * 2**20
# After the last frame: on 276 frames of cecum_t1_a the peak, that of the texture, is 602 MB; with 4 MiB it is 645,
# without a limit 710.
_KEPT_AT_THE_END_BYTES = 2**20
# Python with its libraries, the embedded network, kernels; with kernels that are compiled.
_BASE_BYTES = 480 * _MB
# Of the working size: in all stages, and for each frame that a stage is ahead of the next; of the input's pictures.
_PIXEL_BYTES = 1_700
_AHEAD_PIXEL_BYTES = 100
_SOURCE_PIXEL_BYTES = 30
_FRAME_BYTES = 5_000
_OBSERVATION_BYTES = 1_100
_BLOCK_BYTES = 45_000
_AHEAD = (2, 1)
_LEAST_OBSERVATIONS = 50_000
_LEAST_BLOCKS = 1_000


@dataclass(frozen=True)
class MemoryPlan:
    """What a run may hold; `limited` : by a limit of memory.

    ahead : frames that each stage is ahead of the next. observations : that are adjusted at once, about. blocks : of
    8^3 voxels in all volumes; None: any number.
    """

    ahead: int = _AHEAD[0]
    observations: int = MOST_OBSERVATIONS
    blocks: int | None = None

    @property
    def notices(self) -> list[Notice]:
        """What was chosen; [] without a limit."""
        if self.blocks is None:
            return []
        values = {"observations": self.observations, "blocks": self.blocks, "ahead": self.ahead}
        return [Notice("memory-limited", values)]


def trim_memory() -> None:
    """Give memory that was freed back to the system, which glibc does too late where large arrays come and go.

    A mesh of trimesh refers to itself: until it is collected it keeps all that was computed from it, 60 MB a submap.
    """
    gc.collect()
    with suppress(OSError, AttributeError, TypeError):  # another C library, or Windows
        ctypes.CDLL(None).malloc_trim(0)


def share_arenas() -> None:
    """Let threads that are started from now on share two of glibc's arenas, each of which keeps what it once held.

    Each stage has a thread: at 1080p this saves a tenth of the peak (60 of 576 MB), and takes no more time.
    """
    with suppress(OSError, AttributeError, TypeError):  # another C library, or Windows
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, _ARENAS)


def keep_freed_arrays(*, at_the_end: bool) -> None:
    """Have glibc keep the memory of freed arrays for the next ones, of large ones only while frames still come."""
    kept = _KEPT_AT_THE_END_BYTES if at_the_end else _KEPT_BYTES
    with suppress(OSError, AttributeError, TypeError):  # another C library, or Windows
        libc = ctypes.CDLL(None)
        libc.mallopt(_M_MMAP_THRESHOLD, kept)
        libc.mallopt(_M_TRIM_THRESHOLD, 2 * kept)


def memory_plan(config: Config, sequence: Sequence) -> MemoryPlan:
    """Return what a run over a sequence may hold; `InputError` for too large pictures, `SettingsError` for networks."""
    memory_mb, networks = config.run.memory_mb, config.networks
    if memory_mb is None:
        return MemoryPlan()
    used = (config.depth.backend, config.depth.anchor, networks.flow, networks.keyframe_flow, networks.perceptual)
    flows = {name for name, flow in FLOWS.items() if flow.needs is not None}
    if unknown := sorted({name for name in used if name in flows or name == "lpips" or needs_weights(name)}):
        raise SettingsError(
            f"--memory (run.memory_mb) cannot be guaranteed with {', '.join(unknown)}: PyTorch's own use is not known"
        )
    camera, source = sequence.camera, sequence.source
    pixels, frames = camera.width * camera.height, sequence.count or 0
    fixed = _BASE_BYTES + _PIXEL_BYTES * pixels + _SOURCE_PIXEL_BYTES * source.width * source.height
    fixed += _FRAME_BYTES * frames
    least = 2 * max(_LEAST_OBSERVATIONS * _OBSERVATION_BYTES, _LEAST_BLOCKS * _BLOCK_BYTES)
    for ahead in _AHEAD:
        left = memory_mb * _MB - fixed - ahead * _AHEAD_PIXEL_BYTES * pixels
        if left >= least:
            observations = min(left // 2 // _OBSERVATION_BYTES, MOST_OBSERVATIONS)
            return MemoryPlan(ahead, observations, (left - observations * _OBSERVATION_BYTES) // _BLOCK_BYTES)
    needed_mb = -(-(fixed + _AHEAD[-1] * _AHEAD_PIXEL_BYTES * pixels + least) // _MB)
    raise InputError(
        f"{memory_mb} MB of memory (--memory) are too few for {sequence.path}: {needed_mb} MB are the least for "
        f"{frames or 'its'} frames of {camera.width}x{camera.height} px; a smaller --size needs less"
    )
