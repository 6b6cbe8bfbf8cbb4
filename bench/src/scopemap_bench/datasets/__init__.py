"""Readers of research data sets, one file a layout."""

from scopemap_bench.datasets.c3vd import C3vdFolder
from scopemap_bench.datasets.climb import ClimbClip
from scopemap_bench.datasets.d4d import D4dClip
from scopemap_bench.datasets.endomapper import EndoMapperSequence
from scopemap_bench.datasets.endomapper_sim import EndoMapperSimFolder
from scopemap_bench.datasets.endonerf import EndoNerfFolder
from scopemap_bench.datasets.endoslam import EndoSlamFolder
from scopemap_bench.datasets.hamlyn import HamlynFolder, HamlynTrackingFolder
from scopemap_bench.datasets.oneslam import OneSlamFolder
from scopemap_bench.datasets.scared import ScaredCKeyframe, ScaredKeyframe
from scopemap_bench.datasets.servct import ServCtFolder
from scopemap_bench.datasets.sevenscenes import SevenScenesFolder
from scopemap_bench.datasets.simcol import SimColFolder
from scopemap_bench.datasets.stereomis import StereoMisFolder
from scopemap_bench.datasets.stir import StirClip
from scopemap_bench.datasets.tum import TumRgbdFolder

READERS = (
    *(ScaredCKeyframe, ScaredKeyframe, HamlynFolder, HamlynTrackingFolder, EndoSlamFolder, SimColFolder),
    *(EndoMapperSequence, ClimbClip, EndoMapperSimFolder, StereoMisFolder, C3vdFolder, EndoNerfFolder),
    *(ServCtFolder, SevenScenesFolder, TumRgbdFolder, OneSlamFolder, StirClip, D4dClip),
)
"""The readers, in the order in which `recognises` is called."""
