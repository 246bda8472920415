"""Samples as arrays of equal shapes, from which loaders build batches."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.types import UInt8


def pad_sample(image: UInt8, keypoints: NDArray[Any], image_id: int, rows: int) -> dict[str, NDArray[Any]]:
    """Return a labelled image as arrays whose shapes do not depend on the number of its keypoints.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    keypoints : ndarray of shape (n,), KEYPOINT_DTYPE
    image_id : int
    rows : int
        Number of rows of every column of keypoints, n or more.

    Returns
    -------
    dict of str to ndarray
        ``image``, uint8, shape (1, H, W) or (3, H, W); ``image_id``, int64, shape (). The columns of the keypoints,
        with the units of :data:`kpbench.KEYPOINT_DTYPE`: ``xy``, px, shape (rows, 2); ``patch_id``, int64, shape
        (rows,); ``H_patch2image``, shape (rows, 3, 3); ``radius_major``, ``radius_minor``, ``axis_angle``, ``visible``
        and ``contrast``, shape (rows,). Columns of measured numbers are float32. Rows after the n-th have the patch_id
        -1 and zeros.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.dataset import pad_sample
    >>> image, keypoints = kpbench.open_dataset("kpbench-data")[0]
    >>> sample = pad_sample(image, keypoints, image_id=0, rows=12)
    >>> sample["image"].shape, sample["xy"].shape
    ((1, 480, 640), (12, 2))
    """
    planes = image[None] if image.ndim == 2 else image.transpose(2, 0, 1)
    padded = np.zeros(rows, keypoints.dtype)
    padded[: len(keypoints)] = keypoints
    padded["patch_id"][len(keypoints) :] = -1
    columns = {name: padded[name].astype(np.float32) for name in keypoints.dtype.names or () if name not in _NOT_REAL}
    return {
        "image": np.ascontiguousarray(planes),
        "image_id": np.array(image_id, np.int64),
        "xy": np.column_stack([padded["x"], padded["y"]]).astype(np.float32),
        "patch_id": padded["patch_id"].astype(np.int64),
        **columns,
    }


_NOT_REAL = ("x", "y", "patch_id")
"""Columns of keypoints that :func:`pad_sample` does not copy under their own names as float32."""
