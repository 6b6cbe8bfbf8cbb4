"""Which figures stand in which table: columns as data.

Keys are those of the reports of `evaluation` as the runs keep them. A figure that a run has not is an empty cell.
"""

from __future__ import annotations

from dataclasses import dataclass

from scopemap.benchmark.layout import BOLD, SEEDS, Figure

TIMED = (
    Figure("timing", "ms_per_frame", "time per frame", "ms", 0),
    Figure("timing", "track_ms_per_frame", "tracking per frame", "ms", 1),
    Figure("timing", "peak_memory_mb", "peak memory", "MB", 0),
)


_ALIGNED = ("alignment", "poses", "align")


@dataclass(frozen=True)
class Section:
    """A table of one row per sequence and method.

    Attributes
    ----------
    name, title, caption : of the table. group : of the figures; without it in any run there is no table.
    figures : its columns. word : head, group and key of a word that says how the figures were reached, if there is one:
        rows compete where it is the same.
    """

    name: str
    title: str
    caption: str
    group: str
    figures: tuple[Figure, ...]
    word: tuple[str, str, str] = ("", "", "")


OVERVIEW = Section(
    "overview",
    "Overview",
    "ATE RMSE: position after the stated alignment (with the scale that it found), over the tracked frames. Rotation: "
    "since the first tracked frame, without alignment. RPE: over 10 frames, all pairs, RMSE, after the alignment's "
    "scale. TLR: estimated over true path length, before the alignment. Mesh accuracy: mean distance to the true "
    "surface, the mesh moved by the trajectory's alignment; coverage: share of the observed true surface within 2 mm. "
    f"{SEEDS}; ± is half the range. {BOLD}",
    "poses",
    (
        Figure("poses", "scale", "scale", "", 3, ""),
        Figure("poses", "ate_rmse_mm", "ATE RMSE", "mm", seeds=True),
        Figure("poses", "rotation_unaligned_mean_deg", "rotation mean", "deg", 2, seeds=True),
        Figure("poses", "rotation_unaligned_max_deg", "rotation max", "deg", 2, seeds=True),
        Figure("poses", "rpe_10_mm", "RPE 10 frames", "mm", seeds=True),
        Figure("poses", "rpe_10_deg", "RPE 10 frames", "deg", seeds=True),
        Figure("poses", "tlr", "TLR", "", 3, "one", seeds=True),
        Figure("surface", "accuracy_mean_mm", "mesh accuracy", "mm", 2, seeds=True),
        Figure("surface", "coverage_2mm", "mesh coverage", "%", 1, "higher", factor=100.0, seeds=True),
        *TIMED,
    ),
    word=_ALIGNED,
)

TRACKING = Section(
    "tracking",
    "Tracking",
    "How long a method holds, and what its errors look like beside the mean. ATE, T and R: after the stated "
    "alignment; T<1 mm and so on: share of frames below a fixed limit; lost frames held: each repeats the last "
    "tracked pose; RPE: RMSE, all pairs, those over 10 mm by the true path; end drift: of the last tracked frame, "
    f"with only the first poses put onto each other and no scale. {SEEDS}. {BOLD}",
    "poses",
    (
        Figure("poses", "frames_until_loss", "frames until loss", "", 0, "higher"),
        Figure("poses", "longest_tracked", "longest tracked", "frames", 0, "higher"),
        Figure("poses", "ate_hold_rmse_mm", "ATE RMSE, lost frames held", "mm"),
        Figure("poses", "ate_median_mm", "ATE median", "mm"),
        Figure("poses", "ate_max_mm", "ATE max", "mm"),
        *(Figure("poses", f"ate_below_{mm}_mm_percent", f"T<{mm} mm", "%", 1, "higher") for mm in (1, 2, 5)),
        *(Figure("poses", f"rotation_below_{deg}_deg_percent", f"R<{deg} deg", "%", 1, "higher") for deg in (1, 2, 5)),
        Figure("poses", "rpe_1_mm", "RPE 1 frame", "mm"),
        Figure("poses", "rpe_1_deg", "RPE 1 frame", "deg"),
        Figure("poses", "rpe_10mm_path_mm", "RPE 10 mm path", "mm"),
        Figure("poses", "rpe_10mm_path_deg", "RPE 10 mm path", "deg"),
        Figure("paper", "t_fin_origin_mm", "end drift", "mm"),
        Figure("paper", "r_fin_origin_deg", "end drift", "deg"),
    ),
    word=_ALIGNED,
)


def _orb(of: str, title: str) -> tuple[Figure, ...]:
    parts = ("mean", "median", "std")
    return tuple(Figure("consistency", f"orb_{of}.{part}_mm", f"ORB {title} {part}", "mm") for part in parts)


CONSISTENCY = Section(
    "consistency",
    "Consistency in time",
    "ORB: distance between the two ends of matched points of consecutive frames, in the world by the true and by "
    "the estimated poses, and in the camera without poses, which holds the camera's motion, too. Consecutive "
    "difference: of depth at the same pixel. TAE: mean relative difference after reprojection by these poses. OPW "
    "and rTC: along the flow, the same for all methods, difference and share within 1 %. Scale jitter: of the "
    "factor from estimated to true depth, standard deviation and mean step of its logarithm. All mm after the "
    f"scale. Steady depth need not be right: constant depth is perfect in all that has no poses. {SEEDS}. {BOLD}",
    "consistency",
    (
        Figure("consistency", "scale", "scale", "", 3, ""),
        *_orb("reference", "world, true poses,"),
        *_orb("estimated", "world, own poses,"),
        *_orb("camera", "camera"),
        Figure("consistency", "same_pixel.mean_mm", "consecutive difference", "mm"),
        Figure("consistency", "tae_reference.percent", "TAE, true poses", "%"),
        Figure("consistency", "tae_estimated.percent", "TAE, own poses", "%"),
        Figure("consistency", "opw.mean_mm", "OPW", "mm"),
        Figure("consistency", "opw.relative", "OPW relative", "%", factor=100.0),
        Figure("consistency", "opw.rtc", "rTC", "", 3, "higher"),
        Figure("consistency", "jitter.log_std", "scale jitter std", "", 4),
        Figure("consistency", "jitter.log_step", "scale jitter step", "", 4),
    ),
    word=("flow", "consistency", "flow"),
)

DEPTH = Section(
    "depth",
    "Depth",
    "Mean over images of each image's errors, after the stated scaling of the prediction; any but none hides a wrong "
    "scale. Coverage: share of the true depth that was compared. Scale jitter: of the factor from an unscaled image to "
    f"the truth, standard deviation and mean step of its logarithm. {SEEDS}. {BOLD}",
    "depth",
    (
        Figure("depth", "scale", "scale", "", 3, ""),
        Figure("depth", "abs_rel", "AbsRel"),
        Figure("depth", "sq_rel_mm", "SqRel", "mm"),
        Figure("depth", "rmse_mm", "RMSE", "mm"),
        Figure("depth", "rmse_log", "RMSElog"),
        Figure("depth", "mae_mm", "MAE", "mm"),
        Figure("depth", "delta_1", "delta<1.25", "", 3, "higher"),
        Figure("depth", "delta_2", "delta<1.25^2", "", 3, "higher"),
        Figure("depth", "delta_3", "delta<1.25^3", "", 3, "higher"),
        Figure("depth", "coverage", "coverage", "%", 1, "higher", factor=100.0),
        Figure("depth", "jitter.log_std", "scale jitter std", "", 4),
        Figure("depth", "jitter.log_step", "scale jitter step", "", 4),
    ),
    word=("scaling", "depth", "scaling"),
)

SURFACE = Section(
    "surface",
    "Surface",
    "Mesh moved by the trajectory's alignment; after a refinement by ICP is a figure of its own. Accuracy: from the "
    "mesh to the true surface; completeness and recall: from the observed part of the true surface (its share is "
    "given; empty: from the whole) to the mesh; Chamfer: the mean of both. Coverage: share of the observed true "
    f"surface within 2 mm. {SEEDS}. {BOLD}",
    "surface",
    (
        Figure("surface", "accuracy_mean_mm", "accuracy mean", "mm"),
        Figure("surface", "accuracy_median_mm", "accuracy median", "mm"),
        Figure("surface", "accuracy_icp_mean_mm", "accuracy mean after ICP", "mm"),
        Figure("surface", "completeness_mean_mm", "completeness mean", "mm"),
        Figure("surface", "chamfer_mm", "Chamfer", "mm"),
        *(Figure("surface", f"precision_{mm}mm", f"precision {mm} mm", "", 3, "higher") for mm in (1, 2, 5)),
        *(Figure("surface", f"recall_{mm}mm", f"recall {mm} mm", "", 3, "higher") for mm in (1, 2, 5)),
        *(Figure("surface", f"f_{mm}mm", f"F {mm} mm", "", 3, "higher") for mm in (1, 2, 5)),
        Figure("surface", "normal_consistency", "normal consistency", "", 3, "higher"),
        Figure("surface", "coverage_2mm", "coverage 2 mm", "%", 1, "higher", factor=100.0),
        Figure("surface", "observed_share", "observed", "%", 1, "", factor=100.0),
    ),
    word=_ALIGNED,
)

SECTIONS = (TRACKING, CONSISTENCY, DEPTH, SURFACE)
OWN_GROUPS = frozenset({"poses", "paper"} | {section.group for section in SECTIONS})
"""Groups with tables of their own; any other is a named protocol's."""
