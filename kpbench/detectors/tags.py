"""Detectors of tags, for comparison with patches: one detector for each board of :data:`kpbench.patches.TAG_BOARDS`.

Settings are the libraries' defaults, except for the settings named below. These exceptions favour the tags. They were
chosen on scenes whose seed differs from the benchmark's seed (docs/explanation/fairness-to-tags.md). The detectors of
ArUco and AprilTag do not know the board: they report every tag of their dictionary.
"""

from __future__ import annotations

import cv2
import numpy as np

from kpbench.errors import DataError
from kpbench.images import to_grey
from kpbench.patches.tag_boards import charuco_pattern, tag_dictionary
from kpbench.types import Detections, UInt8

APRILTAG_DECIMATION = 1.5
"""Factor by which the AprilTag library shrinks the image. The library detects fewer tags with a factor of 1 or 2."""
LEAST_APRILTAG_SIDE_PX = 8
"""The shorter side of an image must have at least this many px. A smaller image has no detections, as the library
crashes on tiny images."""


class ArucoDetector:
    """OpenCV's ArUco detector.

    Corners are refined by lines fitted to the edges. With OpenCV's other refinements, the detector finds fewer tags.
    """

    name = board = "aruco"
    version = f"OpenCV {cv2.__version__}"

    def __init__(self) -> None:
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
        self._detector = cv2.aruco.ArucoDetector(tag_dictionary("aruco"), parameters)

    def detect(self, image: UInt8) -> Detections:
        """Return the corners of all tags in one image, uint8 (H, W) or RGB (H, W, 3); each has the score 1."""
        corners, ids, _ = self._detector.detectMarkers(to_grey(image))
        if ids is None or not len(ids):
            return Detections.none()
        # this refinement puts (0, 0) on the outer corner of the top-left pixel, as the AprilTag library does
        xy = np.concatenate([quad[0] for quad in corners]).astype(np.float64) - 0.5
        return Detections(xy, np.ones(len(xy)), np.asarray(4 * ids.reshape(-1, 1) + np.arange(4), np.int64))


class AprilTagDetector:
    """The AprilTag library's own detector. It detects more tags than OpenCV's detector with the same dictionary.

    Raises
    ------
    DataError
        If the library is not installed.
    """

    name = board = "apriltag"

    def __init__(self) -> None:
        try:
            from importlib.metadata import version

            from apriltag import apriltag

            self.version = f"apriltag-python {version('apriltag-python')}"
        except ImportError:
            raise DataError("apriltag needs one more package: pip install 'kpbench[apriltag]'") from None
        self._detector = apriltag("tag36h11", decimate=APRILTAG_DECIMATION)

    def detect(self, image: UInt8) -> Detections:
        """Return the corners of all tags in one image, uint8 (H, W) or RGB; the score is the decision margin."""
        grey = np.ascontiguousarray(to_grey(image))
        found = self._detector.detect(grey) if min(grey.shape) >= LEAST_APRILTAG_SIDE_PX else ()
        if not found:
            return Detections.none()
        # The library puts (0, 0) on the outer corner of the top-left pixel. The board is drawn from OpenCV's
        # dictionary, in which the tags are upside down. OpenCV's first corner, the top left, is therefore the library's
        # right bottom (rb).
        xy = np.concatenate([tag["lb-rb-rt-lt"][[1, 0, 3, 2]] for tag in found]) - 0.5
        score = np.repeat([tag["margin"] for tag in found], 4)
        return Detections(xy, score, np.concatenate([4 * tag["id"] + np.arange(4) for tag in found]))


class CharucoDetector:
    """OpenCV's ChArUco detector, set to search a second time for missed markers."""

    name = board = "charuco"
    version = f"OpenCV {cv2.__version__}"

    def __init__(self) -> None:
        parameters = cv2.aruco.CharucoParameters()
        parameters.tryRefineMarkers = True
        self._detector = cv2.aruco.CharucoDetector(charuco_pattern(), parameters)

    def detect(self, image: UInt8) -> Detections:
        """Return the inner corners of the board in one image, uint8 (H, W) or RGB; each has the score 1."""
        corners, ids, _, _ = self._detector.detectBoard(to_grey(image))
        if ids is None or not len(ids):
            return Detections.none()
        return Detections(np.asarray(corners, np.float64).reshape(-1, 2), np.ones(len(ids)), np.asarray(ids, np.int64))
