"""Cameras of other people's programs: each file, by its own format's formula written here, projects as ours does.

Formulas are those of the formats' documentation, for points (x, y, z) in front of the camera; what they return is moved
to pixels whose first centre is (0, 0).
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.polynomial.polynomial import polyval
from scipy.io import savemat
from scipy.optimize import brentq

from scopemap.engine.errors import CalibrationError
from scopemap.input.camera_files.reading import read_calibration

SIZE = (640, 480)
W, H = SIZE
FX, FY, CX, CY = 520.5, 525.25, 318.0, 245.0
POINTS = np.array([(0, 0, 50), (10, -6, 40), (-21, 14, 60), (17, 13, 45), (3, 25, 70), (-30, -18, 80)], float)
Formula = Callable[[np.ndarray], np.ndarray]
Content = str | bytes | dict[str, Any]


def at(folder: Path, content: Content) -> Path:
    file = folder / "any.thing"
    text = json.dumps(content) if isinstance(content, dict) else content
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return file


def pixels(xy: np.ndarray, fx: float = FX, fy: float = FY, cx: float = CX, cy: float = CY) -> np.ndarray:
    return xy * (fx, fy) + (cx, cy)


def plane(points: np.ndarray) -> np.ndarray:
    return points[:, :2] / points[:, 2:]


# ---- the formulas


def brown(k1: float, k2: float, p1: float, p2: float, k3: float = 0.0) -> Formula:
    """OpenCV's, MATLAB's and Bouguet's radial and tangential terms."""

    def project(points: np.ndarray) -> np.ndarray:
        x, y = plane(points).T
        s = x**2 + y**2
        radial = 1 + k1 * s + k2 * s**2 + k3 * s**3
        u = x * radial + 2 * p1 * x * y + p2 * (s + 2 * x**2)
        return pixels(np.stack([u, y * radial + p1 * (s + 2 * y**2) + 2 * p2 * x * y], -1))

    return project


def kannala_brandt(*k: float) -> Formula:
    """By the angle t: t + k[0] t^3 + k[1] t^5 + k[2] t^7 + k[3] t^9."""

    def project(points: np.ndarray) -> np.ndarray:
        xy = plane(points)
        r = np.hypot(*xy.T)
        t = np.arctan(r)
        scale = np.divide(
            t + k[0] * t**3 + k[1] * t**5 + k[2] * t**7 + k[3] * t**9, r, out=np.ones_like(r), where=r > 0
        )
        return pixels(xy * scale[:, None])

    return project


def atan(fx: float, fy: float, cx: float, cy: float, w: float) -> Formula:
    """PTAM's ATANCamera: shares of the size, the centre half a pixel less."""

    def project(points: np.ndarray) -> np.ndarray:
        xy = plane(points)
        r = np.hypot(*xy.T)
        scale = np.divide(
            np.arctan(r * 2 * np.tan(w / 2)) / w, r, out=np.full_like(r, 2 * np.tan(w / 2) / w), where=r > 0
        )
        return pixels(xy * scale[:, None], W * fx, H * fy, W * cx - 0.5, H * cy - 0.5)

    return project


def scaramuzza(a: tuple[float, ...], c: float, d: float, e: float, cx: float, cy: float) -> Formula:
    """C3VD's renderer and MATLAB: a ray (u, v, a0 + a1 rho + ...); pixel = [[c, d], [e, 1]] (u, v) + centre."""

    def one(point: np.ndarray) -> np.ndarray:
        x, y, z = point
        r = np.hypot(x, y)
        rho = 0.0 if r == 0 else brentq(lambda rho: polyval(rho, a) * r - rho * z, 0.0, 400.0, xtol=1e-12)
        uv = np.array([x, y]) * (rho / r if r else 0.0)
        return np.array([[c, d], [e, 1.0]]) @ uv + (cx, cy)

    return lambda points: np.stack([one(point) for point in points])


def ocamcalib(ss: tuple[float, ...], c: float, d: float, e: float, row: float, column: float) -> Formula:
    """The toolbox': axes down, right, back; (row, column) = [[c, d], [e, 1]] (down, right) + centre."""
    inner = scaramuzza(tuple(-a for a in ss), c, d, e, row, column)
    return lambda points: inner(points[:, [1, 0, 2]])[:, ::-1]


def metashape(f: float, cx: float, cy: float, b1: float, k: tuple[float, ...], p: tuple[float, ...]) -> Formula:
    """The manual's frame camera; the corner of the picture is (0, 0)."""

    def project(points: np.ndarray) -> np.ndarray:
        x, y = plane(points).T
        s = x**2 + y**2
        radial = 1 + k[0] * s + k[1] * s**2 + k[2] * s**3
        xd = x * radial + p[0] * (s + 2 * x**2) + 2 * p[1] * x * y
        yd = y * radial + p[1] * (s + 2 * y**2) + 2 * p[0] * x * y
        return np.stack([W / 2 + cx + xd * f + xd * b1 - 0.5, H / 2 + cy + yd * f - 0.5], -1)

    return project


# ---- the files

BROWN, BROWN3 = (-0.3, 0.1, 1e-3, -5e-4), (-0.3, 0.1, 1e-3, -5e-4, -0.01)
KB = (-0.13, -3e-4, 1.5e-3, -1e-4)
ATAN = (0.81, 1.09, 0.4975, 0.511, 0.9)
POLYNOMIAL, STRETCH = (400.0, 0.0, -8e-4, 6e-7, -1e-10), (0.9999, 0.003, -0.002)
SS, AFFINE = (-400.0, 0.0, 8e-4, -6e-7), (0.9995, 0.002, -0.0015)
NAMED = {"fx": FX, "fy": FY, "cx": CX, "cy": CY}
K_ROWS = f"{FX} 0 {CX}\n0 {FY} {CY}\n0 0 1\n"
SIZE_NAMES = {"image_width": W, "image_height": H}
# MATLAB counts from 1, and its IntrinsicMatrix is transposed.
K_MATLAB = np.array([[FX, 0, CX + 1], [0, FY, CY + 1], [0, 0, 1]])
MATLAB = {"RadialDistortion": [-0.3, 0.1, -0.01], "TangentialDistortion": [1e-3, -5e-4], "ImageSize": [H, W]}
INTRINSICS = {"FocalLength": [FX, FY], "PrincipalPoint": [CX + 1, CY + 1], "Skew": 0.0, **MATLAB}
FISHEYE = {
    "MappingCoefficients": [POLYNOMIAL[0], *POLYNOMIAL[2:]], "DistortionCenter": [CX + 1, CY + 1], "ImageSize": [H, W],
    "StretchMatrix": [[STRETCH[0], STRETCH[1]], [STRETCH[2], 1.0]],
}  # fmt: skip
OCAM_MODEL = {
    "ss": np.array(SS)[:, None], "xc": CY + 1, "yc": CX + 1, "c": AFFINE[0], "d": AFFINE[1], "e": AFFINE[2],
    "width": W, "height": H, "pol": np.ones(9),
}  # fmt: skip
C3VD_INI = f"""; omnidirectional camera intrinsics
width = {W}
height = {H}
cx = {CX}
cy = {CY}
a0 = {POLYNOMIAL[0]} \t\t
a1 = 0.0
a2 = {POLYNOMIAL[2]}
a3 = {POLYNOMIAL[3]}
a4 = {POLYNOMIAL[4]}
c = {STRETCH[0]}
d = {STRETCH[1]}
e = {STRETCH[2]}

; poses
worldInputMode = 1
modelTransform = 1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1
mask = mask.png
"""
METASHAPE = f"""<?xml version="1.0" encoding="UTF-8"?>
<calibration>
  <projection>frame</projection>
  <width>{W}</width>
  <height>{H}</height>
  <f>525.25</f>
  <cx>-1.5</cx>
  <cy>5.5</cy>
  <b1>-4.75</b1>
  <k1>-0.3</k1>
  <k2>0.1</k2>
  <k3>-0.01</k3>
  <p1>-0.0005</p1>
  <p2>0.001</p2>
  <date>2024-01-01T00:00:00Z</date>
</calibration>
"""


def mat(compressed: bool = True, **variables: Any) -> bytes:
    stream = io.BytesIO()
    savemat(stream, variables, do_compression=compressed)
    return stream.getvalue()


def npz(**arrays: Any) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def basalt(kind: str, **lens: float) -> dict[str, Any]:
    cameras = [{"camera_type": kind, "intrinsics": {**NAMED, **lens}}, {"camera_type": "ds", "intrinsics": {"xi": 1}}]
    return {"value0": {"T_imu_cam": [{"px": 0.0, "qw": 1}], "intrinsics": cameras, "resolution": [[W, H], [9, 9]]}}


def numbered(letters: str, first: int, values: tuple[float, ...]) -> dict[str, float]:
    return {f"{letters}{i}": value for i, value in enumerate(values, start=first)}


def dso(model: str, values: tuple[float, ...], more: str = f"{W} {H}\ncrop\n320 240\n") -> str:
    return f"{model} {' '.join(map(repr, values))}\n{more}".lstrip()


DSO_SHARES = (FX / W, FY / H, (CX + 0.5) / W, (CY + 0.5) / H)
FILES: dict[str, tuple[Content, Formula]] = {
    # ---- Kannala-Brandt, by which names exist
    **{f"k{first} ... by name": ({**NAMED, "model": "kannala_brandt", **numbered("k", first, KB)}, kannala_brandt(*KB))
       for first in (0, 1, 2)},
    "k0 ... in yaml": (
        "camera_model: fisheye\n" + "".join(f"{n}: {v}\n" for n, v in {**NAMED, **numbered("k", 0, KB)}.items()),
        kannala_brandt(*KB),
    ),
    "k_0 ... in an ini": (
        "[camera]\nmodel = fisheye\n" + "".join(f"{n} = {v}\n" for n, v in {**NAMED, **numbered("k_", 0, KB)}.items()),
        kannala_brandt(*KB),
    ),
    "k0 ... in a mapping": ({**NAMED, "model": "fisheye", "distortion": numbered("k", 0, KB)}, kannala_brandt(*KB)),
    "camodocal's fisheye": (
        {"model_type": "KANNALA_BRANDT", **SIZE_NAMES, "projection_parameters":
         {**numbered("k", 2, KB), "mu": FX, "mv": FY, "u0": CX, "v0": CY}}, kannala_brandt(*KB),
    ),
    "d0 ... of a fisheye": ({**NAMED, "model": "equidistant", **numbered("d", 0, KB)}, kannala_brandt(*KB)),
    "k0 k1 p0 p1": ({**NAMED, "k0": -0.3, "k1": 0.1, "p0": 1e-3, "p1": -5e-4}, brown(*BROWN)),
    "k1 k2 t1 t2 k3": (
        {**NAMED, "k1": -0.3, "k2": 0.1, "t1": 1e-3, "t2": -5e-4, "k3": -0.01}, brown(*BROWN3),
    ),
    "cam_d0 ...": (
        f"cam_model: Pinhole\ncam_width: {W}\ncam_height: {H}\n"
        + "".join(f"cam_{n}: {v}\n" for n, v in {**NAMED, **numbered("d", 0, BROWN)}.items()), brown(*BROWN),
    ),
    "f c k": ({"f": [FX, FY], "c": [CX, CY], "k": list(BROWN3)}, brown(*BROWN3)),
    "the left of two": (
        "[LEFT]\n" + "".join(f'{n} = "{v}"\n' for n, v in NAMED.items()) + "k1=-0.3\nk2=0.1\np1=1e-3\np2=-5e-4\n"
        "[RIGHT]\nfx=1\nfy=1\ncx=2\ncy=2\nk1=0.4\n", brown(*BROWN),
    ),
    "kc1 ... kc5": ({**NAMED, **numbered("kc", 1, BROWN3)}, brown(*BROWN3)),
    # ---- numbers
    "scikit-surgery": (f"{K_ROWS}-0.3 0.1 0.001 -0.0005 -0.01 ", brown(*BROWN3)),
    "scikit-surgery, four": (f"{K_ROWS}-0.3,0.1,0.001,-0.0005\n", brown(*BROWN)),
    "a column of coefficients": (f"{K_ROWS}\n-0.3\n0.1\n0.001\n-0.0005\n", brown(*BROWN)),
    "matrix, lens and size": (f"% mine\n{K_ROWS}-0.3 0.1 0.001 -0.0005\n{W} {H}\n", brown(*BROWN)),
    "shares in a 4x4": (
        f"{FX / W!r} 0 {CX / W!r} 0\n0 {FY / H!r} {CY / H!r} 0\n0 0 1 0\n0 0 0 1\n", brown(0, 0, 0, 0),
    ),
    "shares in a 4x4 by name": (
        {"K": [[FX / W, 0, CX / W, 0], [0, FY / H, CY / H, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, brown(0, 0, 0, 0),
    ),
    "3x4 by name": ({"K": [[FX, 0, CX, 0], [0, FY, CY, 0], [0, 0, 1, 0]]}, brown(0, 0, 0, 0)),
    # ---- PTAM, DSO
    "ptam": (f"Camera.Parameters=[ {' '.join(map(str, ATAN))} ]\n", atan(*ATAN)),
    "ptam with more": (f"GLWindow.Name=x\nCamera.Parameters = [ {' '.join(map(str, ATAN))} ];\n", atan(*ATAN)),
    "five shares alone": (" ".join(map(str, ATAN)), atan(*ATAN)),
    "svo's atan": (
        f"cam_model: ATAN\ncam_width: {W}\ncam_height: {H}\n"
        + "".join(f"cam_{n}: {v}\n" for n, v in zip(("fx", "fy", "cx", "cy", "d0"), ATAN, strict=True)), atan(*ATAN),
    ),
    "tum mono": (dso("", ATAN, f"{W} {H}\n0.4 0.53 0.5 0.5 0\n320 240\n"), atan(*ATAN)),
    "dso fov": (dso("FOV", ATAN), atan(*ATAN)),
    "dso radtan": (dso("RadTan", (*DSO_SHARES, *BROWN)), brown(*BROWN)),
    "dso radtan, no word, px": (dso("", (FX, FY, CX, CY, *BROWN), f"{W} {H}\nnone\n{W} {H}"), brown(*BROWN)),
    "dso equidistant": (dso("EquiDistant", (*DSO_SHARES, *KB)), kannala_brandt(*KB)),
    "dso kannala-brandt": (dso("KannalaBrandt", (FX, FY, CX, CY, *KB)), kannala_brandt(*KB)),
    "dso pinhole": (dso("Pinhole", (*DSO_SHARES, 0.0)), brown(0, 0, 0, 0)),
    "dso, omega 0": (dso("", (*DSO_SHARES, 0.0)), brown(0, 0, 0, 0)),
    # ---- NumPy
    "npz": (npz(mtx=np.reshape(K_ROWS.split(), (3, 3)).astype(float), dist=np.array([BROWN3]), rvecs=np.ones((2, 3, 1)),
                notes=np.array([None, 1], object)), brown(*BROWN3)),
    "npy": (npy(np.reshape(K_ROWS.split(), (3, 3)).astype(float)), brown(0, 0, 0, 0)),
    # ---- Basalt
    "basalt kb4": (basalt("kb4", **numbered("k", 1, KB)), kannala_brandt(*KB)),
    "basalt pinhole": (basalt("pinhole"), brown(0, 0, 0, 0)),
    "basalt radtan8": (
        basalt("pinhole-radtan8", **dict(zip(("k1", "k2", "p1", "p2", "k3"), BROWN3, strict=True)), k4=0, k5=0, k6=0,
               rpmax=2.7), brown(*BROWN3),
    ),
    # ---- Scaramuzza
    "c3vd config.ini": (C3VD_INI, scaramuzza(POLYNOMIAL, *STRETCH, CX, CY)),
    "c3vd config.ini, in a section": (f"[intrinsics]\n{C3VD_INI}", scaramuzza(POLYNOMIAL, *STRETCH, CX, CY)),
    "polynomial without a1": (
        {"cx": CX, "cy": CY, "a0": 400.0, "a2": -8e-4, "a3": 6e-7, **SIZE_NAMES},
        scaramuzza((400.0, 0.0, -8e-4, 6e-7), 1.0, 0.0, 0.0, CX, CY),
    ),
    "matlab fisheye": (mat(**FISHEYE), scaramuzza(POLYNOMIAL, *STRETCH, CX, CY)),
    "matlab fisheye, inner": (mat(params={"Intrinsics": FISHEYE}), scaramuzza(POLYNOMIAL, *STRETCH, CX, CY)),
    "matlab fisheye as json": (FISHEYE, scaramuzza(POLYNOMIAL, *STRETCH, CX, CY)),
    "ocamcalib's mat": (mat(ocam_model=OCAM_MODEL), ocamcalib(SS, *AFFINE, CY, CX)),
    "ocamcalib's calib_data": (mat(calib_data={"ocam_model": OCAM_MODEL}), ocamcalib(SS, *AFFINE, CY, CX)),
    # ---- MATLAB
    "matlab, IntrinsicMatrix": (mat(IntrinsicMatrix=K_MATLAB.T, **MATLAB), brown(*BROWN3)),
    "matlab, K": (mat(K=K_MATLAB, **MATLAB), brown(*BROWN3)),
    "matlab, a struct": (mat(s={"K": K_MATLAB, **MATLAB}), brown(*BROWN3)),
    "matlab, not compressed": (mat(False, s={"K": K_MATLAB, **MATLAB}), brown(*BROWN3)),
    "matlab, cameraIntrinsics": (mat(**INTRINSICS), brown(*BROWN3)),
    "matlab, a pair": (
        mat(CameraParameters1={"K": K_MATLAB, **MATLAB}, CameraParameters2={"K": 2 * K_MATLAB, **MATLAB}),
        brown(*BROWN3),
    ),
    "matlab as json": ({"IntrinsicMatrix": K_MATLAB.T.tolist(), **MATLAB}, brown(*BROWN3)),
    "bouguet": (
        mat(
            fc=np.array([[FX], [FY]]), cc=np.array([[CX], [CY]]), kc=np.array(BROWN3)[:, None], alpha_c=0.0, nx=W, ny=H
        ), brown(*BROWN3),
    ),
    # ---- Metashape
    "metashape": (METASHAPE, metashape(525.25, -1.5, 5.5, -4.75, (-0.3, 0.1, -0.01), (-5e-4, 1e-3))),
    "one focal length": (
        {"focal_length": FX, "principal_point": [CX, CY], "image_size": "640x480"},
        lambda points: pixels(plane(points), FX, FX),
    ),
}  # fmt: skip


@pytest.mark.parametrize("form", FILES)
def test_our_camera_projects_as_the_files_own_formula(form: str, tmp_path: Path) -> None:
    content, formula = FILES[form]
    camera = read_calibration(at(tmp_path, content), SIZE).camera
    np.testing.assert_allclose(camera.project(POINTS), formula(POINTS), rtol=0, atol=1e-6)
    assert (camera.width, camera.height) == SIZE


STATES_NO_SIZE = {
    *(f"k{first} ... by name" for first in (0, 1, 2)), "k0 ... in yaml", "k_0 ... in an ini", "k0 ... in a mapping",
    "d0 ... of a fisheye", "k0 k1 p0 p1", "k1 k2 t1 t2 k3", "kc1 ... kc5", "f c k", "the left of two",
    "scikit-surgery", "scikit-surgery, four",
    "a column of coefficients", "shares in a 4x4", "shares in a 4x4 by name", "3x4 by name", "ptam", "ptam with more",
    "five shares alone", "npz", "npy",
}  # fmt: skip


@pytest.mark.parametrize("form", sorted(FILES.keys() - STATES_NO_SIZE))
def test_a_file_that_states_its_size_is_refused_for_pictures_of_another(form: str, tmp_path: Path) -> None:
    file = at(tmp_path, FILES[form][0])
    with pytest.raises(CalibrationError, match="is for 640x480 px, but the images are 720x576 px"):
        read_calibration(file, (720, 576))
    assert read_calibration(file, (320, 240), "scale").camera.width == 320


@pytest.mark.parametrize(
    "form", ["shares in a 4x4", "shares in a 4x4 by name", "ptam", "ptam with more", "five shares alone"]
)
def test_shares_of_the_size_fit_pictures_of_every_size(form: str, tmp_path: Path) -> None:
    file = at(tmp_path, FILES[form][0])
    half = read_calibration(file, (320, 240)).camera
    whole = read_calibration(file, SIZE).camera
    np.testing.assert_allclose(half.central.fx * 2, whole.central.fx)
