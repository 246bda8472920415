"""The interface of a detector, the shipped detectors, and how to load a detector by name.

A detector takes an image and returns :class:`~kpbench.types.Detections`. A detector is a function, or an object with a
method ``detect``. No base class is needed.
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
from kpbench.detectors.program import run_program, split_command
from kpbench.errors import DataError
from kpbench.files import read_bytes
from kpbench.opencv import opencv_version
from kpbench.patches.design import Patch
from kpbench.text import did_you_mean
from kpbench.types import Detections, UInt8
from kpbench.validity import is_covariance

DETECTORS = {
    "superpoint-small": "kpbench.detectors.superpoint:SmallSuperPointDetector",
    "superpoint": "kpbench.detectors.superpoint:SuperPointDetector",
    "template": "kpbench.detectors.template:TemplateDetector",
    "orb": "kpbench.detectors.features:orb",
    "sift": "kpbench.detectors.features:sift",
    "aruco": "kpbench.detectors.tags:ArucoDetector",
    "apriltag": "kpbench.detectors.tags:AprilTagDetector",
    "charuco": "kpbench.detectors.tags:CharucoDetector",
    "napa": "kpbench.detectors.tags:NapaDetector",
    "locus": "kpbench.detectors.tags:LocusDetector",
}
"""Name of each shipped detector → its definition, as ``MODULE:ATTR``."""
DEFAULT_DETECTOR = "superpoint-small"
"""The detector of every command and function that is told none."""
PROGRAM_PREFIX = "program:"
"""The part of a name after this prefix is a command line, see :func:`kpbench.detectors.program.run_program`."""


class Detector(Protocol):
    """An object with a method ``detect``. A plain function from an image to detections is a detector too.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench import Detections
    >>> class Brightest:
    ...     def detect(self, image):
    ...         y, x = np.unravel_index(image.argmax(), image.shape)
    ...         return Detections([[x, y]], [1.0])
    >>> image = np.zeros((4, 5), np.uint8)
    >>> image[2, 3] = 255
    >>> Brightest().detect(image).xy
    array([[3., 2.]])
    """

    def detect(self, image: UInt8) -> Detections:
        """Return the detections in one image, uint8, (H, W) grey or (H, W, 3) RGB."""
        ...


@dataclass(frozen=True)
class LoadedDetector:
    """A detector with a name and a version; call it with an image.

    Attributes
    ----------
    name, version : str
    run : callable
        Function of an image.
    board : str, optional
        Board of tags that the detector looks for, see :data:`kpbench.patches.TAG_BOARDS`. None: the detector looks for
        patches or for points without identity.
    identity : str, optional
        SHA-256 of name, version, OpenCV's version, settings and weights. Stored detections stay valid while the
        identity is unchanged. None if the detector has no version, or was loaded with ``patches``.
    run_many : callable, optional
        Function of a sequence of images, for a detector that takes less time per image if it gets several images.
    patches : tuple of Patch
        Designs that the detector looks for; empty if the detector has no attribute ``patches``.

    Raises
    ------
    DataError
        On a call, if the result is not :class:`Detections`, or if one of its values is impossible, such as a negative
        patch ID or a coordinate that is not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench import Detections
    >>> from kpbench.detectors import LoadedDetector
    >>> detector = LoadedDetector("nothing", "1", lambda image: Detections.none())
    >>> len(detector(np.zeros((8, 8), np.uint8)))
    0
    """

    name: str
    version: str
    run: Callable[[UInt8], Detections]
    board: str | None = None
    identity: str | None = None
    run_many: Callable[[Sequence[UInt8]], list[Detections]] | None = None
    patches: tuple[Patch, ...] = ()

    def __call__(self, image: UInt8) -> Detections:
        """Return the detections in one image, uint8, (H, W) grey or (H, W, 3) RGB."""
        return self._check(self.run(image))

    detect = __call__

    def detect_many(self, images: Sequence[UInt8]) -> list[Detections]:
        """Return the detections of each image. An error does not name the image that caused the error."""
        if self.run_many is None:
            return [self(image) for image in images]
        return [self._check(found) for found in self.run_many(images)]

    def _check(self, found: object) -> Detections:
        if not isinstance(found, Detections):
            raise DataError(f"detector {self.name}: returned {type(found).__name__}, expected kpbench.Detections")
        if not (np.isfinite(found.xy).all() and np.isfinite(found.score).all()):
            raise DataError(f"detector {self.name}: returned a coordinate or score that is not finite")
        if found.covariance is not None and not is_covariance(found.covariance).all():
            raise DataError(f"detector {self.name}: returned a covariance that is not positive semi-definite")
        if found.A_patch2image is not None and not np.isfinite(found.A_patch2image).all():
            raise DataError(f"detector {self.name}: returned an affine frame that is not finite")
        if found.blur_px is not None and not ((found.blur_px >= 0) & (found.blur_px < np.inf)).all():
            raise DataError(f"detector {self.name}: returned a blur that is negative or not finite")
        if found.patch_id is not None and np.any(found.patch_id < 0):
            raise DataError(f"detector {self.name}: returned the patch id {found.patch_id.min()}, expected 0 or more")
        return found


def load_detector(name: str, threshold: float | None = None, patches: Sequence[Patch] | None = None) -> LoadedDetector:
    """Load a detector by name.

    Parameters
    ----------
    name : str
        One of :data:`DETECTORS`; weights ``FILE.onnx`` written by ``kpbench export-model``; ``MODULE:ATTR``; or
        ``program:COMMAND``. ATTR is a function of an image, an object with a method ``detect``, or a class of such
        objects whose constructor needs no arguments. MODULE may lie in the current folder,
        which is searched last.
    threshold : float, optional
        Least score of a detection, for a detector with an attribute ``threshold``. None: the detector's own threshold.
    patches : sequence of Patch, optional
        Designs that the detector ``template`` looks for. None: the four shipped designs.

    Raises
    ------
    DataError
        If the name is unknown, the named object is not a detector, or ``patches`` are given to a detector other than
        ``template``.

    Examples
    --------
    >>> import numpy as np
    >>> import kpbench
    >>> detector = kpbench.load_detector("template")
    >>> detector.name, detector.board
    ('template', None)
    >>> len(detector(np.full((48, 64), 128, np.uint8)))
    0
    """
    if patches is not None and name != "template":
        raise DataError(f"`patches` can be given only to the detector template, not to {name}")
    if name.startswith(PROGRAM_PREFIX):
        command = name.removeprefix(PROGRAM_PREFIX).strip()
        split_command(command)  # refuses what cannot be started, before any image is made
        run_many = partial(run_program, command)
        return LoadedDetector(name, "unknown", lambda image: run_many([image])[0], run_many=run_many)
    if name.endswith(".onnx"):
        made = _set_threshold(_import_attribute(DETECTORS["superpoint"])(Path(name)), threshold)
        digest = _digest_detector(name, made.version, made)
        return LoadedDetector(Path(name).stem, made.version, made.detect, identity=digest, patches=made.patches)
    if ":" not in DETECTORS.get(name, name):
        raise DataError(
            f"detector {name!r} is not known; there are: {', '.join(DETECTORS)}, or FILE.onnx, MODULE:ATTR "
            f"or program:COMMAND of your own{did_you_mean(name, DETECTORS)}"
        )
    if name not in DETECTORS:
        _search_current_folder()
    found = _import_attribute(DETECTORS.get(name, name))
    try:
        if isinstance(found, type):
            found = found() if patches is None else found(patches)
        made = _set_threshold(found, threshold)
    except DataError:
        raise
    except (Exception, SystemExit) as error:
        raise DataError(f"detector {name!r}: cannot be made, {type(error).__name__}: {in_one_line(error)}") from None
    run = getattr(made, "detect", made)
    if not callable(run):
        raise DataError(f"detector {name!r}: {made!r} cannot be called and has no method detect(image)")
    version = getattr(made, "version", __version__ if name in DETECTORS else None)
    label = name if name in DETECTORS else str(getattr(made, "name", name))
    identity = None if version is None or patches is not None else _digest_detector(name, str(version), made)
    designs = getattr(made, "patches", ())
    designs = designs if isinstance(designs, tuple) and all(isinstance(p, Patch) for p in designs) else ()
    return LoadedDetector(
        label, str(version or "unknown"), run, getattr(made, "board", None), identity, patches=designs
    )


def _digest_detector(name: str, version: str, detector: Any) -> str:
    """Return the SHA-256 of name, version, OpenCV's version, settings and weights.

    Settings are plain public attributes. Weights are the file at the attribute ``path``.
    """
    values = vars(detector) if hasattr(detector, "__dict__") else {}
    plain = {key: value for key, value in values.items() if key[0] != "_" and _is_plain(value)}
    digest = hashlib.sha256(repr([name, version, opencv_version(), sorted(plain.items())]).encode())
    weights = getattr(detector, "path", None)
    if isinstance(weights, Path) and weights.is_file():
        digest.update(read_bytes(weights))
    return digest.hexdigest()


def _is_plain(value: object) -> bool:
    """Return whether a value is a setting: a number, a text, None, or a sequence of settings."""
    if isinstance(value, (tuple, list)):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, (bool, int, float, str))


def _set_threshold(detector: Any, threshold: float | None) -> Any:
    """Return a copy of the detector with this threshold, or the detector itself if it has no threshold to set."""
    if threshold is not None and hasattr(detector, "threshold"):
        detector = copy(detector)
        detector.threshold = threshold
    return detector


def _search_current_folder() -> None:
    """Let imports find modules in the current folder, after all other places, so that none of them is replaced."""
    if str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))


def _import_attribute(path: str) -> Any:
    """Return the object that ``MODULE:ATTR`` names."""
    module, _, attribute = path.partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    except ModuleNotFoundError as error:
        raise DataError(f"detector {path!r}: there is no module {error.name!r}") from None
    except (Exception, SystemExit) as error:
        if not isinstance(error, AttributeError) or hasattr(sys.modules.get(module), attribute):
            problem = f"{type(error).__name__}: {in_one_line(error)}"
            raise DataError(f"detector {path!r}: module {module!r} cannot be imported, {problem}") from None
        raise DataError(f"detector {path!r}: module {module!r} has no attribute {attribute!r}") from None


def in_one_line(error: BaseException) -> str:
    """Return the text of an error without line breaks."""
    return " ".join(str(error).split())
