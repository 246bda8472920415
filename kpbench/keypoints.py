"""The two tables that pass between the stages: true keypoints and detections.

They are defined here, below everything that makes or reads them, so that the evaluator never
needs the generator.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["KEYPOINT_DTYPE", "Detections", "Float", "Truth", "UInt8"]

Float = NDArray[np.float64]
UInt8 = NDArray[np.uint8]

KEYPOINT_DTYPE = np.dtype(
    [
        ("x", "<f8"),  # px; the centre of the top-left pixel is (0, 0), x right, y down
        ("y", "<f8"),
        ("patch_id", "<i2"),
        ("radius_major", "<f4"),  # px, semi-axes of the projected disc
        ("radius_minor", "<f4"),
        ("axis_angle", "<f4"),  # degrees from +x towards +y, of the major axis, in [0, 180)
        ("H_patch2image", "<f8", (3, 3)),  # unit disc (patch frame) to px
        ("visible", "<f4"),  # fraction of the disc inside the image and not occluded
        ("contrast", "<f4"),  # grey levels, white minus black, after deterioration
    ]
)
"""One true keypoint: the record type of ``/keypoints`` in a shard."""


@dataclass(frozen=True)
class Detections:
    """What a detector found in one image.

    Attributes
    ----------
    xy : ndarray of shape (n, 2), float64, px in the pixel convention of :mod:`kpbench.geometry`.
    score : ndarray of shape (n,), float64, higher is surer.
    patch_id : ndarray of shape (n,), int64, or None from a detector that tells no identities.

    Raises
    ------
    ValueError
        If the shapes do not agree.
    """

    xy: Float
    score: Float
    patch_id: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "xy", np.asarray(self.xy, np.float64).reshape(-1, 2))
        set_(self, "score", np.asarray(self.score, np.float64).reshape(-1))
        if self.patch_id is not None:
            set_(self, "patch_id", np.asarray(self.patch_id, np.int64).reshape(-1))
        ids = len(self.xy) if self.patch_id is None else len(self.patch_id)
        if not len(self.xy) == len(self.score) == ids:
            raise ValueError(f"{len(self.xy)} points, {len(self.score)} scores and {ids} ids do not belong together")

    def __len__(self) -> int:
        return len(self.xy)

    def __getitem__(self, keep: Any) -> Detections:
        """The detections that a mask, slice or index array keeps."""
        ids = None if self.patch_id is None else self.patch_id[keep]
        return Detections(self.xy[keep], self.score[keep], ids)

    @classmethod
    def none(cls, with_ids: bool = True) -> Detections:
        """No detection at all."""
        empty = np.zeros(0, np.int64) if with_ids else None
        return cls(np.zeros((0, 2)), np.zeros(0), empty)


@dataclass(frozen=True)
class Truth:
    """The true keypoints of N images, as one table; image ``i`` owns rows ``offsets[i]:offsets[i + 1]``.

    Attributes
    ----------
    image_id : ndarray of shape (N,), int64, unique.
    offsets : ndarray of shape (N + 1,), int64.
    keypoints : ndarray of shape (offsets[-1],), :data:`KEYPOINT_DTYPE`.
    condition : ndarray of shape (N,), str; "" where the images belong to no condition.
    rung : ndarray of shape (N,), float64; the severity within the condition, nan where there is none.
    scene_id : ndarray of shape (N,), int64; images of one base scene share it (bootstrap clusters).
    fingerprint : str
        The dataset's fingerprint, "" if it has none.
    """

    image_id: NDArray[np.int64]
    offsets: NDArray[np.int64]
    keypoints: NDArray[Any]
    condition: NDArray[np.str_]
    rung: Float
    scene_id: NDArray[np.int64]
    fingerprint: str = ""

    def __len__(self) -> int:
        return len(self.image_id)
