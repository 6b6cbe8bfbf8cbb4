"""A bag of poses and images: MCAP with Foxglove's messages in JSON, so no ROS is needed to write or to read it.

Sources: mcap.dev/spec; docs.foxglove.dev, message schemas CompressedImage, CameraCalibration, FrameTransform.
"""

from __future__ import annotations

import json
from base64 import b64encode
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import SettingsError
from scopemap.input.trajectory.trajectory import MM_PER_UNIT
from scopemap.result.result import Result
from scopemap.runner.reread_frames import tracked_frames

_NS_PER_S = 10**9
_WORLD = "world"
_CAMERA = "camera"
_JPEG_QUALITY = 95

_NUMBER: dict[str, Any] = {"type": "number"}
_WORD: dict[str, Any] = {"type": "string"}
_NUMBERS: dict[str, Any] = {"type": "array", "items": _NUMBER}


def _object(properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_TIME = _object({"sec": {"type": "integer"}, "nsec": {"type": "integer"}})
_XYZ = {"x": _NUMBER, "y": _NUMBER, "z": _NUMBER}
_IMAGE = {"frame_id": _WORD, "data": {"type": "string", "contentEncoding": "base64"}, "format": _WORD}
_MATRICES = dict.fromkeys("DKRP", _NUMBERS)
_CALIBRATION = {"frame_id": _WORD, "width": _NUMBER, "height": _NUMBER, "distortion_model": _WORD} | _MATRICES
_TRANSFORM = {"parent_frame_id": _WORD, "child_frame_id": _WORD, "translation": _object(_XYZ)}
_SCHEMAS = {
    "CompressedImage": _object({"timestamp": _TIME} | _IMAGE),
    "CameraCalibration": _object({"timestamp": _TIME} | _CALIBRATION),
    "FrameTransform": _object({"timestamp": _TIME} | _TRANSFORM | {"rotation": _object(_XYZ | {"w": _NUMBER})}),
}
_TOPICS = {"/image": "CompressedImage", "/calibration": "CameraCalibration", "/tf": "FrameTransform"}


def write_mcap(run: Result, file: Path) -> None:
    """Write the tracked frames with their camera and their poses (`/tf`: the camera in the world), lengths in m.

    Raises `SettingsError` where the package mcap is not installed.
    """
    try:
        from mcap.writer import Writer
    except ModuleNotFoundError:
        raise SettingsError("writing a bag needs mcap: pip install -e '.[mcap]'") from None
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="", library="scopemap")
        channels = {}
        for topic, name in _TOPICS.items():
            schema = writer.register_schema(f"foxglove.{name}", "jsonschema", json.dumps(_SCHEMAS[name]).encode())
            channels[topic] = writer.register_channel(topic, "json", schema)
        writer.add_metadata("scopemap", {"unit": "m", "scale": run.scale})
        path = run.tracked.trajectory
        for number, (frame, time_s, pose) in enumerate(
            zip(tracked_frames(run), path.times_s, path.T_world_camera, strict=True)
        ):
            time_ns = round(time_s * _NS_PER_S)
            stamp = {"timestamp": {"sec": time_ns // _NS_PER_S, "nsec": time_ns % _NS_PER_S}}
            messages = {"/image": _image(frame.rgb), "/calibration": _calibration(run.camera)}
            messages["/tf"] = _transform(pose)
            for topic, message in messages.items():
                data = json.dumps(stamp | message).encode()
                writer.add_message(channels[topic], time_ns, data, time_ns, sequence=number)
        writer.finish()


def _image(rgb: np.ndarray) -> dict[str, Any]:
    jpeg = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
    return {"frame_id": _CAMERA, "data": b64encode(jpeg.tobytes()).decode(), "format": "jpeg"}


def _calibration(camera: PinholeCamera) -> dict[str, Any]:
    K = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    P = [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0]
    size = {"width": camera.width, "height": camera.height}
    shape = {"distortion_model": "plumb_bob", "D": [0.0] * 5, "K": K, "R": np.eye(3).ravel().tolist(), "P": P}
    return {"frame_id": _CAMERA} | size | shape


def _transform(T_world_camera: np.ndarray) -> dict[str, Any]:
    translation = dict(zip("xyz", (T_world_camera[:3, 3] / MM_PER_UNIT["m"]).tolist(), strict=True))
    rotation = dict(zip("xyzw", Rotation.from_matrix(T_world_camera[:3, :3]).as_quat().tolist(), strict=True))
    frames = {"parent_frame_id": _WORLD, "child_frame_id": _CAMERA}
    return frames | {"translation": translation, "rotation": rotation}
