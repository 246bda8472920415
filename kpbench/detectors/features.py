"""OpenCV's ORB and SIFT, general detectors for comparison. Their points have no identities.

Neither detector knows the patches, so most points are false alarms. ORB runs with OpenCV's defaults, which allow 500
points per image. SIFT runs with OpenCV's defaults and the same limit.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from kpbench.images import to_grey
from kpbench.types import Detections, UInt8

LEAST_IMAGE_PX = 8
"""OpenCV's pyramids need a shorter side of at least this many px. A smaller image has no detections."""


def orb(image: UInt8) -> Detections:
    """Return the ORB points in one image, uint8 (H, W) or RGB (H, W, 3), strongest first, without identities."""
    return _detect_points(cv2.ORB.create(), image)


def sift(image: UInt8) -> Detections:
    """Return the SIFT points in one image, uint8 (H, W) or RGB (H, W, 3), strongest first, without identities."""
    return _detect_points(cv2.SIFT.create(nfeatures=500), image)


def _by_strength(point: cv2.KeyPoint) -> tuple[float, Sequence[float]]:
    return -point.response, point.pt


def _detect_points(detector: cv2.Feature2D, image: UInt8) -> Detections:
    """Return each place once; OpenCV repeats a place that has several orientations."""
    grey = to_grey(image)
    found = sorted(detector.detect(grey, None) if min(grey.shape) >= LEAST_IMAGE_PX else (), key=_by_strength)
    strongest: dict[tuple[float, float], float] = {}
    for point in found:
        strongest.setdefault((point.pt[0], point.pt[1]), point.response)
    return Detections(np.array(list(strongest)).reshape(-1, 2), np.array(list(strongest.values())), None)
