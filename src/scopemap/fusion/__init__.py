"""Volumetric fusion: posed depth frames to one coloured triangle mesh."""

from scopemap.fusion.frame_store import FrameSpool
from scopemap.fusion.mesh import save_mesh
from scopemap.fusion.tsdf_parameters import Sizes, choose_sizes, described, follows_scene, with_sizes
from scopemap.fusion.volume import TsdfVolume

__all__ = ["FrameSpool", "Sizes", "TsdfVolume", "choose_sizes", "described", "follows_scene", "save_mesh", "with_sizes"]
