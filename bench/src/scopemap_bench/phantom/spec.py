"""PhantomSpec: every parameter of a phantom; equal specs give equal files."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args, get_type_hints

from pydantic import TypeAdapter, ValidationError

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.errors import SettingsError
from scopemap.input.camera_files.reading import read_calibration

SceneName = Literal["colon", "laparoscopy", "abdominal_wall", "tube"]
RouteName = Literal["wander", "sideways", "withdrawal"]
PolypName = Literal["sessile", "pedunculated", "flat"]
EventName = Literal[
    "black", "blur", "smoke", "veil", "fluid", "instrument", "turn", "contact",
    "push", "rebound", "poke", "peristalsis", "grasp", "cut",
]  # fmt: skip

DEFAULT_FRAMES = 200
OPEN_SCENES = {"laparoscopy": 1.0, "abdominal_wall": 0.3}
"""Scenes of an open cavity, and the share by which their organs rise."""

C3VD_DEPTH_SCALE_MM = 100.0 / 65535


@dataclass(frozen=True)
class Event:
    """What happens from frame `first` to frame `last`, inclusive.

    black, blur, smoke, fluid : of the picture. instrument : one enters, works and leaves. turn : the camera turns by 30
    degrees and stays so, back with the next one; a cut where `first` is `last`. contact : the camera touches the wall
    and goes back. push : the tissue is pushed two ways and stays so. poke : the part on the right of the view alone is,
    by 8 mm, half into the wall and half along it. rebound : a push that is let go after a third of the time, and swings
    back. peristalsis : contractions travel along the view of the first frame. grasp : an instrument enters, holds the
    tissue right of the middle, pulls it by 8 mm, lets go and leaves. cut : there a slit is cut, and gapes from then on.
    veil : smoke that gathers, drifts and clears, before what is far more than before what is near.
    """

    kind: EventName
    first: int
    last: int


@dataclass(frozen=True)
class Polyp:
    """A polyp so wide on the wall, where frame `frame` sees it well.

    sessile : half an ellipsoid. pedunculated : a head on a stalk. flat : a disc 1.5 mm high. Across, each is 0.8 times
    as wide.
    """

    kind: PolypName
    diameter_mm: float
    frame: int


@dataclass(frozen=True)
class PhantomSpec:
    """Parameters of a phantom.

    scene : colon (folded, closed tube), laparoscopy (organs in a cavity), abdominal_wall (the same,
    nearly plane) or tube (straight and featureless).
    frames : None: every pose of `path_file`, or 200. width, height : image size, px. seed : of everything random.
    fov_deg : horizontal field of view of a pinhole, degrees; a `camera_file` has its own, scaled to the image size.
    path_file : camera path to follow (`read_poses`), None: a hand-like path is generated, which is `speed` times faster
    than usual, and with `loop` ends in exactly its first pose.
    route : of a generated path. wander: forward in a lumen, to and fro over a cavity; sideways: by 22 mm, a third of
    the distance to a cavity's floor; withdrawal: 52 mm straight back. These two are as long in any number of frames.
    fold_mm : how far the folds of a colon rise from its wall, at most; behind deep ones more is hidden.
    examination : 0: the first one; another number: the same scene at a later visit, on another path beside the first
    one's, with fluid on other places.
    insufflation : share by which the tissue is wider than its mesh, across the first view.
    deform : whether the tissue breathes; breath_mm, breath_frames: how far and how often. events : see `Event`.
    polyps : see `Polyp`; their true sizes and masks are written, too.
    noise : standard deviation of the sensor's read noise, share of the linear range; 0 also turns shot noise off.
    texture : strength of mottling and vessels, 1 = mild as in C3VD, 0 = uniform albedo. gloss : of wet highlights, 1 =
    clinic.
    auto_exposure : whether every frame has its own exposure, which follows with the time constant exposure_lag_frames.
    shutter : share of the time between two frames during which light is gathered, 0: no motion blur.
    indirect : light that the tissue scatters onto itself, share of the lamp's; it lights far walls too much.
    beam_deg : full angle, degrees, at which the lamp sends half as much as along the view, falling as a Gaussian of the
    angle; None: equally everywhere.
    omentum_mm : how far an omentum, three times as dark as the fat of an open cavity's floor, rises from that floor,
    62 mm away, towards the camera along the lower edge of the view; 0: there is none.
    h264_crf : rate factor, 0 to 51, of the video coding (`shading.VideoCoding`); None: none.
    depth_scale_mm : mm per unit of the depth files; C3VD's by default. fps : frames per second of `camera.yaml`.
    """

    scene: SceneName = "colon"
    frames: int | None = None
    width: int = 320
    height: int = 256
    fov_deg: float = 90.0
    camera_file: Path | None = None
    seed: int = 0
    path_file: Path | None = None
    route: RouteName = "wander"
    fold_mm: float = 6.0
    examination: int = 0
    insufflation: float = 0.0
    deform: bool = False
    loop: bool = False
    speed: int = 1
    events: tuple[Event, ...] = ()
    polyps: tuple[Polyp, ...] = ()
    breath_mm: float = 2.0
    breath_frames: float = 120.0
    noise: float = 0.004
    texture: float = 1.0
    gloss: float = 1.0
    auto_exposure: bool = False
    exposure_lag_frames: float = 0.0
    shutter: float = 0.0
    indirect: float = 0.0
    beam_deg: float | None = None
    omentum_mm: float = 0.0
    h264_crf: int | None = None
    depth_scale_mm: float = C3VD_DEPTH_SCALE_MM
    fps: float = 30.0

    def __post_init__(self) -> None:
        checks = {
            f"scene must be one of {', '.join(get_args(SceneName))}": self.scene in get_args(SceneName),
            "frames must be at least 1": self.frames is None or self.frames >= 1,
            "width and height must be 16 to 4096 px": all(16 <= n <= 4096 for n in (self.width, self.height)),
            "fov_deg must be between 10 and 150": 10 <= self.fov_deg <= 150,
            "seed must not be negative": self.seed >= 0,
            "speed must be at least 1, and needs a generated path": self.speed == 1
            or (self.speed > 1 and self.path_file is None),
            "fold_mm must be between 0 and 10": 0 <= self.fold_mm <= 10,
            "insufflation must be between 0 and 0.1": 0 <= self.insufflation <= 0.1,
            "breath_mm must be between 0 and 4": 0 <= self.breath_mm <= 4,
            "breath_frames and fps must be positive": min(self.breath_frames, self.fps) > 0,
            "noise, texture and gloss must not be negative": min(self.noise, self.texture, self.gloss) >= 0,
            "exposure_lag_frames must not be negative, and needs auto_exposure": self.exposure_lag_frames == 0
            or (self.exposure_lag_frames > 0 and self.auto_exposure),
            "shutter must be between 0 and 1": 0 <= self.shutter <= 1,
            "indirect must be between 0 and 1": 0 <= self.indirect <= 1,
            "beam_deg must be between 5 and 170": self.beam_deg is None or 5 <= self.beam_deg <= 170,
            "omentum_mm must be between 0 and 45, and needs an open cavity": self.omentum_mm == 0
            or (0 < self.omentum_mm <= 45 and self.scene in OPEN_SCENES),
            "h264_crf must be between 0 and 51": self.h264_crf is None or 0 <= self.h264_crf <= 51,
            f"route must be one of {', '.join(get_args(RouteName))}": self.route in get_args(RouteName),
            "only the route wander goes with loop or path_file": self.route == "wander"
            or not (self.loop or self.path_file),
            "depth_scale_mm must be positive": self.depth_scale_mm > 0,
            "a phantom has one cut at most": sum(event.kind == "cut" for event in self.events) <= 1,
            "polyps must be 2 to 25 mm wide, pedunculated ones 14 at most": all(
                2 <= one.diameter_mm <= (14 if one.kind == "pedunculated" else 25) for one in self.polyps
            ),
            "a turn does not go with loop": not (self.loop and any(event.kind == "turn" for event in self.events)),
            "loop needs a generated path of at least 3 frames, not a path file": not self.loop
            or (self.path_file is None and (self.frames is None or self.frames >= 3)),
        }
        for message, fine in checks.items():
            if not fine:
                raise SettingsError(f"impossible phantom: {message}")

    @cached_property
    def camera(self) -> CameraModel:
        """The camera of `camera_file`; else a pinhole with square pixels, its principal point at the image's centre."""
        if self.camera_file is not None:
            calibration = read_calibration(self.camera_file, (self.width, self.height), "scale")
            return calibration.camera
        focal = 0.5 * self.width / math.tan(math.radians(self.fov_deg) / 2)
        return PinholeCamera(focal, focal, (self.width - 1) / 2, (self.height - 1) / 2, self.width, self.height)

    def with_settings(self, settings: dict[str, Any]) -> PhantomSpec:
        """Return a copy with settings given as values or text, such as {"fov_deg": "70"}; raises `SettingsError`."""
        types = {name: kind for name, kind in get_type_hints(type(self)).items() if name not in ("events", "polyps")}
        values = {}
        for name, value in settings.items():
            if name not in types:
                raise SettingsError(f"unknown phantom setting '{name}': choose one of {', '.join(types)}")
            try:
                values[name] = TypeAdapter(types[name]).validate_python(value)
            except ValidationError:
                raise SettingsError(f"phantom setting '{name}': cannot use '{value}' as {types[name]}") from None
        return replace(self, **values)


def parse_events(text: str) -> tuple[Event, ...]:
    """Return the events of a text such as "black:40-49,blur:90-95"; raises `SettingsError`."""
    events, kinds = [], ", ".join(get_args(EventName))
    for part in filter(None, (piece.strip() for piece in text.split(","))):
        match = re.fullmatch(rf"({'|'.join(get_args(EventName))}):(\d+)-(\d+)", part)
        if not match:
            raise SettingsError(f"cannot read the event '{part}': expected KIND:A-B, KIND one of {kinds}")
        kind, first, last = match[1], int(match[2]), int(match[3])
        if last < first:
            raise SettingsError(f"the event '{part}' ends before it begins: write {kind}:{last}-{first}")
        events.append(Event(kind, first, last))  # type: ignore[arg-type]
    return tuple(events)


def parse_polyps(text: str) -> tuple[Polyp, ...]:
    """Return the polyps of a text such as "sessile:8@30,flat:12.5@60"; raises `SettingsError`."""
    polyps, kinds = [], get_args(PolypName)
    for part in filter(None, (piece.strip() for piece in text.split(","))):
        match = re.fullmatch(rf"({'|'.join(kinds)}):(\d+(?:\.\d+)?)@(\d+)", part)
        if not match:
            raise SettingsError(
                f"cannot read the polyp '{part}': expected KIND:MM@FRAME, KIND one of {', '.join(kinds)}"
            )
        polyps.append(Polyp(match[1], float(match[2]), int(match[3])))  # type: ignore[arg-type]
    return tuple(polyps)
