"""The OpenCV that is in use: its version decides pixels and detections."""

from __future__ import annotations

import warnings
from importlib import metadata

from kpbench.errors import KpbenchWarning

TESTED_MAJOR = 4
"""kpbench is tested with this major version. OpenCV 5 gave 739 detections where OpenCV 4 gave 745."""
PACKAGES = (
    "opencv-python-headless",
    "opencv-python",
    "opencv-contrib-python-headless",
    "opencv-contrib-python",
)
"""Packages that install the module ``cv2``. Several side by side overwrite each other's files."""


def opencv_version() -> str:
    """Return the version of the OpenCV that is imported, whatever package installed it."""
    import cv2

    return str(cv2.__version__)


def processor_features() -> str:
    """Return the instructions of the processor that OpenCV uses."""
    import cv2

    return str(cv2.getCPUFeaturesLine())


def warn_of_opencv() -> None:
    """Warn if OpenCV is not of the tested major version, or if packages of several versions are installed."""
    installed = {}
    for name in PACKAGES:
        try:
            installed[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    version = opencv_version()
    problems = []
    if version.split(".")[0] != str(TESTED_MAJOR):
        problems.append(f"kpbench is tested with OpenCV {TESTED_MAJOR}")
    if len(set(installed.values())) > 1:
        problems.append(f"{', '.join(map(' '.join, installed.items()))} are installed side by side, keep one")
    if problems:
        warnings.warn(
            f"OpenCV {version} is in use: {'; '.join(problems)}; pixels and detections may differ",
            KpbenchWarning,
            stacklevel=3,
        )
