"""Detectors of tags, for comparison with patches, on the boards of :data:`kpbench.patches.TAG_BOARDS`.

Every detector runs at its best operating point. ``benchmarks/experiments/tune_rivals.py`` chose it, on scenes whose
seed differs from the benchmark's seed (docs/explanation/fairness-to-tags.md). The detectors of ArUco and AprilTag tags
do not know the board: they report every tag of their dictionary.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

import cv2
import numpy as np

from kpbench.errors import DataError
from kpbench.images import to_grey
from kpbench.patches.tag_boards import charuco_pattern, tag_dictionary
from kpbench.types import Detections, UInt8

ARUCO_SETTINGS: dict[str, Any] = {
    "cornerRefinementMethod": cv2.aruco.CORNER_REFINE_APRILTAG,
    "aprilTagQuadDecimate": 1.5,
    "aprilTagQuadSigma": 0.8,
    "perspectiveRemoveIgnoredMarginPerCell": 0.25,
    "maxErroneousBitsInBorderRate": 0.5,
}
"""Fields of OpenCV's ``DetectorParameters`` for the board ``aruco``, where they differ from OpenCV's defaults."""
CHARUCO_SETTINGS: dict[str, Any] = {
    "tryRefineMarkers": True,
    "minMarkers": 1,
    "adaptiveThreshWinSizeMax": 43,
    "adaptiveThreshWinSizeStep": 8,
    "adaptiveThreshConstant": 3,
    "maxErroneousBitsInBorderRate": 0.5,
}
"""Fields of OpenCV's ``CharucoParameters`` and ``DetectorParameters`` for the board ``charuco``, in the same way."""
APRILTAG_SETTINGS: dict[str, Any] = {"decimate": 1.5, "blur": 0.8, "maxhamming": 2}
"""Arguments of the AprilTag library, where they differ from the library's defaults."""
NAPA_SETTINGS: dict[str, Any] = {"min_tag_px": 24, "min_contrast": 5}
"""Arguments of ``napa_vision.NapaDetector``, in the same way."""
LOCUS_SETTINGS: dict[str, Any] = {
    "profile": "standard",
    "threshold.mode": "LocalMean",
    "threshold.noise_k": 3.0,
    "threshold.enable_sharpening": False,
    "decoder.max_hamming_error": 1,
    "segmentation.connectivity": "Eight",
}
"""Settings of ``locus``: its profile, ``decimation``, and fields of its groups as ``GROUP.FIELD``."""
LEAST_APRILTAG_SIDE_PX = 8
"""The shorter side of an image must have at least this many px. A smaller image has no detections, as the library
crashes on tiny images."""
PIXEL_CORNER_PX = 0.5
"""Some libraries put (0, 0) on the outer corner of the top-left pixel, not on its centre: their positions are larger by
this much in x and y."""


def _opencv_parameters(settings: Mapping[str, Any], *objects: Any) -> None:
    """Set each field on the first of OpenCV's objects that has it."""
    for name, value in settings.items():
        setattr(next(o for o in objects if hasattr(o, name)), name, value)


def _corners_of(ids: Any, corners: Any, score: Any) -> Detections:
    """Return four detections a tag, from the tags' IDs (n,), corners (n, 4, 2) and scores (n,)."""
    corner_ids = 4 * np.asarray(ids, np.int64).reshape(-1, 1) + np.arange(4)
    return Detections(np.asarray(corners, np.float64).reshape(-1, 2), np.repeat(score, 4), corner_ids.ravel())


class ArucoDetector:
    """OpenCV's ArUco detector. ``settings`` holds fields of ``DetectorParameters``."""

    name = board = "aruco"
    version = f"OpenCV {cv2.__version__}"

    def __init__(self, settings: Mapping[str, Any] = ARUCO_SETTINGS) -> None:
        self.settings = tuple(sorted(settings.items()))
        parameters = cv2.aruco.DetectorParameters()
        _opencv_parameters(settings, parameters)
        # this refinement counts as the AprilTag library does, from which it was taken
        uses_apriltag = parameters.cornerRefinementMethod == cv2.aruco.CORNER_REFINE_APRILTAG
        self._offset_px = PIXEL_CORNER_PX if uses_apriltag else 0.0
        self._detector = cv2.aruco.ArucoDetector(tag_dictionary("aruco"), parameters)

    def detect(self, image: UInt8) -> Detections:
        """Return the corners of all tags in one image, uint8 (H, W) or RGB (H, W, 3); each has the score 1."""
        corners, ids, _ = self._detector.detectMarkers(to_grey(image))
        if ids is None or not len(ids):
            return Detections.none()
        return _corners_of(ids, np.concatenate(corners).astype(np.float64) - self._offset_px, np.ones(len(ids)))


class AprilTagDetector:
    """The AprilTag library's own detector. ``settings`` holds arguments of the library.

    Raises
    ------
    DataError
        If the library is not installed.
    """

    name = board = "apriltag"

    def __init__(self, settings: Mapping[str, Any] = APRILTAG_SETTINGS) -> None:
        try:
            from apriltag import apriltag
        except ImportError:
            raise _lacking("apriltag") from None
        self.version = f"apriltag-python {version('apriltag-python')}"
        self.settings = tuple(sorted(settings.items()))
        self._detector = apriltag("tag36h11", **settings)

    def detect(self, image: UInt8) -> Detections:
        """Return the corners of all tags in one image, uint8 (H, W) or RGB; the score is the decision margin."""
        grey = np.ascontiguousarray(to_grey(image))
        found = self._detector.detect(grey) if min(grey.shape) >= LEAST_APRILTAG_SIDE_PX else ()
        if not found:
            return Detections.none()
        # The board is drawn from OpenCV's dictionary, in which the tags are upside down. OpenCV's first corner, the top
        # left, is therefore the library's right bottom (rb).
        corners = np.stack([tag["lb-rb-rt-lt"][[1, 0, 3, 2]] for tag in found]) - PIXEL_CORNER_PX
        return _corners_of([tag["id"] for tag in found], corners, [tag["margin"] for tag in found])


class NapaDetector:
    """The detector of the package napa-vision, for AprilTag tags. ``settings`` holds arguments of its ``NapaDetector``.

    The licence of napa-vision, PolyForm Noncommercial, permits noncommercial use only.

    Raises
    ------
    DataError
        If the package is not installed.
    """

    name, board = "napa", "apriltag"

    def __init__(self, settings: Mapping[str, Any] = NAPA_SETTINGS) -> None:
        try:
            from napa_vision.napa_detector import NapaDetector as Library
        except ImportError:
            raise _lacking("napa") from None
        self.version = f"napa-vision {version('napa-vision')}"
        self.settings = tuple(sorted(settings.items()))
        with warnings.catch_warnings():  # NumPy's, about the layout of a C structure
            warnings.simplefilter("ignore", RuntimeWarning)
            self._detector = Library(**settings)

    def detect(self, image: UInt8) -> Detections:
        """Return the corners of all tags in one image, uint8 (H, W) or RGB; the score is the decision margin."""
        found = self._detector.detect(np.ascontiguousarray(to_grey(image)))
        if not found:
            return Detections.none()
        return _corners_of([t.tag_id for t in found], [t.corners for t in found], [t.decision_margin for t in found])


class LocusDetector:
    """The detector of the package locus-tag, for AprilTag tags, on one thread.

    ``settings`` holds ``profile``, ``decimation``, and fields of the profile's groups, such as ``quad.min_area``.

    Raises
    ------
    DataError
        If the package is not installed.
    """

    name, board = "locus", "apriltag"

    def __init__(self, settings: Mapping[str, Any] = LOCUS_SETTINGS) -> None:
        try:
            import locus
        except ImportError:
            raise _lacking("locus") from None
        self.version = f"locus-tag {version('locus-tag')}"
        self.settings = tuple(sorted(settings.items()))
        content = locus.DetectorConfig.from_profile(settings["profile"]).model_dump(mode="json")
        for key in settings.keys() - {"profile", "decimation"}:
            group, field = key.split(".")
            content[group][field] = settings[key]
        config = locus.DetectorConfig.model_validate(content)
        self._detector = locus.Detector(config=config, decimation=settings.get("decimation"), threads=1)

    def detect(self, image: UInt8) -> Detections:
        """Return the corners of all tags in one image, uint8 (H, W) or RGB; the score falls with every wrong bit."""
        found = self._detector.detect(np.ascontiguousarray(to_grey(image)))
        if not len(found.ids):
            return Detections.none()
        return _corners_of(found.ids, found.corners - PIXEL_CORNER_PX, 1 - found.error_rates.astype(np.float64))


def _lacking(extra: str) -> DataError:
    return DataError(f"{extra} needs one more package: pip install 'kpbench[{extra}]'")


class CharucoDetector:
    """OpenCV's ChArUco detector. ``settings`` holds fields of ``CharucoParameters`` and of ``DetectorParameters``."""

    name = board = "charuco"
    version = f"OpenCV {cv2.__version__}"

    def __init__(self, settings: Mapping[str, Any] = CHARUCO_SETTINGS) -> None:
        self.settings = tuple(sorted(settings.items()))
        board, markers = cv2.aruco.CharucoParameters(), cv2.aruco.DetectorParameters()
        _opencv_parameters(settings, board, markers)
        self._detector = cv2.aruco.CharucoDetector(charuco_pattern(), board, markers)

    def detect(self, image: UInt8) -> Detections:
        """Return the inner corners of the board in one image, uint8 (H, W) or RGB; each has the score 1."""
        corners, ids, _, _ = self._detector.detectBoard(to_grey(image))
        if ids is None or not len(ids):
            return Detections.none()
        return Detections(np.asarray(corners, np.float64).reshape(-1, 2), np.ones(len(ids)), np.asarray(ids, np.int64))
