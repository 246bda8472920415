"""Degrade images of the user's."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kpbench.degrade.ladder import apply, climb
from kpbench.errors import DataError
from kpbench.files import make_folder, write_atomic
from kpbench.images import ImageSource, encode_png
from kpbench.seeds import stream


def degrade_files(
    source: ImageSource, out: Path, steps: Sequence[tuple[str, float]], seed: int = 0
) -> Iterator[tuple[Path, list[dict[str, Any]]]]:
    """Degrade images one by one and write them as PNG under their own names, with the folders they are in.

    Parameters
    ----------
    source : from :func:`kpbench.images.open_images`; what cannot be decoded is named at the end.
    out : folder, made if it is not there; not the one that the images are in.
    steps : (effect, level) of :data:`kpbench.degrade.LADDER`, applied in order.
    seed : the n-th image written is a function of the n-th image, the steps, the seed and n.

    Yields
    ------
    path : the file that was written.
    effects : what was applied, see :func:`kpbench.degrade.climb`.

    Raises
    ------
    DataError
        If an effect is not known, a level is out of range, a file cannot be written, or, after all others
        are done, if images could not be decoded.
    """
    broken = []
    for n, (name, image) in enumerate(source.images):
        if image is None:
            broken.append(name)
            continue
        if (image == image[..., :1]).all():  # grey, whatever the file's mode
            image = np.ascontiguousarray(image[..., 0])
        rng = stream(seed, n, 0)
        effects = [climb(rng, effect, level, (image.shape[1], image.shape[0])) for effect, level in steps]
        image = apply(image, rng, effects)
        target = out / name if name.endswith(".png") else out / f"{name}.png"
        make_folder(target.parent)
        write_atomic(target, encode_png(image))
        yield target, effects
    if broken:
        raise DataError(f"{len(broken)} images cannot be decoded, the others are done: {', '.join(broken[:5])}")
