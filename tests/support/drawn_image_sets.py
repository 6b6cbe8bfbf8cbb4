"""Made-up copies of research data sets that come as pictures, which carry their number; truth is known."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import openpyxl
import trimesh

from tests.support.drawn_inputs import SIZE as C3VD_SIZE
from tests.support.drawn_inputs import picture, poses, save

SIZE = (80, 64)


def levels(dtype: type, level: float, last: float, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Depth as stored: 0 = unknown in the first 10 rows, `last` in the last 10, `level` between."""
    stored = np.full((size[1], size[0]), level, dtype)
    stored[:10], stored[-10:] = 0, last
    return stored


def write_image(file: Path, values: np.ndarray) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(file), values)


def write_picture(file: Path, number: int, size: tuple[int, int] = SIZE) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    save(file, picture(number % 40, size))


def replace_line(file: Path, number: int, line: str) -> None:
    lines = file.read_text().splitlines()
    lines[number] = line
    file.write_text("\n".join(lines) + "\n")


# ---- C3VD in folders


def _write_c3vd(folder: Path, images: str, name: str, depth_name: str, depth: np.ndarray) -> Path:
    for number in range(11):
        write_picture(folder / images / name.format(number), number, C3VD_SIZE)
        write_image(folder / "depth" / depth_name.format(number), depth)
    lines = (",".join(f"{x:.9g}" for x in T.T.ravel()) for T in poses(11))
    (folder / "pose.txt").write_text("\n".join(lines) + "\n")
    return folder


def write_endogslam(folder: Path, name: str = "{:04d}_color.png") -> Path:
    depth_name = name.replace("_color.png", "_depth.tiff")
    return _write_c3vd(folder, "color", name, depth_name, levels(np.uint8, 102, 255, C3VD_SIZE))


def write_v2(folder: Path) -> Path:
    return _write_c3vd(folder, "rgb", "{:04d}.png", "{:04d}_depth.tiff", levels(np.uint16, 16384, 65535, C3VD_SIZE))


# ---- Hamlyn

HAMLYN_K = np.array([[70.0, 0.0, 41.0], [0.0, 71.0, 30.5], [0.0, 0.0, 1.0]])


def write_images(folder: Path, numbers: list[int], images: str = "image01", depths: str = "depth01") -> Path:
    for number in numbers:
        write_picture(folder / images / f"{number:010d}.jpg", number)
        write_image(folder / depths / f"{number:010d}.png", levels(np.uint16, 50, 301))
    return folder


def write_rectified(root: Path, name: str = "rectified01") -> Path:
    folder = write_images(root / name, [3, 4, 10])
    write_images(folder, [3, 4, 10], "image02", "depth02")
    (root / "calibration" / name).mkdir(parents=True)
    np.savetxt(root / "calibration" / name / "intrinsics.txt", HAMLYN_K)
    return folder


def write_tracking(folder: Path) -> Path:
    write_images(folder, [0, 1, 2], "color", "depth")
    (folder / "intrinsics.txt").write_text("60 0 40 0 60 32 0 0 1\n")
    return folder


# ---- EndoNeRF

FOCAL_PX = 71.25
SCENE_NUMBERS = [0, 1, 2, 9, 10]


def llff(poses: np.ndarray, height: float = 64, width: float = 80, focal_px: float = FOCAL_PX) -> np.ndarray:
    """Rows of LLFF: 3x5 with height, width, focal length as its last column, then near and far."""
    motions = [np.hstack([T[:3, :4], [[height], [width], [focal_px]]]).ravel() for T in poses]
    return np.array([np.append(motion, [0, 105]) for motion in motions])


def at_rest(count: int = len(SCENE_NUMBERS)) -> np.ndarray:
    return np.tile(np.eye(4), (count, 1, 1))


def write_endonerf(folder: Path, rows: np.ndarray | None = None, name: str = "poses_bounds.npy") -> Path:
    """Depth of 8 bit for even numbers, of 16 for odd; masks of the first 10 and 20 rows."""
    for number in SCENE_NUMBERS:
        stem = f"frame-{number}"
        write_picture(folder / "images" / f"{stem}.color.png", number)
        depth = levels(np.uint16, 60 + number, 392) if number % 2 else levels(np.uint8, 60 + number, 255)
        write_image(folder / "depth" / f"{stem}.depth.png", depth)
        for masks, covered in (("gt_masks", 10), ("masks", 20)):
            mask = np.where(np.arange(SIZE[1])[:, None] < covered, 255, 0).astype(np.uint8)
            write_image(folder / masks / f"{stem}.mask.png", np.repeat(mask, SIZE[0], axis=1))
    (folder / "masks" / "left_video.mp4").write_bytes(b"no mask")
    np.save(folder / name, llff(at_rest()) if rows is None else rows)
    return folder


# ---- SERV-CT

P1 = [[90.5, 0, 41.25, 0], [0, 91.0, 30.5, 0], [0, 0, 1, 0]]


def calibration_json(P: list[list[float]]) -> str:
    """P1 and Q as OpenCV's matrices are written to JSON."""
    matrices = {"P1": (3, 4, P), "Q": (4, 4, np.eye(4))}
    return json.dumps({k: {"rows": r, "cols": c, "data": np.ravel(m).tolist()} for k, (r, c, m) in matrices.items()})


def write_experiment(folder: Path, numbers: list[int] | None = None, truth: str = "Ground_truth_CT") -> Path:
    for number in [9, 10, 11] if numbers is None else numbers:
        name = f"{number:03d}.png"
        write_picture(folder / "Left_rectified" / name, number)
        write_picture(folder / "Right_rectified" / name, number + 20)
        (folder / "Rectified_calibration").mkdir(exist_ok=True)
        (folder / "Rectified_calibration" / f"{number:03d}.json").write_text(calibration_json(P1))
        write_image(folder / truth / "DepthL" / name, levels(np.uint16, 256 * (50 + number) + 64, 65535))
        # Yellow lies outside the right picture, red is hidden from it, blue is where the scan holds nothing.
        occlusion = np.full((SIZE[1], SIZE[0], 3), 128, np.uint8)
        occlusion[:, :5], occlusion[:, 5:9], occlusion[:, 60:] = (255, 255, 0), (255, 0, 0), (0, 0, 255)
        (folder / truth / "OcclusionL").mkdir(exist_ok=True)
        save(folder / truth / "OcclusionL" / name, occlusion)
    return folder


# ---- TUM RGB-D

TUM_SIZE = (64, 48)  # a tenth of the data set's
STAMPS = [1305031102.175304 + step for step in (0.0, 0.036, 0.07, 0.1)]
ROOM = "rgbd_dataset_freiburg3_desk"
# A quarter turn about z: x of the camera is y of the world, y of the camera is -x of the world.
TUM_TURN = "0 0 0.70710678 0.70710678"


def write_list(file: Path, rows: list[tuple[float, str]]) -> None:
    lines = ["# images", f"# file: '{file.stem}.bag'", "# timestamp filename", *(f"{t:.6f} {name}" for t, name in rows)]
    file.write_text("\n".join(lines) + "\n")


def write_tum(folder: Path, stamps: list[float] = STAMPS) -> Path:
    """Depth is taken 5 ms after colour, not at all for frame 2; a pose 4 ms before it, x = 0.1 m times its number."""
    colours, depths, lines = [], [], ["# ground truth trajectory", "# timestamp tx ty tz qx qy qz qw"]
    for number, stamp in enumerate(stamps):
        colours.append((stamp, f"rgb/{stamp:.6f}.png"))
        write_picture(folder / colours[-1][1], number, TUM_SIZE)
        lines.append(f"{stamp - 0.004:.4f} {0.1 * number:.4f} 2.0000 -0.5000 {TUM_TURN}")
        if number != 2:
            depths.append((stamp + 0.005, f"depth/{stamp + 0.005:.6f}.png"))
            level = 5000 + 5 * number
            write_image(folder / depths[-1][1], levels(np.uint16, level, level, TUM_SIZE))
    write_list(folder / "rgb.txt", colours)
    write_list(folder / "depth.txt", depths)
    (folder / "groundtruth.txt").write_text("\n".join(lines) + "\n")
    (folder / "accelerometer.txt").write_text("# timestamp ax ay az\n1305031102.1 0 0 9.8\n")
    return folder


# ---- OneSLAM

ONESLAM_NUMBERS = [3, 9, 10, 24]
STATED: dict[str, Any] = {"intrinsics": {"fx": 70.0, "fy": 71, "cx": 41.5, "cy": 30.25}, "FPS": 25}
# A quarter turn about x: y of the camera is z of the world, z of the camera is -y of the world.
ONESLAM_TURN = "0.70710678 0 0 0.70710678"


def write_json(folder: Path, stated: Any) -> None:
    (folder / "calibration.json").write_text(json.dumps(stated))


def write_oneslam(folder: Path, suffix: str = "jpg", header: str = "# frame_index tx ty tz qx qy qz qw") -> Path:
    """The pose's x is the number of the frame, frame 9 has no pose, frame 10 no depth."""
    for number in ONESLAM_NUMBERS:
        write_picture(folder / "images" / f"{number:08d}.{suffix}", number)
        if number != 10:
            write_image(folder / "depths" / f"{number:08d}.png", levels(np.uint16, 40000 + number, 40000 + number))
    lines = [f"{number} {number} -2.5 40 {ONESLAM_TURN}" for number in ONESLAM_NUMBERS if number != 9]
    (folder / "poses_gt.txt").write_text("\n".join([header, *lines]) + "\n")
    write_json(folder, STATED)
    return folder


# ---- rendered by Unity

_H = 0.2
UNITY_ROWS = [
    (0.66, 8.98, -3.13, 0, 0, 0, 1),
    (0.67, 8.99, -3.12, 0, np.sin(_H), 0, np.cos(_H)),  # turned to the right
    (0.68, 9.00, -3.11, np.sin(_H), 0, 0, np.cos(_H)),  # turned down
    (0.69, 9.01, -3.10, 0.1, -0.3, 0.5, np.sqrt(1 - 0.35)),
]
"""Position and quaternion x y z w: x right, y up, z forward, left-handed."""
UNITY_K = np.array([[46.8, 0.0, 53.5], [0.0, 46.7, 54.5], [0.0, 0.0, 1.0]])
UNITY_HEADER, SIM_HEADER = (sign.join(("tX", "tY", "tZ", "rX", "rY", "rZ", "rW", "time(s)")) for sign in ",;")
SHEET_COLUMNS = ["ImageFrame", "Pose_Index", *(f"trans_{a}" for a in "xyz"), *(f"quot_{a}" for a in "xyzw")]
SQUARE, SIM_SIZE = (96, 96), (96, 72)


def unity_rotated(quaternion: tuple[float, ...], vector: np.ndarray) -> np.ndarray:
    """What Unity's `quaternion * vector` gives."""
    q, w = np.array(quaternion[:3]), quaternion[3]
    return vector + 2 * w * np.cross(q, vector) + 2 * np.cross(q, np.cross(q, vector))


def unity_row(number: int, sign: str = ",", first_s: float = 1.0) -> str:
    return sign.join(f"{x:.9g}" for x in UNITY_ROWS[number]) + f"{sign}{first_s + number * 0.0333334:.7f}\n"


def unity_table(rows: tuple[int, ...] = (0, 1, 2, 3), header: str = UNITY_HEADER) -> str:
    return header + "\n" + "".join(unity_row(number, header[2]) for number in rows)


def write_simcol(scene: Path, name: str = "S1", numbers: tuple[int, ...] = (0, 1, 2, 3)) -> Path:
    folder = scene / f"Frames_{name}"
    for number in numbers:
        write_picture(folder / f"FrameBuffer_{number:04d}.png", number, SQUARE)
        write_image(folder / f"Depth_{number:04d}.png", levels(np.uint16, 32640, 65280, SQUARE))
    for file, columns in (("SavedPosition", slice(0, 3)), ("SavedRotationQuaternion", slice(3, 7))):
        lines = (" ".join(f"{x:.12g}" for x in row[columns]) + "\n" for row in UNITY_ROWS)
        (scene / f"{file}_{name}.txt").write_text("".join(lines))
    np.savetxt(scene / "cam.txt", UNITY_K)
    return folder


def write_unity(organ: Path, numbers: tuple[int, ...] = (0, 1, 2, 3), again: bool = False) -> Path:
    """Write a rendered organ of EndoSLAM; `again`: with the repeated folders of the copy on Mendeley."""
    for number in numbers:
        write_picture(organ / ("Frames/Frames" if again else "Frames") / f"image_{number:04d}.png", number, SQUARE)
        depth = np.full((*SQUARE, 4), 7, np.uint8)
        depth[..., 2] = levels(np.uint8, 40, 1, SQUARE)
        depth[10:20, :, 2] = 255
        depths = organ / ("Depths/Pixelwise Depths" if again else "Pixelwise Depths")
        write_image(depths / f"aov_image_{number:04d}.png", depth)
    for folder in (organ / "Poses", organ.parent / "Calibration"):
        folder.mkdir(parents=True, exist_ok=True)
    # The table that is published ends in the middle of a row.
    (organ / "Poses" / "colon_position_rotation.csv").write_text(unity_table() + "0.70,9.02,-3.09,0.1,0.2")
    (organ.parent / "Calibration" / "cam.txt").write_text(",".join(f"{x:g}" for x in UNITY_K.ravel()))
    return organ


def write_xlsx(file: Path, rows: list[list[object]]) -> Path:
    """Write what pandas' `to_excel` does, its unnamed index in column A."""
    file.parent.mkdir(parents=True, exist_ok=True)
    workbook = openpyxl.Workbook()
    for row in rows:
        workbook.worksheets[0].append(row)
    workbook.save(file)
    return file


def robot_row(number: int) -> list[object]:
    """Row of image `number`: 1 mm a frame along x from 0.18 m, turned by 0.4 rad about z."""
    position = [0.18 + number / 1000, -0.2, 0.45]
    return [number - 60, number, number - 59, *position, 0, 0, np.sin(_H), np.cos(_H)]


def write_real(folder: Path, numbers: tuple[int, ...] = (60, 61, 63), rows: tuple[int, ...] = (60, 61, 63)) -> Path:
    for number in numbers:
        write_picture(folder / "Frames" / f"frame_{number:06d}.jpg", number, SQUARE)
    write_xlsx(folder / "Poses" / "poses.xlsx", [[None, *SHEET_COLUMNS], *(robot_row(number) for number in rows)])
    return folder


def write_exr(file: Path, channels: dict[str, np.ndarray], half: bool = False) -> bytes:
    """Write an uncompressed OpenEXR file of lines by its layout; its channels stand in alphabetical order."""
    names = sorted(channels)
    height, width = channels[names[0]].shape
    kind, dtype = (1, "<f2") if half else (2, "<f4")
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    listed = b"".join(f"{n}\0".encode() + struct.pack("<4i", kind, 0, 1, 1) for n in names) + b"\0"
    attributes = (
        *(("channels", "chlist", listed), ("compression", "compression", b"\0")),
        *(("dataWindow", "box2i", window), ("displayWindow", "box2i", window), ("lineOrder", "lineOrder", b"\0")),
        *(("pixelAspectRatio", "float", struct.pack("<f", 1)), ("screenWindowCenter", "v2f", bytes(8))),
        ("screenWindowWidth", "float", struct.pack("<f", 1)),
    )
    content = struct.pack("<2i", 20000630, 2)
    content += b"".join(f"{n}\0{t}\0".encode() + struct.pack("<i", len(v)) + v for n, t, v in attributes) + b"\0"
    lines = [b"".join(channels[name][y].astype(dtype).tobytes() for name in names) for y in range(height)]
    first, each = len(content) + 8 * height, 8 + len(lines[0])
    content += b"".join(struct.pack("<Q", first + y * each) for y in range(height))
    content += b"".join(struct.pack("<2i", y, len(line)) + line for y, line in enumerate(lines))
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content)
    return content


def buffer(size: tuple[int, int] = SIM_SIZE) -> np.ndarray:
    """A depth buffer: unknown (NaN, then beyond 1) in its first rows, then 0.1, and 1 in its last."""
    v = np.full((size[1], size[0]), 0.1, np.float32)
    v[0], v[1], v[2], v[-1] = np.nan, 1.5, 0.0, 1.0
    return v


def write_depth_exr(file: Path, v: np.ndarray) -> None:
    write_exr(file, {"R": v, "G": np.zeros_like(v), "B": np.zeros_like(v), "A": np.ones_like(v)})


def write_sim(folder: Path, first: int = 0) -> Path:
    """Write a simulated sequence of EndoMapper."""
    for number in range(first, 4):
        write_picture(folder / "rgb" / f"image_{number:04d}.png", number, SIM_SIZE)
        write_depth_exr(folder / "depth" / f"aov_image_{number:04d}.exr", buffer())
    (folder / "trajectory.csv").write_text(unity_table(header=SIM_HEADER))
    (folder / "info.txt").write_text("Depth image metric unities: dm\n")
    return folder


# ---- D4D

D4D_P = "[75.5, 0.0, 40.25, 0.0, 0.0, 76.0, 30.5, 0.0, 0.0, 0.0, 1.0, 0.0]"


def d4d_pose(place: float) -> np.ndarray:
    """A pose in metres, a quarter turn about the optical axis."""
    return np.array([[0, -1, 0, 0.001 * place], [1, 0, 0, -0.02], [0, 0, 1, 0.05], [0, 0, 0, 1]])


def write_d4d(root: Path) -> Path:
    """Write a clip of four frames and the points of its session."""
    session = root / "specimen_1" / "2025_03_06-16_49_40"
    folder = session / "clips" / "Clip_1"
    (folder / "stereo_depth").mkdir(parents=True)
    for number in range(4):
        write_picture(folder / "left_images_rect" / f"{number:06d}.png", number)
        np.save(folder / "stereo_depth" / f"{number:06d}.npy", levels(np.float32, 0.06 + 0.001 * number, 0.08))
    for end, place in (("start", 0), ("end", 3)):
        T = d4d_pose(place)
        np.savetxt(folder / f"curated_camera_pose_{end}.txt", T)
        (session / "pointcloud").mkdir(exist_ok=True)
        x, y = (0.001 * side.ravel() for side in np.meshgrid(np.arange(-40, 41), np.arange(-40, 41)))
        plane = np.column_stack([x, y, np.full(x.shape, 0.1 + 0.001 * place)]) @ T[:3, :3].T + T[:3, 3]
        trimesh.PointCloud(np.vstack([plane, [[np.nan] * 3]])).export(session / "pointcloud" / f"{end}.ply")
    (folder / "camera_info").mkdir()
    camera = f"image_width: 80\nimage_height: 64\nprojection_matrix:\n  rows: 3\n  cols: 4\n  data: {D4D_P}\n"
    (folder / "camera_info" / "left_rect.yaml").write_text(camera)
    named = {f"{end}_geometry": f"pointcloud/{end}.ply" for end in ("start", "end")}
    (session / "clips.json").write_text(json.dumps({"clips": [{"name": "Clip_2"}, {"name": "Clip_1"} | named]}))
    return folder
