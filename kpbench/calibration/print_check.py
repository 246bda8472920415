"""Measure a print in photographs, and correct its sidecar."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kpbench.calibration.camera_solution import Calibration, calibrate
from kpbench.calibration.ink import measure_ink_gain
from kpbench.calibration.photos import as_grey, list_photos, read_photo
from kpbench.calibration.shape import PrintShape
from kpbench.errors import DesignError, KpbenchWarning
from kpbench.patches.board_file import load_board
from kpbench.patches.board_sidecar import load_sidecar_json
from kpbench.printing.sidecar import correct_sidecar, require_uncorrected
from kpbench.toml import TomlTable, name_source
from kpbench.writing import write_file

RULER_SIGMA_MM = 0.1
"""Standard deviation of a length that a person measures with a ruler."""
CONTRADICTION = 4.0
"""Difference between rulers and photographs, in standard deviations, that is told."""


@dataclass(frozen=True)
class PrintCheck:
    """What photographs tell about a print.

    Attributes
    ----------
    shape : PrintShape
    values : dict of str to (float, float, str)
        Value, standard deviation and unit of: ``x to y`` (ratio of the scales), ``skew``, ``bow`` (the largest
        sagitta over the longer side of the board), and for a board with marks ``ink gain`` (how far black ink spreads).
    photos : int
        Number of photographs that were used.
    ruler_mm : (float, float)
        Nominal lengths of the rulers.
    """

    shape: PrintShape
    values: dict[str, tuple[float, float, str]]
    photos: int
    ruler_mm: tuple[float, float]


def check_print(
    photos: str | Path | Sequence[str | Path],
    sidecar: str | Path,
    *,
    progress: Callable[[int], None] = lambda photos: None,
) -> PrintCheck:
    """Measure a print in photographs. The camera is solved along.

    Parameters
    ----------
    photos : str, Path or a sequence of them
        Photographs of one camera, as for :func:`kpbench.calibrate`. Some need to be taken with the camera turned by 90
        degrees: else the ratio of the scales cannot be told from the shape of the camera's pixels.
    sidecar : str or Path
        Sidecar of the board as designed, not one that a print check wrote.
    progress : callable
        As for :func:`kpbench.calibrate`.

    Raises
    ------
    DesignError, DataError
        As raised by :func:`kpbench.load_board` and :func:`kpbench.calibrate`.

    Examples
    --------
    >>> from kpbench.calibration import check_print
    >>> check_print("photos", "missing.json")
    Traceback (most recent call last):
     ...
    kpbench.errors.DesignError: missing.json: cannot be read, No such file or directory
    """
    content = load_sidecar_json(sidecar)
    with name_source(sidecar, DesignError):
        require_uncorrected(content)
    calibration = calibrate(photos, load_board(sidecar), progress=progress)
    x, y = TomlTable(content, content.keys(), DesignError).numbers("ruler_mm", 0, count=2)
    values = _measure(calibration)
    if calibration.board.references:
        paths = dict(list_photos(photos))
        images = (read_photo(o.photo.name, paths[o.photo.name])[1] for o in calibration.used)
        grey = (as_grey(image) for image in images if image is not None)
        if found := measure_ink_gain(grey, calibration.bundle, calibration.board):
            values["ink gain"] = (*found, " mm")
        else:
            warnings.warn(f"{photos}: no ink gain, too few marks are sharp; come nearer", KpbenchWarning, stacklevel=2)
    return PrintCheck(calibration.bundle.shape, values, len(calibration.used), (x, y))


def describe_contradiction(check: PrintCheck, ruler_mm: tuple[float, float]) -> str:
    """Return in words how measured rulers contradict the photographs; "" if they do not."""
    ratio, sigma, _ = check.values["x to y"]
    measured = ruler_mm[0] / check.ruler_mm[0] / (ruler_mm[1] / check.ruler_mm[1])
    sigma = math.hypot(sigma, *(RULER_SIGMA_MM / length for length in check.ruler_mm))
    if abs(measured - ratio) <= CONTRADICTION * sigma:
        return ""
    return f"the rulers say that x to y is {measured:.4f}, the photographs say {ratio:.4f}; were the rulers swapped?"


def write_measured_sidecar(sidecar: str | Path, check: PrintCheck, ruler_mm: tuple[float, float] | None = None) -> Path:
    """Write ``NAME.measured.json`` beside a sidecar, with lengths corrected to the print. Return its path.

    The ratio of the scales is that of the photographs. The absolute scale is the mean of the rulers; without them, it
    is that of the design.

    Raises
    ------
    DesignError
        If the print differs from its design by more than 10 %.
    """
    path = Path(sidecar)
    scale = 1.0
    if ruler_mm is not None:
        scale = math.sqrt(ruler_mm[0] / check.ruler_mm[0] * ruler_mm[1] / check.ruler_mm[1])
    ratio = math.sqrt(check.values["x to y"][0])
    measured = check.ruler_mm[0] * scale * ratio, check.ruler_mm[1] * scale / ratio
    content = correct_sidecar(load_sidecar_json(path), measured)
    content["print_check"] = {
        "photographs": check.photos,
        **{name: {"value": value, "sigma": sigma} for name, (value, sigma, _) in check.values.items()},
    }
    target = path.with_suffix(".measured.json")
    write_file(target, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())
    return target


def _measure(calibration: Calibration) -> dict[str, tuple[float, float, str]]:
    shape, covariance = calibration.bundle.shape, calibration.bundle.covariance[-5:, -5:]
    sigma = np.sqrt(np.diag(covariance))
    S = np.array([[1 + shape.ratio / 2, shape.skew / 2], [shape.skew / 2, 1 - shape.ratio / 2]])
    length = max(calibration.board.side_x_mm, calibration.board.side_y_mm)
    curvature = np.linalg.eigvalsh([[shape.bow_xx, shape.bow_xy], [shape.bow_xy, shape.bow_yy]])
    bow = float(curvature[np.abs(curvature).argmax()]) * length**2 / 8
    return {
        "x to y": (float(S[0, 0] / S[1, 1]), float(sigma[0]), ""),
        "skew": (float(np.degrees(shape.skew)), float(np.degrees(sigma[1])), " degrees"),
        "bow": (bow, float(sigma[2:].max()) * length**2 / 8, " mm"),
    }
