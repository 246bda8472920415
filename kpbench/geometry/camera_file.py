"""Calibration files of cameras: OpenCV's FileStorage, ROS's ``camera_info``, Kalibr's ``camchain``; in and out.

All three put the centre of the top-left pixel at (0, 0), as kpbench does. OpenCV and ROS share their keys::

    image_width, image_height, camera_matrix {rows, cols, data}, distortion_coefficients {rows, cols, data}

OpenCV says ``fisheye_model: 1`` for a fisheye lens, ROS says ``distortion_model: equidistant``. Kalibr has a block per
camera, with ``intrinsics [fx, fy, cx, cy]``, ``resolution``, ``distortion_model`` and ``distortion_coeffs``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

from kpbench.errors import DataError
from kpbench.files import read_text
from kpbench.geometry.camera import Camera
from kpbench.geometry.lens import LensModel
from kpbench.writing import write_file
from kpbench.yaml_text import parse_yaml

SCHEMA = "kpbench.calibration/1"
"""The mark of the calibration files that kpbench writes."""
CALIBRATION_SUFFIXES = (".yaml", ".yml", ".json")
"""Ends of the names of calibration files."""
LARGEST_CALIBRATION = 2**18
"""Largest accepted number of characters of a calibration file."""
LARGEST_SIDE_PX, LARGEST_ENTRY = 100_000, 1e7
LENGTHS: dict[LensModel, tuple[int, ...]] = {"brown": (0, 4, 5, 8, 12), "fisheye": (4,)}
"""How many coefficients a file may hold."""
DISTORTION_MODELS: dict[str, LensModel] = {
    "plumb_bob": "brown",
    "rational_polynomial": "brown",
    "radtan": "brown",
    "none": "brown",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}
"""Model of the lens by the name that ROS and Kalibr use."""
CameraFormat = Literal["opencv", "ros", "kalibr"]


def read_camera(path: str | Path) -> Camera:
    """Read a camera from a calibration file of OpenCV, ROS or Kalibr.

    Parameters
    ----------
    path : str or Path
        YAML, or JSON if the name ends in .json.

    Returns
    -------
    Camera
        Its image size is that of the file.

    Raises
    ------
    DataError
        If the file cannot be read, is no calibration file, holds several cameras, or has another model than Brown
        (0, 4, 5, 8 or 12 coefficients) or fisheye (4). The message names the file, the key and what was expected.

    Examples
    --------
    >>> from pathlib import Path
    >>> from kpbench.geometry import read_camera
    >>> _ = Path("camchain.yaml").write_text('''
    ... cam0:
    ...   camera_model: pinhole
    ...   intrinsics: [500.0, 501.0, 320.5, 239.0]
    ...   distortion_model: radtan
    ...   distortion_coeffs: [-0.2, 0.05, 0.001, 0.0]
    ...   resolution: [640, 480]
    ... ''')
    >>> camera = read_camera("camchain.yaml")
    >>> camera.width_px, camera.focal_px, camera.distortion
    (640, 500.0, (-0.2, 0.05, 0.001, 0.0))
    """
    text = read_text(path, DataError)
    if len(text) > LARGEST_CALIBRATION:
        raise DataError(f"{path}: no calibration file (it has over {LARGEST_CALIBRATION} characters)")
    try:
        content = json.loads(text) if Path(path).suffix.lower() == ".json" else parse_yaml(text)
    except Exception as error:  # a parser may raise anything on a damaged text
        problem = " ".join(f"{error}".split())[:160]
        raise DataError(f"{path}: no calibration file of OpenCV, ROS or Kalibr ({problem})") from None
    try:
        return _parse(content)
    except DataError as error:
        raise DataError(f"{path}: {error}") from None


def write_camera(path: str | Path, camera: Camera, form: CameraFormat = "opencv") -> None:
    """Write a camera as a calibration file.

    Parameters
    ----------
    path : str or Path
        An existing calibration file is replaced if kpbench wrote it.
    camera : Camera
    form : {"opencv", "ros", "kalibr"}
        OpenCV's file is JSON if the name ends in .json, else YAML.

    Raises
    ------
    DataError
        If the file cannot be written, or the format has no such lens: Kalibr's ``radtan`` has four coefficients.

    Examples
    --------
    >>> from kpbench.geometry import Camera, read_camera, write_camera
    >>> camera = Camera(640, 480, 500.0, (-0.2, 0.05, 0.001, 0.0, 0.0), focal_y_px=501.0, principal_px=(320.5, 239.0))
    >>> write_camera("camera.yaml", camera)
    >>> read_camera("camera.yaml") == camera
    True
    """
    coefficients = [float(c) for c in camera.distortion]
    if form == "kalibr":
        if camera.model == "brown":
            if any(coefficients[4:]):
                raise DataError(f"{path}: Kalibr's radtan has 4 coefficients, the lens has {len(coefficients)}")
            coefficients = (coefficients + [0.0] * 4)[:4]
        text = _kalibr(camera, coefficients)
    elif Path(path).suffix.lower() == ".json":
        text = _opencv_json(camera, coefficients)
    else:
        text = _opencv_yaml(camera, coefficients) if form == "opencv" else _ros(camera, coefficients)
    write_file(Path(path), text.encode())


def _parse(content: Any) -> Camera:
    if not isinstance(content, Mapping):
        raise DataError("no calibration file of OpenCV, ROS or Kalibr, expected keys and values")
    if "camera_matrix" in content:
        return _parse_opencv(content)
    blocks = {key: value for key, value in content.items() if isinstance(value, Mapping) and "intrinsics" in value}
    if not blocks:
        raise DataError("camera_matrix is missing, expected the keys of OpenCV, ROS or Kalibr")
    if len(blocks) > 1:
        raise DataError(f"holds {len(blocks)} cameras ({', '.join(map(str, blocks))[:60]}), expected one")
    [(name, block)] = blocks.items()
    return _parse_kalibr(block, f"{name}"[:60])


def _parse_opencv(content: Mapping[str, Any]) -> Camera:
    size = _whole(content.get("image_width"), "image_width"), _whole(content.get("image_height"), "image_height")
    matrix = _matrix(content.get("camera_matrix"), "camera_matrix")
    if len(matrix) != 9:
        raise DataError(f"camera_matrix has {len(matrix)} numbers, expected 9")
    fx, skew, cx, zero, fy, cy, *last = matrix
    if skew or zero or last != [0, 0, 1]:
        raise DataError("camera_matrix is no [fx 0 cx; 0 fy cy; 0 0 1]")
    held = content.get("distortion_coefficients")
    coefficients = [] if held is None else _matrix(held, "distortion_coefficients")
    named = content.get("distortion_model")
    is_fisheye = _number(content.get("fisheye_model", 0), "fisheye_model") != 0
    model = _model(named, "distortion_model") if named is not None else ("fisheye" if is_fisheye else "brown")
    return _make(size, (fx, fy, cx, cy), model, coefficients, "distortion_coefficients")


def _parse_kalibr(block: Mapping[str, Any], name: str) -> Camera:
    if block.get("camera_model") != "pinhole":
        raise DataError(f"{name}.camera_model is {_show(block.get('camera_model'))}, expected 'pinhole'")
    intrinsics = _numbers(block.get("intrinsics"), f"{name}.intrinsics")
    if len(intrinsics) != 4:
        raise DataError(f"{name}.intrinsics has {len(intrinsics)} numbers, expected 4: fx, fy, cx, cy")
    resolution = block.get("resolution")
    if not isinstance(resolution, list) or len(resolution) != 2:
        raise DataError(f"{name}.resolution is {_show(resolution)}, expected [width, height]")
    size = _whole(resolution[0], f"{name}.resolution[0]"), _whole(resolution[1], f"{name}.resolution[1]")
    model = _model(block.get("distortion_model", "none"), f"{name}.distortion_model")
    coefficients = _numbers(block.get("distortion_coeffs", []), f"{name}.distortion_coeffs")
    return _make(size, tuple(intrinsics), model, coefficients, f"{name}.distortion_coeffs")


def _make(
    size: tuple[int, int], intrinsics: tuple[float, ...], model: LensModel, coefficients: list[float], key: str
) -> Camera:
    fx, fy, cx, cy = intrinsics
    if not (fx > 0 and fy > 0):
        raise DataError(f"the focal lengths are {fx:g} and {fy:g} px, expected positive numbers")
    if len(coefficients) not in LENGTHS[model]:
        expected = " or ".join(map(str, LENGTHS[model]))
        raise DataError(f"{key} has {len(coefficients)} numbers, expected {expected} for a {model} lens")
    focal_y = None if fx == fy else fy
    return Camera(*size, fx, tuple(coefficients), model, (cx, cy), focal_y)


def _model(name: Any, key: str) -> LensModel:
    if not isinstance(name, str) or name not in DISTORTION_MODELS:
        raise DataError(f"{key} is {_show(name)}, expected one of: {', '.join(DISTORTION_MODELS)}")
    return DISTORTION_MODELS[name]


def _matrix(value: Any, key: str) -> list[float]:
    """Return the numbers of a matrix: a mapping with data, or a list of numbers or of rows."""
    if isinstance(value, Mapping):
        return _numbers(value.get("data"), f"{key}.data")
    if isinstance(value, list) and value and all(isinstance(row, list) for row in value):
        return [number for n, row in enumerate(value) for number in _numbers(row, f"{key}[{n}]")]
    return _numbers(value, key)


def _numbers(value: Any, key: str) -> list[float]:
    if not isinstance(value, list) or len(value) > 100:
        raise DataError(f"{key} is {_show(value)}, expected a list of numbers")
    return [_number(entry, f"{key}[{n}]") for n, entry in enumerate(value)]


def _number(value: Any, key: str) -> float:
    if isinstance(value, str) and len(value) < 40:  # YAML 1.1 takes 1e-05 for a text
        with suppress(ValueError):
            value = float(value)
    is_number = isinstance(value, int | float)
    if not is_number or not abs(value) <= LARGEST_ENTRY or not math.isfinite(value):
        raise DataError(f"{key} is {_show(value)}, expected a number of at most {LARGEST_ENTRY:g}")
    return float(value)


def _whole(value: Any, key: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= LARGEST_SIDE_PX:
        raise DataError(f"{key} is {_show(value)}, expected a whole number from 1 to {LARGEST_SIDE_PX}")
    return value


def _show(value: Any) -> str:
    if value is None:
        return "missing"
    try:
        return repr(value)[:60]
    except (RecursionError, ValueError):
        return "..."


def _opencv_yaml(camera: Camera, coefficients: list[float]) -> str:
    K = _join(camera.K.ravel().tolist())
    return (
        f"%YAML:1.0\n---\n# {SCHEMA}\nimage_width: {camera.width_px}\nimage_height: {camera.height_px}\n"
        f"fisheye_model: {int(camera.model == 'fisheye')}\n"
        f"camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: {K}\n"
        f"distortion_coefficients: !!opencv-matrix\n   rows: {min(1, len(coefficients))}\n"
        f"   cols: {len(coefficients)}\n   dt: d\n   data: {_join(coefficients)}\n"
    )


def _opencv_json(camera: Camera, coefficients: list[float]) -> str:
    def matrix(rows: int, cols: int, data: list[float]) -> dict[str, Any]:
        return {"type_id": "opencv-matrix", "rows": rows, "cols": cols, "dt": "d", "data": data}

    content = {
        "schema": SCHEMA,
        "image_width": camera.width_px,
        "image_height": camera.height_px,
        "fisheye_model": int(camera.model == "fisheye"),
        "camera_matrix": matrix(3, 3, camera.K.ravel().tolist()),
        "distortion_coefficients": matrix(min(1, len(coefficients)), len(coefficients), coefficients),
    }
    return json.dumps(content, indent=4) + "\n"


def _ros(camera: Camera, coefficients: list[float]) -> str:
    model = "equidistant" if camera.model == "fisheye" else "plumb_bob"
    if camera.model == "brown" and len(coefficients) > 5:
        model = "rational_polynomial"
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    matrices = {
        "camera_matrix": (3, 3, camera.K.ravel().tolist()),
        "distortion_coefficients": (min(1, len(coefficients)), len(coefficients), coefficients),
        "rectification_matrix": (3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        "projection_matrix": (3, 4, [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
    }
    text = f"# {SCHEMA}\nimage_width: {camera.width_px}\nimage_height: {camera.height_px}\ncamera_name: camera\n"
    text += f"distortion_model: {model}\n"
    for name, (rows, cols, data) in matrices.items():
        text += f"{name}:\n  rows: {rows}\n  cols: {cols}\n  data: {_join(data)}\n"
    return text


def _kalibr(camera: Camera, coefficients: list[float]) -> str:
    model = "equidistant" if camera.model == "fisheye" else "radtan"
    K = camera.K.tolist()
    intrinsics = [K[0][0], K[1][1], K[0][2], K[1][2]]
    return (
        f"# {SCHEMA}\ncam0:\n  camera_model: pinhole\n  distortion_model: {model}\n"
        f"  distortion_coeffs: {_join(coefficients)}\n  intrinsics: {_join(intrinsics)}\n"
        f"  resolution: [{camera.width_px}, {camera.height_px}]\n"
    )


def _join(numbers: list[float]) -> str:
    """Return numbers as all readers take them: with a point, also before an exponent."""
    texts = [repr(number) for number in numbers]
    return f"[{', '.join(t if '.' in t else t.replace('e', '.0e') for t in texts)}]"
