"""Split the images of a dataset into training and validation, by scene."""

from __future__ import annotations

import hashlib

import numpy as np

from kpbench.errors import DataError
from kpbench.types import Truth

SPLITS = ("train", "val")
VAL_SHARE = 0.2
"""Default share of the scenes that are for validation."""


def split_scenes(truth: Truth, val_share: float = VAL_SHARE) -> list[str]:
    """Return the split of each image, "train" or "val". All images of a scene are in one split.

    The scenes with the least SHA-256 of their numbers are for validation. The split depends on the scenes and on
    nothing else, so two exports of a dataset split it alike.

    Parameters
    ----------
    truth : Truth
    val_share : float
        Share of the scenes that are for validation, from 0 to less than 1. Any share over 0 gives at least one scene to
        each split.

    Raises
    ------
    DataError
        If the share is out of its range, or there is one scene, which cannot be split.

    Examples
    --------
    >>> from kpbench import open_dataset
    >>> from kpbench.dataset import split_scenes
    >>> split_scenes(open_dataset("kpbench-data").truth, val_share=0.3)
    ['train', 'train', 'train', 'val', 'val', 'train']
    """
    if not 0 <= val_share < 1:
        raise DataError(f"`val_share` is {val_share:g}, expected a share from 0 to less than 1")
    scenes = np.unique(truth.scene_id).tolist()
    if val_share and len(scenes) == 1:
        raise DataError("all images show one scene, which cannot be split; expected `val_share` 0, or more scenes")
    count = min(max(round(val_share * len(scenes)), 1), len(scenes) - 1) if val_share else 0
    chosen = {*sorted(scenes, key=_digest)[:count]}
    return [SPLITS[scene in chosen] for scene in truth.scene_id.tolist()]


def _digest(scene: int) -> bytes:
    return hashlib.sha256(str(scene).encode()).digest()
