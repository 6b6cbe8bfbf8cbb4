"""The surface as PLY, OBJ, STL and GLB, and surface and path for 3D Slicer.

3D Slicer reads the axes of a mesh from `SPACE=LPS` or `SPACE=RAS` in a PLY's or OBJ's comment or an STL's header, and
takes LPS without it (Libs/MRML/Core/vtkMRMLModelStorageNode.cxx); a path is a markups file, markups-schema-v1.0.3.json.

One camera does not know how the patient lies. LPS here is the world's own x, y, z: right as for a patient on the back,
seen from the feet by an upright camera that looks towards the head (x to the left, y to the back, z to the head).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh

from scopemap.apps.export.slicer_markups import markup, write_markups
from scopemap.engine.errors import InputError
from scopemap.engine.fusion.mesh_files import ply_bytes, save_mesh, texture_jpeg
from scopemap.engine.geometry.rendering import vertex_colours
from scopemap.input.trajectory.trajectory import MM_PER_UNIT, Unit
from scopemap.report.reference_scale import in_mm
from scopemap.result.result import Result

Axes = Literal["lps", "ras", "opencv", "gltf"]
# World to the axes of a file; all are rotations, so triangles keep their front.
_R_FILE_WORLD = {
    "lps": np.diag([1.0, 1.0, 1.0]),
    "ras": np.diag([-1.0, -1.0, 1.0]),
    "opencv": np.diag([1.0, 1.0, 1.0]),
    "gltf": np.diag([1.0, -1.0, -1.0]),
}
_AXES_IN_WORDS = {
    "lps": "SPACE=LPS",
    "ras": "SPACE=RAS",
    "opencv": "axes: OpenCV (x right, y down, z forward)",
    "gltf": "axes: glTF (x right, y up, z backward)",
}
_STL_HEADER_BYTES = 80


def write_surface(run: Result, file: Path, unit: Unit, axes: Axes) -> None:
    """Write the mesh as `file`, whose name ends in .ply, .obj or .stl; the last has no colours and no space for much.

    Where the run's GLB has a texture the OBJ has it, too, by an .mtl and a .jpg of its name beside it. Raises
    `InputError` where the run has no surface.
    """
    ending = file.suffix.lower()
    if ending == ".stl":
        file.write_bytes(stl_bytes(run, unit, axes))
        return
    mesh, about = _surface_of(run, unit, axes), _about(run, unit, axes)
    if ending == ".ply":
        file.write_bytes(ply_bytes(mesh, about))
    elif run.textured is not None:
        _write_textured_obj(_turned(run.textured, unit, axes), file, about)
    else:
        text = trimesh.exchange.obj.export_obj(mesh, header=None)
        file.write_text("".join(f"# {line}\n" for line in about) + text, encoding="utf-8")


def _write_textured_obj(textured: trimesh.Trimesh, file: Path, about: list[str]) -> None:
    """Write a mesh with a texture as OBJ, with the material and the picture beside it."""
    material, picture = file.with_suffix(".mtl"), file.with_suffix(".jpg")
    picture.write_bytes(texture_jpeg(textured))
    # Without ambient and specular light; Wavefront, "MTL material format", 1995.
    lines = ["newmtl texture", "Ka 0 0 0", "Kd 1 1 1", "Ks 0 0 0", "illum 1", f"map_Kd {picture.name}"]
    material.write_text("\n".join(lines) + "\n", encoding="utf-8")
    text = trimesh.exchange.obj.export_obj(textured, header=None, include_texture=False, include_normals=True)
    uv: Any = textured.visual
    head = [*(f"# {line}" for line in about), f"mtllib {material.name}", "usemtl texture"]
    vertices = [line for line in text.splitlines() if line.startswith(("v ", "vn "))]
    places = [f"vt {u:.6f} {v:.6f}" for u, v in uv.uv.tolist()]
    corners = (textured.faces + 1).tolist()
    faces = ["f " + " ".join(f"{corner}/{corner}/{corner}" for corner in face) for face in corners]
    file.write_text("\n".join([*head, *vertices, *places, *faces]) + "\n", encoding="utf-8")


def write_surfaces(run: Result, folder: Path, unit: Unit, axes: Axes) -> None:
    """Write the surface that fits each tracked frame, as `000000.ply`, ..., named by the frame's number.

    The files of the segment that has a reference are in mm by it, and each file says what its scale is. Raises
    `InputError` where the run has no surface, or one that fits all frames.
    """
    if len(run.segments) < 2:
        raise InputError(f"{run.path}: one surface fits all frames; export it as ply")
    folder.mkdir(parents=True, exist_ok=True)
    as_kept = Result(run.folder)
    by_segment = {one.segment: in_mm(as_kept, one.segment) for one in run.segments}
    for index in run.tracked.trajectory.indices.tolist():
        shown = by_segment[run.segment_at(index)]
        content = ply_bytes(_converted(shown.mesh, unit, axes), _about(shown, unit, axes))
        (folder / f"{index:06d}.ply").write_bytes(content)


def stl_bytes(run: Result, unit: Unit, axes: Axes) -> bytes:
    """Return the mesh as binary STL. Raises `InputError` where the run has no surface."""
    content = trimesh.exchange.stl.export_stl(_surface_of(run, unit, axes))
    # Not all of the scale's words fit; a binary STL must not begin with "solid".
    header = "; ".join(_about(run, unit, axes)).encode("ascii", "replace")[:_STL_HEADER_BYTES]
    return header.ljust(_STL_HEADER_BYTES) + content[_STL_HEADER_BYTES:]


def write_glb(run: Result, file: Path) -> None:
    """Write the mesh as GLB: metres and y up, which glTF prescribes."""
    save_mesh(_surface_of(run, "mm", "opencv"), glb_file=file, comment=run.scale, textured=run.textured)


def write_slicer(run: Result, folder: Path) -> None:
    """Write `surface.ply` and the camera's path as the open curve `path.mrk.json`, both LPS and mm."""
    folder.mkdir(parents=True, exist_ok=True)
    write_surface(run, folder / "surface.ply", "mm", "lps")
    positions = run.tracked.trajectory.positions_mm @ _R_FILE_WORLD["lps"].T
    points = {f"frame {index}": at for index, at in zip(run.tracked.trajectory.indices, positions, strict=True)}
    write_markups([markup("Curve", "camera path", points, run.scale)], folder / "path.mrk.json")


def vertex_attributes(mesh: trimesh.Trimesh, unit: Unit) -> dict[str, Any]:
    """Return numbers of each vertex, (V,) float32: confidence, moving, sigma_mm, whose name has the unit."""
    known: dict[str, Any] = {name: np.asarray(x, np.float32) for name, x in mesh.vertex_attributes.items()}
    if "sigma_mm" in known:
        known[f"sigma_{unit}"] = known.pop("sigma_mm") / np.float32(MM_PER_UNIT[unit])
    return known


def _about(run: Result, unit: Unit, axes: Axes) -> list[str]:
    return [_AXES_IN_WORDS[axes], f"unit: {unit}", run.scale]


def _surface_of(run: Result, unit: Unit, axes: Axes) -> trimesh.Trimesh:
    if not len(run.mesh.faces):
        raise InputError(f"{run.path}: the run has no surface to export")
    return _converted(run.mesh, unit, axes)


def _turned(textured: trimesh.Trimesh, unit: Unit, axes: Axes) -> trimesh.Trimesh:
    """Return a surface with a texture, world mm, in another unit and with other axes."""
    R = _R_FILE_WORLD[axes]
    vertices, normals = textured.vertices @ R.T / MM_PER_UNIT[unit], textured.vertex_normals @ R.T
    return trimesh.Trimesh(vertices, textured.faces, vertex_normals=normals, visual=textured.visual, process=False)


def _converted(mesh: trimesh.Trimesh, unit: Unit, axes: Axes) -> trimesh.Trimesh:
    """Return a surface, world mm, in another unit and with other axes."""
    vertices = mesh.vertices @ _R_FILE_WORLD[axes].T / MM_PER_UNIT[unit]
    colours, attributes = vertex_colours(mesh), vertex_attributes(mesh, unit)
    return trimesh.Trimesh(vertices, mesh.faces, vertex_colors=colours, vertex_attributes=attributes, process=False)
