"""Degrade the user's own image files."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from kpbench.degrade.effects import Effect
from kpbench.degrade.ladder import apply_effects, draw_effect
from kpbench.errors import DataError, KpbenchWarning
from kpbench.files import make_folder
from kpbench.images import (
    UNDECODABLE,
    ImageSource,
    drawing_name,
    encode_png,
    open_images,
    refuse_same_folder,
    require_drawable,
)
from kpbench.seeds import stage_rng
from kpbench.types import UInt8
from kpbench.writing import write_file

DEGRADED = "degraded"
"""Kind of the degraded images."""
MOST_WARNINGS = 5
"""Largest number of images that cannot be read and are warned of one by one."""


def open_own_images(source: str | Path, out: str | Path) -> ImageSource:
    """Open an image, a folder of images or a video; the degraded images will be written to the folder ``out``.

    If ``out`` lies below the folder of the images, the images in ``out`` are left out.

    Returns
    -------
    ImageSource
        For :func:`degrade_files`.

    Raises
    ------
    DataError
        If the source cannot be opened or is a dataset, ``out`` is the folder of the images, or ``out`` holds a file
        that must not be replaced.

    Examples
    --------
    >>> import cv2, numpy as np
    >>> import kpbench
    >>> cv2.imwrite("wall.png", np.full((30, 40), 90, np.uint8))
    True
    >>> kpbench.degrade.open_own_images("wall.png", "degraded").length
    1
    """
    if (Path(source) / "dataset.json").exists():
        raise DataError(f"{source}: a dataset, expected images; `suite` degrades a dataset")
    refuse_same_folder(source, Path(out))
    images = open_images(str(source), exclude=Path(out))
    require_drawable(Path(out), images.names, DEGRADED)
    return images


def degrade_files(
    source: ImageSource, out: str | Path, steps: Sequence[tuple[str, float]], seed: int = 0
) -> Iterator[tuple[Path, list[Effect]]]:
    """Degrade images one by one, and write each as PNG into ``out``, with the name and subfolder of the image.

    A written image depends only on the image, the image's position in the source, the steps and the seed.

    Parameters
    ----------
    source : ImageSource
        From :func:`open_own_images`.
    out : str or Path
        Folder, made if missing. The folder must not be the folder of the images.
    steps : sequence of (str, float)
        Effects, as keys of :data:`kpbench.degrade.LADDER`, each with a level. The effects are applied in order.
    seed : int

    Yields
    ------
    path : Path
        The file that was written.
    effects : list of dict
        The effects that were applied, see :func:`kpbench.degrade.draw_effect`.

    Raises
    ------
    DataError
        If an effect is unknown, a level is out of bounds, or a file cannot be written. If an image cannot be read,
        a warning names the image, and the error is raised after all other images are written.

    Examples
    --------
    >>> import cv2, numpy as np
    >>> from kpbench.degrade import degrade_files, open_own_images
    >>> cv2.imwrite("wall.png", np.full((30, 40), 90, np.uint8))
    True
    >>> for path, effects in degrade_files(open_own_images("wall.png", "degraded"), "degraded", [("blur", 7)]):
    ...     print(path, effects)
    degraded/wall.png [{'effect': 'blur', 'kernel_px': 7}]
    """
    broken: list[tuple[str, str]] = []
    for n, (name, image) in enumerate(source.images):
        if image is None:
            broken.append((name, source.problems.get(name, UNDECODABLE)))
            continue
        image = _as_grey_if_colourless(image)
        rng = stage_rng(seed, n, 0)
        effects = [draw_effect(rng, effect, level, (image.shape[1], image.shape[0])) for effect, level in steps]
        image = apply_effects(image, rng, effects)
        target = Path(out, drawing_name(name))
        make_folder(target.parent)
        write_file(target, encode_png(image, DEGRADED))
        yield target, effects
    if broken:
        for line in source.describe_failures(broken)[:MOST_WARNINGS]:
            warnings.warn(line, KpbenchWarning, stacklevel=2)
        raise DataError(f"{out}: lacks {len(broken)} images, which cannot be read; the others are done")


def _as_grey_if_colourless(image: UInt8) -> UInt8:
    """Return an RGB image as grey if its channels are equal, so that the file of a grey image stays grey."""
    if (image == image[..., :1]).all():
        return np.ascontiguousarray(image[..., 0])
    return image
