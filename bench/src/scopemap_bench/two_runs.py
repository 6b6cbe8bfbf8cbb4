"""Two runs against each other, without a truth: what both see, in one frame of reference.

What they differ by is not known of either; what they agree on may still be wrong in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from scopemap.engine.errors import AlignmentError, InputError, reporting
from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.rendering import Rendering, render_mesh, vertex_colours
from scopemap.evaluation.poses import rotation_errors_rad, translation_errors_mm
from scopemap.input.trajectory.trajectory import path_length_mm
from scopemap.report.depth_figures import colour_share
from scopemap.report.mesh_figures import draw_trajectories
from scopemap.report.page import PAGE, write_comparison
from scopemap.report.sheet import picture_grid
from scopemap.result.result import Result

_NO_UNIT = "units of the second run"
_LEAST_COMMON = 3
_MOST_VIEWS = 16
_DRAWN = 3
_WITHIN_PERCENT = (2, 5)
_DRAWN_PERCENT = 10
_CELL_PX = (320, 256)


@dataclass(frozen=True)
class _RenderedPair:
    """A frame of the second run with both surfaces, and their difference over the distance, (H, W), NaN: not both."""

    index: int
    first: Rendering
    second: Rendering
    difference: np.ndarray


@dataclass(frozen=True)
class TwoRuns:
    """What two runs differ by. first, second : positions (N, 3) at the common frames, in the unit of the second."""

    figures: dict[str, Any]
    first: np.ndarray
    second: np.ndarray
    views: list[_RenderedPair]

    def lines(self) -> list[str]:
        """Return the figures in words."""
        path, surface, unit = self.figures["path"], self.figures["surface"], self.figures["unit"]
        found = [
            f"{self.figures['common_frames']} common frames; the first run was moved onto the second by Sim(3), scale "
            f"{self.figures['scale']:.3f}",
            f"path: {path['position_rmse']:.2f} {unit} apart (RMS, {path['position_rmse_percent']:.1f} % of length), "
            f"{path['position_max']:.2f} {unit} at most; rotation {path['rotation_mean_deg']:.2f} deg, at most "
            f"{path['rotation_max_deg']:.2f} deg",
        ]
        if surface:
            within = ", ".join(f"{surface[f'within_{p}_percent']:.0f} % within {p} %" for p in _WITHIN_PERCENT)
            found.append(
                f"surface: of what both show in {surface['views']} frames ({surface['both_percent']:.0f} % of what "
                f"either shows) {within} of the distance; median difference {surface['median_percent']:.1f} %"
            )
        else:
            found.append("surface: none in one of them, or nothing that both show")
        scales = [f"{name}: {words}" for name, words in self.figures["scales"].items()]
        return [
            *found,
            *scales,
            "Where they differ, neither is confirmed: which of the two is right, or whether any is, this does not say.",
        ]

    def save(self, out: Path) -> list[Path]:
        """Write difference.png and path.png, the page of both runs, and return the files."""
        with reporting(f"cannot write to {out}"):
            out.mkdir(parents=True, exist_ok=True)
            names = list(self.figures["scales"])
            unit = self.figures["unit"]
            draw_trajectories(self.first, self.second, out / "path.png", names=(names[0], names[1]), unit=unit)
            files = [out / "path.png"]
            worst = sorted(self.views, key=lambda view: -float(np.nanmedian(view.difference)))[:_DRAWN]
            rows = [
                {
                    f"{names[0]}, frame {v.index}": v.first.rgb,
                    names[1]: v.second.rgb,
                    "difference": colour_share(v.difference * 100 / _DRAWN_PERCENT),
                }
                for v in worst
            ]
            if rows:
                head = f"difference over the distance: blue 0 .. red {_DRAWN_PERCENT} %, black: not in both"
                picture_grid(rows, _CELL_PX, head).save(out / "difference.png")
                files.append(out / "difference.png")
        return files


def compare_two(
    first: Path, second: Path, names: tuple[str, str], out: Path | None = None
) -> tuple[TwoRuns, list[Path]]:
    """Return what two finished runs of one video differ by at the frames that both have, and the files in `out`.

    The first is moved by the Sim(3) of these frames: rotation by their directions, which a straight path determines,
    too, scale and place by their positions. Raises `InputError` where they are no finished runs, `AlignmentError` where
    they have fewer than three frames in common.
    """
    runs = Result(first).checked(), Result(second).checked()
    tables = [run.frames.only(run.frames.tracked) for run in runs]
    common, *rows = np.intersect1d(tables[0]["index"], tables[1]["index"], return_indices=True)
    if len(common) < _LEAST_COMMON:
        raise AlignmentError(
            f"comparing {first} with {second}: they have {len(common)} tracked frames in common, 3 needed"
        )
    poses = [table["T_world_camera"][row] for table, row in zip(tables, rows, strict=True)]
    similarity = _similarity(*poses)
    moved = similarity.transform_poses(poses[0])
    off, off_deg = translation_errors_mm(moved, poses[1]), np.degrees(rotation_errors_rad(moved, poses[1]))
    rmse, length = float(np.sqrt(np.mean(off**2))), path_length_mm(poses[1][:, :3, 3])
    path = {"position_rmse": rmse, "position_max": float(off.max())}
    path |= {"position_rmse_percent": 100 * rmse / length if length else float("nan")}
    path |= {"rotation_mean_deg": float(off_deg.mean()), "rotation_max_deg": float(off_deg.max())}
    chosen = np.unique(np.linspace(0, len(common) - 1, min(_MOST_VIEWS, len(common))).astype(int))
    views = _views(runs, similarity, {int(common[n]): poses[1][n] for n in chosen})
    figures = {
        "runs": [str(first), str(second)],
        "common_frames": len(common),
        "scale": similarity.scale,
        "unit": "mm" if runs[1].scale_known else _NO_UNIT,
        "path": path,
        "surface": _surface_figures(views),
        "scales": dict(zip(names, (run.scale for run in runs), strict=True)),
        "same_input": _same_input(*runs),
    }
    found = TwoRuns(figures, moved[:, :3, 3], poses[1][:, :3, 3], views)
    if out is None:
        return found, []
    return found, [*found.save(out), write_comparison([first, second], list(names), out / PAGE)]


def _similarity(first: np.ndarray, second: np.ndarray) -> Similarity:
    """Return what moves the poses (N, 4, 4) of one world to those of another."""
    U, _, Vt = np.linalg.svd(np.einsum("nij,nkj->ik", second[:, :3, :3], first[:, :3, :3]))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    from_mm, to_mm = first[:, :3, 3], second[:, :3, 3]
    spread = (from_mm - from_mm.mean(0)) @ R.T
    moved = float(np.sum(spread**2))
    scale = float(np.sum(spread * (to_mm - to_mm.mean(0)))) / moved if moved else 0.0
    if scale <= 0:
        raise AlignmentError("the paths of the two runs have nothing in common: no Sim(3) brings them together")
    return Similarity(scale, R, to_mm.mean(0) - scale * from_mm.mean(0) @ R.T)


def _views(runs: tuple[Result, Result], similarity: Similarity, poses: dict[int, np.ndarray]) -> list[_RenderedPair]:
    """Return the views of both surfaces from poses in the second run's world; those with nothing in common are not."""
    meshes = [run.mesh for run in runs]
    if not all(len(mesh.faces) for mesh in meshes):
        return []
    moved = trimesh.Trimesh(
        similarity.transform_points(np.asarray(meshes[0].vertices)),
        meshes[0].faces,
        vertex_colors=vertex_colours(meshes[0]),
        process=False,
    )
    found = []
    for index, pose in poses.items():
        first, second = (render_mesh(mesh, runs[1].camera, pose) for mesh in (moved, meshes[1]))
        difference = np.abs(first.depth_mm - second.depth_mm) / second.depth_mm
        if np.isfinite(difference).any():
            found.append(_RenderedPair(index, first, second, difference))
    return found


def _surface_figures(views: list[_RenderedPair]) -> dict[str, float]:
    if not views:
        return {}
    both = np.concatenate([view.difference[np.isfinite(view.difference)] for view in views])
    either = sum(int((np.isfinite(v.first.depth_mm) | np.isfinite(v.second.depth_mm)).sum()) for v in views)
    within = {f"within_{p}_percent": 100 * float(np.mean(both <= p / 100)) for p in _WITHIN_PERCENT}
    return {
        "views": len(views),
        "both_percent": 100 * len(both) / either,
        **within,
        "median_percent": 100 * float(np.median(both)),
    }


def _same_input(first: Result, second: Result) -> bool | None:
    """Return whether both have read the same; None where one does not say."""
    sums = [dict(run.provenance.get("input_content") or {}).get("sha256") for run in (first, second)]
    return None if None in sums else sums[0] == sums[1]


def refuse_run_as_truth(truth: Path) -> None:
    """Raise `InputError` where what is named as the truth is a run."""
    if Result(truth).is_finished:
        raise InputError(
            f"{truth} is a run, which is no truth: `scopemap compare A B` compares two runs with each other"
        )
