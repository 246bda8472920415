"""Detectors: what one is, how one is loaded, and the pieces that several share.

A detector is anything that takes an image and returns :class:`~kpbench.keypoints.Detections`: a function,
or an object with a method ``detect``. There is nothing to inherit from.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench import __version__
from kpbench.errors import DataError
from kpbench.keypoints import Detections, Float, UInt8

__all__ = ["DETECTORS", "Detector", "LoadedDetector", "load_detector", "suppress", "to_grey"]

DETECTORS = {
    "template": "kpbench.detectors.template:TemplateDetector",
    "superpoint-small": "kpbench.detectors.superpoint:SmallSuperPointDetector",
}
"""Name → where the shipped detector is, as ``MODULE:ATTR``."""


class Detector(Protocol):
    """What ``MODULE:ATTR`` may name (a plain function with this signature does as well)."""

    def detect(self, image: UInt8) -> Detections:
        """Detections in one image, (H, W) grey or (H, W, 3) RGB."""
        ...


@dataclass(frozen=True)
class LoadedDetector:
    """A detector with a name and a version; call it with an image.

    Raises
    ------
    DataError
        On a call, if the detector returns anything but finite :class:`Detections`.
    """

    name: str
    version: str
    run: Callable[[UInt8], Detections]

    def __call__(self, image: UInt8) -> Detections:
        """Detections in one image, (H, W) grey or (H, W, 3) RGB, uint8."""
        found = self.run(image)
        if not isinstance(found, Detections):
            raise DataError(f"detector {self.name}: returned {type(found).__name__}, expected kpbench.Detections")
        if not (np.isfinite(found.xy).all() and np.isfinite(found.score).all()):
            raise DataError(f"detector {self.name}: returned a coordinate or score that is not finite")
        return found

    detect = __call__


def load_detector(name: str) -> LoadedDetector:
    """A shipped detector by name, or one of yours by ``MODULE:ATTR``.

    ``ATTR`` may be a function of an image, an object with a method ``detect`` (or that can be called), or a
    class that gives such an object when called without arguments. Modules in the current folder are found.

    Raises
    ------
    DataError
        If there is no such detector, or it is none.
    """
    if ":" not in DETECTORS.get(name, name):
        raise DataError(
            f"detector {name!r} is not known; there are: {', '.join(DETECTORS)}, or MODULE:ATTR of your own"
        )
    found = _resolve(DETECTORS.get(name, name))
    try:
        made = found() if isinstance(found, type) else found
    except Exception as error:
        raise DataError(f"detector {name!r}: cannot be made, {type(error).__name__}: {one_line(error)}") from None
    run = getattr(made, "detect", made)
    if not callable(run):
        raise DataError(f"detector {name!r}: {made!r} cannot be called and has no method detect(image)")
    version = getattr(made, "version", __version__ if name in DETECTORS else "unknown")
    return LoadedDetector(str(getattr(made, "name", name)), str(version), run)


def _resolve(path: str) -> Any:
    module, _, attribute = path.partition(":")
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        return getattr(importlib.import_module(module), attribute)
    except ModuleNotFoundError as error:
        raise DataError(f"detector {path!r}: there is no module {error.name!r}") from None
    except (Exception, SystemExit) as error:
        if not isinstance(error, AttributeError) or hasattr(sys.modules.get(module), attribute):
            what = f"{type(error).__name__}: {one_line(error)}"
            raise DataError(f"detector {path!r}: module {module!r} cannot be imported, {what}") from None
        raise DataError(f"detector {path!r}: module {module!r} has no attribute {attribute!r}") from None


def one_line(error: BaseException) -> str:
    """The text of an error without line breaks."""
    return " ".join(str(error).split())


def to_grey(image: UInt8) -> UInt8:
    """(H, W) or RGB (H, W, 3) to (H, W).

    Raises
    ------
    DataError
        If the array is no such image.
    """
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise DataError(f"image of shape {image.shape} and type {image.dtype}, expected uint8 (H, W) or (H, W, 3)")
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)


def suppress(xy: Float, score: Float, distance_px: float | Float) -> NDArray[np.int64]:
    """Non-maximum suppression: indices of the points that have no better kept one within a distance.

    Parameters
    ----------
    xy : ndarray of shape (n, 2), px
    score : ndarray of shape (n,)
    distance_px : float or ndarray of shape (n,)
        Reach of a point, over worse ones.

    Returns
    -------
    ndarray of shape (k,), int64
        Best first; equal scores in order of x, then y.
    """
    order = np.lexsort((xy[:, 1], xy[:, 0], -score))
    reach = np.broadcast_to(np.asarray(distance_px, np.float64), score.shape)
    kept: list[int] = []
    for n in order:
        if not kept or np.all(np.hypot(*(xy[kept] - xy[n]).T) >= reach[kept]):
            kept.append(int(n))
    return np.array(kept, np.int64)
