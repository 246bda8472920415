"""A user's own albumentations pipeline, applied to a scene with its truth carried along.

The library can move keypoints itself, but not to this toolkit's accuracy: its resizing transforms are off by half
a pixel times the change of scale, and its distortions lose points. So the coordinates of all pixels go through the
pipeline as a mask, resampled as the image is, and a homography fitted to where the pixels of a disc came from
carries the whole patch.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.degrade.weather import albumentations
from kpbench.errors import DataError
from kpbench.files import read_text
from kpbench.geometry.homography import project
from kpbench.render.scene import Placement
from kpbench.types import UInt8

WHOLE = 0.999
"""Least share of a pixel that came from the image and not from what a transform filled in."""
LEAST_PIXELS = 12
"""Of a disc, below which it counts as gone."""


def load_augmentation(path: str | Path) -> str:
    """The pipeline in a file that ``albumentations.save`` wrote, JSON or YAML, as canonical JSON.

    Raises
    ------
    DataError
        If the file cannot be read, or holds no pipeline that the installed albumentations can build.
    """
    text = read_text(path, DataError)
    try:
        content = _yaml(text) if Path(path).suffix.lower() in (".yaml", ".yml") else json.loads(text)
        canonical = json.dumps(content, sort_keys=True)
        _pipeline(canonical)
    except Exception as error:  # whatever a parser or a transform's own checks raise
        said = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise DataError(f"{path}: no pipeline as albumentations.save writes it ({said})") from None
    return canonical


def _yaml(text: str) -> Any:
    import yaml  # type: ignore[import-untyped]  # albumentations brings it

    return yaml.safe_load(text)


@lru_cache(maxsize=4)
def _pipeline(canonical: str) -> Any:
    A = albumentations()
    built = A.Compose([A.from_dict(json.loads(canonical))])
    _interpolate_masks(built)
    return built


def _interpolate_masks(transform: Any) -> None:
    """Have a pipeline resample masks as it does images; it takes the nearest pixel otherwise."""
    for part in getattr(transform, "transforms", ()):
        _interpolate_masks(part)
    if hasattr(transform, "mask_interpolation"):
        transform.mask_interpolation = cv2.INTER_LINEAR


def augment(
    image: UInt8, placements: Sequence[Placement], pipeline: str, seed: int
) -> tuple[UInt8, list[Placement | None]]:
    """Send a scene through a pipeline.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    placements : the patches in it.
    pipeline : as :func:`load_augmentation` gives it.
    seed : of all that the pipeline draws.

    Returns
    -------
    image : ndarray of the same shape, uint8
    placements : at their new poses; None where the centre is no longer in the image.

    Raises
    ------
    DataError
        If a transform raises, gives an image of another shape or type, or mirrors a patch, which makes it another
        design.
    """
    transform, origin = _pipeline(pipeline), _origin(image.shape[0], image.shape[1])
    transform.set_random_seed(seed)
    try:
        done = transform(image=image, mask=origin)
    except Exception as error:  # whatever a transform raises
        said = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        hint = "; some transforms work with --channels 3 only" if image.ndim == 2 else ""
        raise DataError(f"--augment: {said}{hint}") from None
    result, came_from = np.ascontiguousarray(done["image"]), done["mask"]
    if result.shape != image.shape or result.dtype != np.uint8:
        given, asked = (f"{'x'.join(map(str, a.shape[1::-1]))} {a.dtype}" for a in (result, image))
        raise DataError(f"--augment: makes {given} of {asked}; end the pipeline with a resize or crop to that size")
    if np.array_equal(came_from, origin):
        return result, list(placements)
    return result, [_carried(placement, came_from) for placement in placements]


@lru_cache(maxsize=2)
def _origin(height: int, width: int) -> NDArray[np.float32]:
    """Where each pixel is, in px, and a one to tell it from what a transform fills in: (H, W, 3)."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def _carried(placement: Placement, came_from: NDArray[np.float32]) -> Placement | None:
    """A patch after the move that took each pixel of an image from where ``came_from`` says; None if it has gone."""
    H = placement.H_patch2image
    to_patch = np.linalg.inv(H)
    u, v, w = np.moveaxis(came_from @ to_patch.T.astype(np.float32), -1, 0)
    on_disc = (u * u + v * v <= w * w) & (came_from[..., 2] > WHOLE) & (w > 0)
    rows, columns = np.nonzero(on_disc)
    if len(rows) < LEAST_PIXELS:
        return None
    here, there = np.column_stack([columns, rows]).astype(np.float64), came_from[rows, columns, :2].astype(np.float64)
    middle = here.mean(axis=0)  # fitted from here, which is well conditioned
    fitted = cv2.findHomography(there - H[:2, 2], here - middle, 0)[0]
    if fitted is None:
        return None
    found = np.asarray(fitted, np.float64)
    if np.linalg.det(found[:2, :2]) < 0:
        raise DataError(
            "--augment: mirrors or tears patches, which makes them other designs; leave flips, D4 and shuffles out"
        )
    # where the move is no homography, the centre counts
    inner = np.argsort((u * u + v * v)[rows, columns] / (w * w)[rows, columns])[:LEAST_PIXELS]
    left = (here[inner] - middle - project(found, there[inner] - H[:2, 2])).mean(axis=0)
    before, after = np.eye(3), np.eye(3)
    before[:2, 2], after[:2, 2] = -H[:2, 2], middle + left
    pose = after @ found @ before @ H
    pose = pose / pose[2, 2]
    height, width = came_from.shape[:2]
    x, y = pose[:2, 2]
    if not (-0.5 <= x < width - 0.5 and -0.5 <= y < height - 0.5):
        return None
    return replace(placement, H_patch2image=pose)
