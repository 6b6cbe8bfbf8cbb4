"""Settings of reading and masking."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from scopemap.config.settings import Settings

Box = tuple[
    Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)], Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]
]
"""Left, top, width and height, px."""


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
    stereo: Literal["auto", "none", "left-right", "top-bottom"] = Field(
        "auto",
        description="two views in one image, of which the left or upper is used; auto: detected in a video",
    )
    deinterlace: bool = Field(False, description="use one field of each interlaced image, interpolate the missing rows")
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
    fps: float | None = Field(None, gt=0, description="maximum frames per second, by the time stamps")
    skip_duplicates: bool = Field(True, description="leave out images of a video that repeat the one before")


class MaskAdvanced(Settings):
    """Constants of masking."""

    exposure: bool = Field(True, description="mask under-exposed and over-exposed pixels")
    dark_level: int = Field(12, ge=0, le=255, description="grey level up to which a pixel counts as under-exposed")
    files_grow_px: int = Field(3, ge=0, description="px by which masks from files are widened")


class MaskSettings(Settings):
    """Which pixels count as usable tissue."""

    field_of_view: bool = Field(True, description="find the circular or octagonal field of view and black borders")
    highlights: bool = Field(True, description="find specular highlights and mask them")
    overlays: bool = Field(True, description="find burned-in text and logos, which stay while the rest moves")
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
    advanced: MaskAdvanced = MaskAdvanced()
