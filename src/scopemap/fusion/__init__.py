"""Volumetric fusion: posed depth frames to one coloured triangle mesh."""

from scopemap.fusion.mesh import save_mesh
from scopemap.fusion.spool import FrameSpool
from scopemap.fusion.volume import TsdfVolume

__all__ = ["FrameSpool", "TsdfVolume", "save_mesh"]
