"""Synthetic endoscopy with exact truth: scenes, camera paths, rendering, and folders in the C3VD layout."""

from scopemap.phantom.render import Phantom, build_scene, light, prepare, render_frame, render_surface
from scopemap.phantom.spec import Event, PhantomSpec, parse_events
from scopemap.phantom.truth_mesh import SeenVoxels, TriangleMesh, surface_mesh
from scopemap.phantom.writer import encode_depth, write_phantom

__all__ = [
    "Event",
    "Phantom",
    "PhantomSpec",
    "SeenVoxels",
    "TriangleMesh",
    "build_scene",
    "encode_depth",
    "light",
    "parse_events",
    "prepare",
    "render_frame",
    "render_surface",
    "surface_mesh",
    "write_phantom",
]
