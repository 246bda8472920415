"""Find the images of predictions in a dataset: the fingerprint is checked, then file names, then image IDs."""

from __future__ import annotations

import re
import warnings

import numpy as np

from kpbench.errors import DataError, KpbenchWarning, PredictionsError
from kpbench.scoring.file_names import find_by_name, require_agreement
from kpbench.types import Int, Predictions, Truth


def find_images(truth: Truth, predictions: Predictions, allow_missing: bool) -> Int:
    """Return the index in the truth of each detection's image, of shape (D,).

    Raises
    ------
    PredictionsError
        If the fingerprints and the digests of the truth differ, file names and image IDs contradict each other, an
        image is unknown, or an image is missing and ``allow_missing`` is False.
    DataError
        If two images of the dataset share an image_id.
    """
    named = predictions.fingerprint or predictions.dataset or ""
    has_fingerprints = bool(re.fullmatch("[0-9a-f]{64}", named) and truth.fingerprint)
    if has_fingerprints and named != truth.fingerprint:
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
    by_id = np.where(np.append(ids, -1)[place] == predictions.image_id, np.append(order, -1)[place], -1)
    image = find_by_name(truth, predictions, by_id)
    if image is None:
        image = by_id
    elif problem := require_agreement(truth, predictions, image, by_id, has_fingerprints):
        warnings.warn(problem, KpbenchWarning, stacklevel=4)
    unknown = image < 0
    if unknown.any():
        raise PredictionsError(
            f"image_id {predictions.image_id[unknown].min()} is not in the dataset ({len(ids)} images, image_id "
            f"{ids[0]} to {ids[-1]}); {np.count_nonzero(unknown)} predictions are of unknown images"
        )
    missing = np.ones(len(ids), bool)
    missing[image] = False
    if missing.any() and not allow_missing:
        raise PredictionsError(
            f"no prediction for image_id {truth.image_id[missing].min()}; {np.count_nonzero(missing)} of {len(ids)} "
            "images are missing (`allow_missing=True` takes them as images without detections)"
        )
    return np.repeat(image, np.diff(predictions.offsets))


def warn_of_ids(truth: Truth, predictions: Predictions, matched: int) -> None:
    """Warn if nothing matches and the images were matched by IDs that nothing confirms."""
    if truth.file is None or predictions.file is not None or predictions.fingerprint == truth.fingerprint:
        return
    if len(predictions.xy) and len(truth.keypoints) and not matched:
        warnings.warn(
            "no detection matches a true keypoint; the predictions have no file names, so images are matched by "
            "image_id: check that an image_id means the same image in the predictions and in the dataset",
            KpbenchWarning,
            stacklevel=4,
        )
