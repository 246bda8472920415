"""Detectors of tags, to compare patches with; each is for its own board of :data:`kpbench.patches.TAG_BOARDS`.

Settings are the libraries' defaults, but for those named below. These were chosen in favour of the tags, on scenes of
another seed than the benchmark's (docs/explanation/fairness-to-tags.md). The detectors do not know the board: every tag
of the dictionary is reported.
"""

from __future__ import annotations

import cv2
import numpy as np

from kpbench.errors import DataError
from kpbench.images import to_grey
from kpbench.patches.tag_boards import charuco_pattern, tag_dictionary
from kpbench.types import Detections, UInt8

APRILTAG_DECIMATION = 1.5
"""Factor by which the AprilTag library shrinks the image; it detects more tags with it than with 1 or 2."""
LEAST_APRILTAG_SIDE_PX = 8
"""The AprilTag library ends the process on an image of a few px. No tag is as small as this."""


class ArucoDetector:
    """OpenCV's ArUco detector.

    Corners are refined with lines along the edges, which detects more than OpenCV's other refinements.
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
        # this refinement has (0, 0) on the corner of the top-left pixel, as the AprilTag library that it comes from
        xy = np.concatenate([quad[0] for quad in corners]).astype(np.float64) - 0.5
        return Detections(xy, np.ones(len(xy)), np.asarray(4 * ids.reshape(-1, 1) + np.arange(4), np.int64))


class AprilTagDetector:
    """The AprilTag library's own detector; it detects more than OpenCV's detector of the same tags.

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
        # The library has (0, 0) on the corner of the top-left pixel, and its tags are upside down in OpenCV's
        # dictionary, from which the board is drawn. From OpenCV's top left on, its corners are rb, lb, lt, rt.
        xy = np.concatenate([tag["lb-rb-rt-lt"][[1, 0, 3, 2]] for tag in found]) - 0.5
        score = np.repeat([tag["margin"] for tag in found], 4)
        return Detections(xy, score, np.concatenate([4 * tag["id"] + np.arange(4) for tag in found]))


class CharucoDetector:
    """OpenCV's ChArUco detector; it searches a second time for markers that it missed at first."""

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
