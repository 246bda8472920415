"""Match the images of predictions to the images of a dataset by the names of their files.

Names are compared by the parts between slashes. Two names agree if they are equal, or if one ends with all parts of the
other: ``photos/a.png`` agrees with ``a.png`` and with ``/data/photos/a.png``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kpbench.errors import PredictionsError
from kpbench.types import Int, Predictions, Truth

SEVERAL = -2
"""Stands for the index of an image if several images have the name."""
ADVICE = "give both the same names, or leave `file` out of the predictions to match images by image_id"

Parts = tuple[str, ...]


def find_by_name(truth: Truth, predictions: Predictions, by_id: Int) -> Int | None:
    """Return the index in the truth of each image of the predictions, from its file name, of shape (N,).

    Parameters
    ----------
    truth : Truth
    predictions : Predictions
    by_id : ndarray of shape (N,), int64
        Index in the truth of the image with the same image_id; -1 for none. Images without a file name get this index.

    Returns
    -------
    ndarray of shape (N,), int64, or None
        None if one of the sides has no names, or if images share a name, as the frames of a film do.

    Raises
    ------
    PredictionsError
        If the dataset does not have a name, or has it several times.
    """
    names = predictions.file
    if truth.file is None or names is None:
        return None
    if all(k >= 0 and name == truth.file[k] for name, k in zip(names, by_id.tolist(), strict=True)):
        return by_id
    parts = [_split(name) for name in names]
    known = [_split(name) for name in truth.file]
    for given in (parts, known):
        some = [name for name in given if name]
        if len(set(some)) < len(some):
            return None
    whole = {name: n for n, name in enumerate(known) if name}
    endings = _index_endings(known)
    found = by_id.copy()
    for n, name in enumerate(parts):
        if name:
            found[n] = _find(name, whole, endings)
            if found[n] < 0:
                raise _describe_unknown(
                    truth.file, names[n], int(predictions.image_id[n]), int(by_id[n]), int(found[n])
                )
    return found


def _split(name: str) -> Parts:
    return tuple(part for part in name.replace("\\", "/").split("/") if part not in ("", "."))


def _index_endings(names: Sequence[Parts]) -> dict[Parts, int]:
    """Return the index of the name that has each ending, or SEVERAL."""
    endings: dict[Parts, int] = {}
    for n, name in enumerate(names):
        for k in range(len(name)):
            endings[name[k:]] = SEVERAL if name[k:] in endings else n
    return endings


def _find(name: Parts, whole: dict[Parts, int], endings: dict[Parts, int]) -> int:
    """Return the index of the name that agrees; -1 for none, SEVERAL for several."""
    if name in whole:
        return whole[name]
    if name in endings:
        return endings[name]
    return next((whole[name[k:]] for k in range(1, len(name)) if name[k:] in whole), -1)


def _describe_unknown(known: Sequence[str], name: str, image_id: int, by_id: int, found: int) -> PredictionsError:
    has = "has several times" if found == SEVERAL else "does not have"
    own = f" (its image_id {image_id} is {known[by_id]!r})" if by_id >= 0 and known[by_id] else ""
    return PredictionsError(f"image_id {image_id} is of the file {name!r}, which the dataset {has}{own}; {ADVICE}")


def require_agreement(truth: Truth, predictions: Predictions, image: Int, by_id: Int, is_same: bool) -> str:
    """Return a warning if names and IDs mean different images, else "".

    Parameters
    ----------
    image, by_id : ndarray of shape (N,), int64
        Index in the truth of each image of the predictions, by name and by ID.
    is_same : bool
        Whether a fingerprint shows that the predictions were made for this dataset, so that the IDs must be right.

    Raises
    ------
    PredictionsError
        If names and IDs contradict each other: the IDs must be right, or two predictions are of one image.
    """
    assert truth.file is not None
    assert predictions.file is not None
    count = np.bincount(image[image >= 0], minlength=len(truth))
    if count.max(initial=0) > 1:
        k = int(np.argmax(count))
        ids = predictions.image_id[image == k][:2].tolist()
        raise PredictionsError(f"image_id {ids[0]} and {ids[1]} are both of the file {truth.file[k]!r}; {ADVICE}")
    differs = np.flatnonzero(image != by_id)
    if not len(differs):
        return ""
    n = int(differs[0])
    image_id, name = predictions.image_id[n], predictions.file[n]
    own = f"is {truth.file[by_id[n]]!r} in the dataset" if by_id[n] >= 0 else "is not in the dataset"
    problem = f"image_id {image_id} is {name!r} in the predictions and {own}"
    if is_same:
        raise PredictionsError(f"{problem}, although both have one fingerprint; {ADVICE}")
    return f"images are matched by file name, as {problem} ({len(differs)} of {len(image)} images differ so)"
