"""Check that predictions belong to a dataset: first by fingerprint, then by the truth's digest, then by image IDs."""

from __future__ import annotations

import re
import warnings

import numpy as np

from kpbench.errors import DataError, KpbenchWarning, PredictionsError
from kpbench.types import Int, Predictions, Truth


def find_images(truth: Truth, predictions: Predictions, allow_missing: bool) -> Int:
    """Return the index in the truth of each detection's image, of shape (D,).

    Raises
    ------
    PredictionsError
        If the fingerprints and the digests of the truth differ, an image is unknown, or an image is missing and
        ``allow_missing`` is False.
    DataError
        If two images of the dataset share an image_id.
    """
    named = predictions.fingerprint or predictions.dataset or ""
    if re.fullmatch("[0-9a-f]{64}", named) and truth.fingerprint and named != truth.fingerprint:
        if not truth.digest or predictions.truth_digest != truth.digest:
            raise PredictionsError(
                f"made for the dataset with fingerprint {named[:12]}…, but this dataset's is {truth.fingerprint[:12]}…"
            )
        warnings.warn(
            "the predictions were made on the same scenes with other pixels, which other software made: "
            f"the fingerprints are {named[:12]}… and {truth.fingerprint[:12]}…, the truth is the same",
            KpbenchWarning,
            stacklevel=4,
        )
    order = np.argsort(truth.image_id, kind="stable")
    ids = truth.image_id[order]
    if np.any(ids[1:] == ids[:-1]):
        raise DataError(f"the dataset has image_id {ids[:-1][ids[1:] == ids[:-1]][0]} twice")
    place = np.searchsorted(ids, predictions.image_id)
    unknown = np.append(ids, -1)[place] != predictions.image_id
    if unknown.any():
        raise PredictionsError(
            f"image_id {predictions.image_id[unknown].min()} is not in the dataset ({len(ids)} images, image_id "
            f"{ids[0]} to {ids[-1]}); {np.count_nonzero(unknown)} predictions are of unknown images"
        )
    missing = np.ones(len(ids), bool)
    missing[place] = False
    if missing.any() and not allow_missing:
        raise PredictionsError(
            f"no prediction for image_id {ids[missing][0]}; {np.count_nonzero(missing)} of {len(ids)} images are "
            "missing (`allow_missing=True` takes them as images without detections)"
        )
    return np.repeat(order[place], np.diff(predictions.offsets))
