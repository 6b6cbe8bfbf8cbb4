"""Settings of reading and masking."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar, Literal, cast, get_args

from pydantic import BeforeValidator, Field

from scopemap.engine.config.settings import Methods, Settings, StageSettings

Box = tuple[
    Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)], Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]
]
"""Left, top, width and height, px."""

_Layout = Literal["auto", "none", "left-right", "top-bottom"]
_BY_TRUTH = {True: "on", "true": "on", False: "off", "false": "off"}
_Deinterlace = Annotated[
    Literal["auto", "on", "off"],
    BeforeValidator(lambda value: _BY_TRUTH.get(value, value) if isinstance(value, bool | str) else value),
]
_Scope = Literal[
    "", "colonoscope", "gastroscope", "bronchoscope", "laparoscope", "cystoscope", "ureteroscope", "sinus", "capsule"
]


class InputSettings(Settings):
    """How the input is read."""

    camera_fit: str = Field(
        "exact",
        pattern=r"^(exact|scale|crop:\d+,\d+)$",
        description="what a calibration of another size means, exact: refused; scale: the images were resized from its "
        "size; crop:X,Y: they were cut out of it, X px from the left, Y px from the top",
    )
    focal: Literal["auto", "assume", "flow"] = Field(
        "auto",
        description="focal length of an unknown camera, assume: by the assumed field of view; flow: from the motion "
        "of the first frames; auto: Depth Pro's where it is in use, else flow, or a trial of "
        "lenses, where one of these tells it",
    )
    scope: _Scope = Field(
        "",
        description="kind of endoscope of an unknown camera, whose typical lens is expected: "
        "colonoscope, gastroscope, bronchoscope, laparoscope, cystoscope, ureteroscope, sinus, capsule",
    )
    stereo: str = Field(
        "auto",
        pattern=r"^(auto|none|left-right|top-bottom|use(:.+)?)$",
        description="two views in one image (auto, which detects them, none, left-right, top-bottom), of which the "
        "left or upper is used; use: depth is measured from both, with a calibration of the pair; "
        "use:left-right, use:top-bottom, use:FILE (a second video or folder, of the right camera)",
    )
    deinterlace: _Deinterlace = Field(
        "auto",
        description="use one field of each image and interpolate the missing rows (on, off); auto: where a video is "
        "interlaced and the working size does not average both fields; true means on, false off",
    )
    redact: tuple[Box, ...] = Field(
        (),
        description="boxes of the input's pictures, x y width height, px, that are blackened before anything else is "
        "done with them: names and numbers of patients",
    )
    longest_side_px: int = Field(
        400,
        ge=0,
        description="longest side of the working size unless that is given (--size): the input's is divided by the "
        "smallest whole number that brings it to this, px; 0: the input's size",
    )
    frames: str = Field(
        "",
        pattern=r"^(-?\d{0,15}:-?\d{0,15}(:\d{0,15})?)?$",
        description="which frames of the input are used, START:STOP or START:STOP:STEP as a Python slice has them, by "
        "their positions from 0 on; empty: all (--frames)",
    )
    fps: float | None = Field(None, gt=0, description="maximum frames per second, by the time stamps")
    skip_duplicates: bool = Field(
        True, description="leave out images of a video that repeat the last one, but for noise"
    )

    @property
    def uses_both_views(self) -> bool:
        """Whether depth is to be measured from two views."""
        return self.stereo.partition(":")[0] == "use"

    @property
    def layout(self) -> _Layout:
        """How two views are in one image."""
        told = self.stereo.partition(":")[2] or "auto" if self.uses_both_views else self.stereo
        return cast(_Layout, told if told in get_args(_Layout) else "none")

    @property
    def second_view(self) -> Path | None:
        """The file or folder of the right view, None where it is in the same images or not used."""
        return Path(self.stereo.partition(":")[2]) if self.uses_both_views and self.layout == "none" else None


class MaskSettings(StageSettings):
    """Which pixels count as usable tissue."""

    METHODS: ClassVar[Methods] = {
        "scopemap": {},
        "no-overlays": {},
        "no-field-of-view": {},
        "no-highlights": {},
        "no-exposure": {},
    }
    method: str = Field(
        "scopemap",
        description="scopemap: what lies outside of the circular or octagonal field of view, specular highlights, "
        "burned-in text and logos (overlays), and pixels of bad exposure are found in the picture itself and masked; "
        "no-field-of-view, no-highlights, no-overlays, no-exposure: without one of these",
    )
    files: str = Field(
        "",
        description="folder of masks, one image per frame, found by the number in its name: non-zero pixels are masked "
        "(instruments, overlays); empty: the data set's own where it has some; none: no masks from files",
    )
    instruments: Literal["auto", "off", "files"] = Field(
        "files",
        description="who tells where instruments are, files: masks from files, where there are some; auto: in frames "
        "without one the depth network, where it can (scopenet), which misses some and takes pale tissue for others; "
        "off: nobody, masks from files are not read either",
    )
