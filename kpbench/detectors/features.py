"""ORB and SIFT as OpenCV has them: points without identities, as a measure of what a general detector finds.

Neither knows what a patch is, so most of what they return are false alarms. Defaults of OpenCV; both give at
most 500 points.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from kpbench.images import to_grey
from kpbench.types import Detections, UInt8


def orb(image: UInt8) -> Detections:
    """Detections without identities of one image, uint8 (H, W) or RGB (H, W, 3), strongest first."""
    return _points(cv2.ORB.create(), image)


def sift(image: UInt8) -> Detections:
    """Detections without identities of one image, uint8 (H, W) or RGB (H, W, 3), strongest first."""
    return _points(cv2.SIFT.create(nfeatures=500), image)


SMALLEST_PX = 8
"""Side of the smallest image that is looked at: of a few px OpenCV's pyramids have none."""


def _strongest(point: cv2.KeyPoint) -> tuple[float, Sequence[float]]:
    return -point.response, point.pt


def _points(detector: cv2.Feature2D, image: UInt8) -> Detections:
    """Each place once: one with several directions is several features, but one point."""
    grey = to_grey(image)
    found = sorted(detector.detect(grey, None) if min(grey.shape) >= SMALLEST_PX else (), key=_strongest)
    strongest: dict[tuple[float, float], float] = {}
    for point in found:
        strongest.setdefault((point.pt[0], point.pt[1]), point.response)
    return Detections(np.array(list(strongest)).reshape(-1, 2), np.array(list(strongest.values())), None)
