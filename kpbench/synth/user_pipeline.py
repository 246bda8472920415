"""The user's own albumentations pipeline, applied to a scene and to its truth.

Albumentations can move keypoints itself, but not as accurately as kpbench needs. Its resizing transforms are off
by half a pixel times the change of scale, and its distortions lose points. Instead, the coordinates of all pixels
go through the pipeline as a mask, which is resampled like the image. A homography, fitted to the coordinates
within a disc, then moves the whole patch.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError
from kpbench.files import read_text
from kpbench.geometry.homography import project
from kpbench.memory import limit_process
from kpbench.render.placement import Placement
from kpbench.types import UInt8
from kpbench.yaml_text import parse_yaml

LEAST_IMAGE_SHARE = 0.999
"""A homography is fitted only to pixels of which more than this fraction comes from the original image."""
LEAST_DISC_PIXELS = 12
"""Fewest pixels of a disc to which a homography is fitted; a patch with fewer pixels counts as outside the image."""

PIPELINE_BYTES, PIPELINE_BYTES_PER_PIXEL = 2**30, 100
"""Memory that a pipeline may take for an image, bytes: in all, and in addition per pixel of the image."""
PIPELINE_SECONDS = 5
"""Processor time that a pipeline may take for two images of up to a megapixel, s; more for larger images."""


def _import_albumentations() -> Any:
    """Import albumentations and return the module.

    The import is slow and is therefore made at the first use. ``NO_ALBUMENTATIONS_UPDATE`` stops albumentations from
    looking online for a newer version.
    """
    os.environ["NO_ALBUMENTATIONS_UPDATE"] = "1"
    import albumentations

    return albumentations


def load_augmentation(path: str | Path) -> str:
    """Read a pipeline from a file that ``albumentations.save`` wrote.

    Parameters
    ----------
    path : str or Path
        A file of JSON, or of YAML if its name ends in .yaml or .yml.

    Returns
    -------
    str
        The pipeline as canonical JSON, for :class:`SynthConfig`.

    Raises
    ------
    DataError
        If the file cannot be read, or holds no pipeline that the installed albumentations can build.

    Examples
    --------
    >>> from pathlib import Path
    >>> from kpbench.synth import load_augmentation
    >>> text = '{"transform": {"__class_fullname__": "Rotate", "limit": [-20, 20], "p": 1.0}}'
    >>> _ = Path("pipeline.json").write_text(text)
    >>> load_augmentation("pipeline.json") == text
    True
    """
    text = read_text(path, DataError)
    try:
        content = parse_yaml(text) if Path(path).suffix.lower() in (".yaml", ".yml") else json.loads(text)
        canonical = json.dumps(content, sort_keys=True)
        _build_pipeline(canonical)
    except Exception as error:  # a parser or a transform's own checks may raise anything
        problem = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise DataError(f"{path}: no pipeline as albumentations.save writes it ({problem})") from None
    return canonical


@lru_cache(maxsize=4)
def _build_pipeline(canonical: str) -> Any:
    library = _import_albumentations()
    pipeline = library.Compose([library.from_dict(json.loads(canonical))])
    _interpolate_masks(pipeline)
    return pipeline


def _interpolate_masks(transform: Any) -> None:
    """Make a pipeline interpolate masks linearly; by default, albumentations takes the nearest pixel."""
    for part in getattr(transform, "transforms", ()):
        _interpolate_masks(part)
    if hasattr(transform, "mask_interpolation"):
        transform.mask_interpolation = cv2.INTER_LINEAR


@lru_cache(maxsize=4)
def try_pipeline(pipeline: str, size_px: tuple[int, int], channels: int) -> None:
    """Run a pipeline on two images in a child process, with every transform applied, within limits.

    Raises
    ------
    DataError
        If :func:`run_pipeline` raises the error, or the pipeline takes too much time or memory.
    """
    seconds = PIPELINE_SECONDS * max(1.0, size_px[0] * size_px[1] / 1e6)
    words = [sys.executable, "-I", "-c", _TRIAL, *sys.path]
    given = json.dumps([pipeline, seconds, [size_px[1], size_px[0], *([3] if channels == 3 else [])]])
    env = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(words, input=given.encode(), capture_output=True, env=env, timeout=60 + 10 * seconds)
        reply = done.stdout.decode(errors="replace").strip() if not done.returncode else None
    except subprocess.TimeoutExpired:
        reply = None
    if reply:
        raise DataError(reply.splitlines()[-1])
    if reply is None:
        memory = (PIPELINE_BYTES + PIPELINE_BYTES_PER_PIXEL * size_px[0] * size_px[1]) >> 20
        raise DataError(
            f"`augmentation`: takes more than {seconds:.0f} s or {memory} MiB for two images of "
            f"{size_px[0]}x{size_px[1]}, or ends the process"
        )


_TRIAL = "import sys; sys.path[:0] = sys.argv[1:]; from kpbench.synth.user_pipeline import run_trial; run_trial()"


def run_trial() -> None:
    """Run the pipeline that :func:`try_pipeline` sends, and print what is wrong. This is the child process."""
    pipeline, seconds, shape = json.load(sys.stdin)
    certain = json.dumps(json.loads(pipeline, object_hook=_make_certain), sort_keys=True)
    _build_pipeline(certain)
    cv2.setNumThreads(1)
    limit_process(PIPELINE_BYTES + PIPELINE_BYTES_PER_PIXEL * shape[0] * shape[1], seconds)
    try:
        for seed in range(2):
            run_pipeline(np.random.default_rng(seed).integers(0, 256, shape, np.uint8), [], certain, seed)
    except (DataError, MemoryError) as error:
        print(str(error) or "`augmentation`: takes too much memory")


def _make_certain(table: dict[str, Any]) -> dict[str, Any]:
    """Let a transform of a pipeline always be applied, unless it never is."""
    return table | {"p": 1.0} if table.get("p") else table


def run_pipeline(
    image: UInt8, placements: Sequence[Placement], pipeline: str, seed: int
) -> tuple[UInt8, list[Placement | None]]:
    """Send a scene through a pipeline.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    placements : sequence of Placement
        The patches in the image.
    pipeline : str
        From :func:`load_augmentation`.
    seed : int
        Seed of the pipeline's random numbers.

    Returns
    -------
    image : ndarray of the same shape, uint8
    placements : list of (Placement or None)
        The same patches at their new poses; None for a patch whose centre has left the image.

    Raises
    ------
    DataError
        If a transform fails, changes the shape or type of the image, or mirrors a patch. A mirrored patch is another
        design.
    """
    transform, coordinates = _build_pipeline(pipeline), _pixel_coordinates(image.shape[0], image.shape[1])
    transform.set_random_seed(seed)
    try:
        output = transform(image=image, mask=coordinates)
    except Exception as error:  # a transform may raise anything
        problem = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        hint = "; some transforms work with `channels=3` only" if image.ndim == 2 and "memory" not in problem else ""
        raise DataError(f"`augmentation`: {problem}{hint}") from None
    result, source_px = np.ascontiguousarray(output["image"]), output["mask"]
    if result.shape != image.shape or result.dtype != np.uint8:
        given, expected = (f"{'x'.join(map(str, a.shape[1::-1]))} {a.dtype}" for a in (result, image))
        raise DataError(
            f"`augmentation`: makes {given} of {expected}; end the pipeline with a resize or crop to that size"
        )
    if np.array_equal(source_px, coordinates):
        return result, list(placements)
    return result, [_move_placement(placement, source_px) for placement in placements]


@lru_cache(maxsize=2)
def _pixel_coordinates(height: int, width: int) -> NDArray[np.float32]:
    """Return x, y and 1 for each pixel, shape (H, W, 3); x and y are in px, the 1 marks a pixel of the image."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def _move_placement(placement: Placement, source_px: NDArray[np.float32]) -> Placement | None:
    """Return a patch at the pose to which the pipeline has moved the patch's pixels.

    Parameters
    ----------
    placement : Placement
    source_px : ndarray of shape (H, W, 3), float32
        :func:`_pixel_coordinates` after the pipeline: the former position of each pixel's content.

    Returns
    -------
    Placement or None
        None if the patch's centre has left the image.
    """
    H = placement.H_patch2image
    H_image2patch = np.linalg.inv(H)
    u, v, w = np.moveaxis(source_px @ H_image2patch.T.astype(np.float32), -1, 0)
    on_disc = (u * u + v * v <= w * w) & (source_px[..., 2] > LEAST_IMAGE_SHARE) & (w > 0)
    rows, columns = np.nonzero(on_disc)
    if len(rows) < LEAST_DISC_PIXELS:
        return None
    after, before = np.column_stack([columns, rows]).astype(np.float64), source_px[rows, columns, :2].astype(np.float64)
    middle = after.mean(axis=0)  # both sets of points are centred, which keeps the fit well conditioned
    fit = cv2.findHomography(before - H[:2, 2], after - middle, 0)[0]
    if fit is None:
        return None
    H_move = np.asarray(fit, np.float64)
    if np.linalg.det(H_move[:2, :2]) < 0:
        raise DataError(
            "`augmentation`: mirrors or tears patches, which makes them other designs; leave flips, D4 and shuffles out"
        )
    # if the move is no homography, the pixels nearest to the patch's centre determine the new centre
    innermost = np.argsort((u * u + v * v)[rows, columns] / (w * w)[rows, columns])[:LEAST_DISC_PIXELS]
    residual = (after[innermost] - middle - project(H_move, before[innermost] - H[:2, 2])).mean(axis=0)
    to_patch_centre, from_middle = np.eye(3), np.eye(3)
    to_patch_centre[:2, 2], from_middle[:2, 2] = -H[:2, 2], middle + residual
    pose = from_middle @ H_move @ to_patch_centre @ H
    pose = pose / pose[2, 2]
    height, width = source_px.shape[:2]
    x, y = pose[:2, 2]
    if not (-0.5 <= x < width - 0.5 and -0.5 <= y < height - 0.5):
        return None
    return replace(placement, H_patch2image=pose)
