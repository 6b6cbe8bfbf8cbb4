"""A folder with trajectories of all formats, and one with settings and a plan, for what damages them."""

from __future__ import annotations

from pathlib import Path

from scopemap.engine.config import Config
from scopemap_bench.plan import shipped_plans
from tests.support.foreign_layouts import (
    colmap_text,
    log_text,
    moving_camera,
    oneslam_text,
    scared_documents,
    splatam_arrays,
    write_files,
    write_splatam,
    write_tar,
)
from tests.support.sample_trajectories import as_trajectory, write_c3vd, write_run


def write_trajectories(folder: Path) -> None:
    """Write one folder or file for each format; the folders' names end in the kind that reads them."""
    poses = moving_camera(8)
    numbers = list(range(8))
    folder.mkdir()
    write_run(folder / "run", as_trajectory(poses, lost=(3,)))
    write_c3vd(folder / "c3vd", poses)
    write_files(folder / "scared", scared_documents(poses, numbers))
    write_tar(folder / "frame_data.tar.gz", scared_documents(poses, numbers))
    write_splatam(folder / "splatam", splatam_arrays(poses), "train_or_test='all', start=0, stride=1")
    kitti = "".join(" ".join(map(str, pose[:3].ravel())) + "\n" for pose in poses)
    log = log_text(poses)
    colmap = colmap_text(poses, [f"{n:04d}.png" for n in numbers], ["1 2 3"] * 8)
    texts = {"kitti.txt": kitti, "oneslam.txt": oneslam_text(poses, numbers), "images.txt": colmap, "open3d.log": log}
    write_files(folder, texts)


def write_settings(folder: Path) -> None:
    """Write the settings of two presets, and a plan that comes with the package."""
    import scopemap_bench

    plan = Path(scopemap_bench.__file__).parent / "plans" / f"{shipped_plans()[0]}.toml"
    plain = 'preset = "realtime"\n[tracking]\nkeyframe_every = 4\n[fusion]\nvoxel_mm = 0.5\n'
    texts = {"default.toml": Config().toml(), "some.toml": plain, "plan.toml": plan.read_text(encoding="utf-8")}
    write_files(folder, texts)
