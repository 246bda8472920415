"""Detectors of tags, each for its own board of :mod:`kpbench.patches`: what a patch is to be compared with.

Settings are the libraries' own but for those named below, which were chosen on scenes of another seed than the
benchmark's, for the tags' good (docs/explanation/fairness-to-tags.md). Nothing is told about the board in the scene:
any tag of the dictionary is reported.
"""

from __future__ import annotations

import cv2
import numpy as np

from kpbench.errors import DataError
from kpbench.images import to_grey
from kpbench.patches.tag_boards import charuco_pattern, tag_dictionary
from kpbench.types import Detections, UInt8


class ArucoDetector:
    """OpenCV's ArUco detector, corners refined with lines along the edges, which detects most of its ways.

    OpenCV took that refinement from the AprilTag library, and left the frame of the corners as it was there: (0, 0)
    on the corner of the top-left pixel. Here it is put right.
    """

    name = board = "aruco"
    version = f"OpenCV {cv2.__version__}"

    def __init__(self) -> None:
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
        self._detector = cv2.aruco.ArucoDetector(tag_dictionary("aruco"), parameters)

    def detect(self, image: UInt8) -> Detections:
        """Corners of all tags in one image, uint8 (H, W) or RGB (H, W, 3); each has the score 1."""
        corners, ids, _ = self._detector.detectMarkers(to_grey(image))
        if ids is None or not len(ids):
            return Detections.none()
        xy = np.concatenate([quad[0] for quad in corners]).astype(np.float64) - 0.5
        return Detections(xy, np.ones(len(xy)), np.asarray(4 * ids.reshape(-1, 1) + np.arange(4), np.int64))


SMALLEST_PX = 8
"""Side of the smallest image that :class:`AprilTagDetector` looks at."""


class AprilTagDetector:
    """The AprilTag library's own detector (``pip install apriltag-python``).

    It detects more than OpenCV's detector of the same tags, and more with a decimation of 1.5 than of 1 or 2.

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
        self._detector = apriltag("tag36h11", decimate=1.5)

    def detect(self, image: UInt8) -> Detections:
        """Corners of all tags in one image, uint8 (H, W) or RGB (H, W, 3); the score is the decision margin."""
        grey = np.ascontiguousarray(to_grey(image))
        # of a few px the library makes none, which ends the process; no tag is as small
        found = self._detector.detect(grey) if min(grey.shape) >= SMALLEST_PX else ()
        if not found:
            return Detections.none()
        # The library counts from the corner of the top-left pixel, and its tags stand on their heads in OpenCV's
        # dictionary, from which the board is drawn: from OpenCV's top left on, its corners are rb, lb, lt, rt
        xy = np.concatenate([tag["lb-rb-rt-lt"][[1, 0, 3, 2]] for tag in found]) - 0.5
        score = np.repeat([tag["margin"] for tag in found], 4)
        return Detections(xy, score, np.concatenate([4 * tag["id"] + np.arange(4) for tag in found]))


class CharucoDetector:
    """OpenCV's ChArUco detector, with its search for the markers that were missed at first."""

    name = board = "charuco"
    version = f"OpenCV {cv2.__version__}"

    def __init__(self) -> None:
        parameters = cv2.aruco.CharucoParameters()
        parameters.tryRefineMarkers = True
        self._detector = cv2.aruco.CharucoDetector(charuco_pattern(), parameters)

    def detect(self, image: UInt8) -> Detections:
        """Inner corners of the board in one image, uint8 (H, W) or RGB (H, W, 3); each has the score 1."""
        corners, ids, _, _ = self._detector.detectBoard(to_grey(image))
        if ids is None or not len(ids):
            return Detections.none()
        return Detections(np.asarray(corners, np.float64).reshape(-1, 2), np.ones(len(ids)), np.asarray(ids, np.int64))
