"""Detectors: what one is, how one is loaded, and the pieces that several share.

A detector is anything that takes an image and returns :class:`~kpbench.types.Detections`: a function,
or an object with a method ``detect``. There is nothing to inherit from.
"""

from __future__ import annotations

import hashlib
import importlib
import sys
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from kpbench import __version__
from kpbench.detectors.program import run_program
from kpbench.errors import DataError
from kpbench.types import Detections, UInt8

DETECTORS = {
    "template": "kpbench.detectors.template:TemplateDetector",
    "superpoint": "kpbench.detectors.superpoint:SuperPointDetector",
    "superpoint-small": "kpbench.detectors.superpoint:SmallSuperPointDetector",
    "orb": "kpbench.detectors.features:orb",
    "sift": "kpbench.detectors.features:sift",
    "aruco": "kpbench.detectors.tags:ArucoDetector",
    "apriltag": "kpbench.detectors.tags:AprilTagDetector",
    "charuco": "kpbench.detectors.tags:CharucoDetector",
}
"""Name → where the shipped detector is, as ``MODULE:ATTR``."""

PROGRAM = "program:"
"""What the name of a detector begins with that is a program, see :func:`kpbench.detectors.run_program`."""


class Detector(Protocol):
    """What ``MODULE:ATTR`` may name (a plain function with this signature does as well)."""

    def detect(self, image: UInt8) -> Detections:
        """Detections in one image, (H, W) grey or (H, W, 3) RGB."""
        ...


@dataclass(frozen=True)
class LoadedDetector:
    """A detector with a name and a version; call it with an image.

    Attributes
    ----------
    name, version : str
    run : function of an image.
    board : the board of tags that it looks for (:data:`kpbench.patches.TAG_BOARDS`), None for patches.
    identity : SHA-256 of name, version, settings and weights: what a detector's kept detections are valid for. None if
        it tells no version.
    run_many : function of several images, where that is faster than one by one, or None.

    Raises
    ------
    DataError
        On a call, if the detector returns anything but finite :class:`Detections`.
    """

    name: str
    version: str
    run: Callable[[UInt8], Detections]
    board: str | None = None
    identity: str | None = None
    run_many: Callable[[Sequence[UInt8]], list[Detections]] | None = None

    def __call__(self, image: UInt8) -> Detections:
        """Detections in one image, (H, W) grey or (H, W, 3) RGB, uint8."""
        return self._checked(self.run(image))

    detect = __call__

    def detect_many(self, images: Sequence[UInt8]) -> list[Detections]:
        """The same for each of several images; if it raises, nobody knows on which."""
        if self.run_many is None:
            return [self(image) for image in images]
        return [self._checked(found) for found in self.run_many(images)]

    def _checked(self, found: object) -> Detections:
        if not isinstance(found, Detections):
            raise DataError(f"detector {self.name}: returned {type(found).__name__}, expected kpbench.Detections")
        if not (np.isfinite(found.xy).all() and np.isfinite(found.score).all()):
            raise DataError(f"detector {self.name}: returned a coordinate or score that is not finite")
        if found.patch_id is not None and np.any(found.patch_id < 0):
            raise DataError(f"detector {self.name}: returned the patch id {found.patch_id.min()}, expected 0 or more")
        return found


def load_detector(name: str, threshold: float | None = None) -> LoadedDetector:
    """A shipped detector by name; yours as weights ``FILE.onnx``, ``MODULE:ATTR``, or ``program:COMMAND``.

    A file is one that ``kpbench export-model`` wrote. ``ATTR`` may be a function of an image, an object with a
    method ``detect`` (or that can be called), or a class that gives such an object when called without
    arguments. Modules in the current folder are found. ``threshold`` takes the place of the detector's own, if it
    has an attribute of that name.

    Raises
    ------
    DataError
        If there is no such detector, or it is none.
    """
    if name.startswith(PROGRAM):
        many = partial(run_program, name.removeprefix(PROGRAM).strip())
        return LoadedDetector(name, "unknown", lambda image: many([image])[0], run_many=many)
    if name.endswith(".onnx"):
        made = _with(threshold, _resolve(DETECTORS["superpoint"])(Path(name)))
        return LoadedDetector(Path(name).stem, made.version, made.detect, identity=_identity(name, made.version, made))
    if ":" not in DETECTORS.get(name, name):
        raise DataError(
            f"detector {name!r} is not known; there are: {', '.join(DETECTORS)}, or FILE.onnx, MODULE:ATTR "
            "or program:COMMAND of your own"
        )
    found = _resolve(DETECTORS.get(name, name))
    try:
        made = _with(threshold, found() if isinstance(found, type) else found)
    except DataError:
        raise
    except (Exception, SystemExit) as error:
        raise DataError(f"detector {name!r}: cannot be made, {type(error).__name__}: {one_line(error)}") from None
    run = getattr(made, "detect", made)
    if not callable(run):
        raise DataError(f"detector {name!r}: {made!r} cannot be called and has no method detect(image)")
    version = getattr(made, "version", __version__ if name in DETECTORS else None)
    label = name if name in DETECTORS else str(getattr(made, "name", name))
    identity = None if version is None else _identity(name, str(version), made)
    return LoadedDetector(label, str(version or "unknown"), run, getattr(made, "board", None), identity)


def _identity(name: str, version: str, detector: Any) -> str:
    """Digest of name, version, settings (plain public attributes) and weights (the file at ``path``)."""
    values = vars(detector) if hasattr(detector, "__dict__") else {}
    plain = {key: value for key, value in values.items() if key[0] != "_" and _is_plain(value)}
    digest = hashlib.sha256(repr([name, version, sorted(plain.items())]).encode())
    weights = getattr(detector, "path", None)
    if isinstance(weights, Path) and weights.is_file():
        digest.update(weights.read_bytes())
    return digest.hexdigest()


def _is_plain(value: object) -> bool:
    """Whether a value is a setting: a number, a text, nothing, or a sequence of such."""
    if isinstance(value, (tuple, list)):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, (bool, int, float, str))


def _with(threshold: float | None, detector: Any) -> Any:
    if threshold is not None and hasattr(detector, "threshold"):
        detector = copy(detector)  # which may be an object that others use as well
        detector.threshold = threshold
    return detector


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
