"""Trajectory formats of other systems."""

import zipfile
from functools import partial

from scopemap.input.trajectory.text import read_kitti
from scopemap.result.trajectories import TrajectoryFormat
from scopemap_bench.trajectories import climb, monogs, scared, splatam, text

FORMATS = (
    TrajectoryFormat(
        "endogslam, splatam", splatam.read_params, (splatam.PARAMS_FILE,), zipfile.is_zipfile, can_be_named=False
    ),
    TrajectoryFormat("7-scenes", text.read_seven_scenes, ("frame-*.pose.txt",)),
    TrajectoryFormat(
        "scared", scared.read_scared, scared.SCARED_FILES, lambda path: scared.find_frame_data(path) is not None
    ),
    TrajectoryFormat("oneslam", text.read_oneslam, text.ONESLAM_FILES, text.is_oneslam),
    TrajectoryFormat("monogs", monogs.read_monogs, monogs.MONOGS_FILES, monogs.is_monogs),
    TrajectoryFormat("bodyslam", read_kitti),
    TrajectoryFormat("endogslam", partial(splatam.read_params, split="train")),
    TrajectoryFormat("splatam", partial(splatam.read_params, split="all")),
    TrajectoryFormat("open3d", text.read_open3d),
    TrajectoryFormat("endo-depth", text.read_endo_depth),
    TrajectoryFormat("open3d, endo-depth", text.refuse_log, (text.LOG_FILE,), text.is_log, can_be_named=False),
    TrajectoryFormat("climb", climb.read_climb, climb.CLIMB_FILES),
)
"""The formats, in the order in which a file is recognised."""
