"""Images are matched by file name where both sides have names; what contradicts is said."""

import dataclasses
import json
import warnings

import numpy as np
import pytest

from kpbench.errors import KpbenchWarning, PredictionsError
from kpbench.predictions import open_coco
from kpbench.scoring.scores import score
from kpbench.types import KEYPOINT_DTYPE, Detections, Predictions, Truth

NAMES = ("blur-3/a.png", "blur-3/b.png", "blur-7/a.png", "blur-7/b.png")


def truth_of(order=(0, 1, 2, 3), names=NAMES, **about):
    """Truth whose image k is of the file ``names[order[k]]``, with one keypoint, whose place depends on the file."""
    keypoints = np.zeros(4, KEYPOINT_DTYPE)
    keypoints["x"] = keypoints["y"] = 100 * (np.array(order) + 1)
    keypoints["radius_major"] = keypoints["radius_minor"] = 10
    file = None if names is None else tuple(names[n] for n in order)
    return Truth(
        np.arange(4), np.arange(5), keypoints, np.array([""] * 4), np.full(4, np.nan), np.arange(4), file=file, **about
    )


def predictions_of(file=NAMES, image_id=None, **about):
    found = [Detections([[100.0 * n, 100.0 * n]], [1], [0]) for n in (1, 2, 3, 4)]
    return Predictions.from_detections(found, image_id, file=file, **about)


def quietly(truth, predictions, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return score(truth, predictions, resamples=0, **options)["detection_score"]


@pytest.mark.parametrize("prefix", ["", "./", "/data/set/", "C:\\set\\"])
def test_names_that_agree_are_matched_in_silence(prefix):
    assert quietly(truth_of(), predictions_of([prefix + name for name in NAMES])) == 1
    assert quietly(truth_of(names=[prefix + name for name in NAMES]), predictions_of()) == 1


@pytest.mark.parametrize("ids", [None, [70, 80, 90, 100]])
def test_another_order_of_the_truth_is_found_by_name_and_said(ids):
    with pytest.warns(
        KpbenchWarning, match=r"matched by file name, as image_id (0|70) is 'blur-3/a.png' in the pred.* 4"
    ):
        scores = score(truth_of((3, 2, 1, 0)), predictions_of(image_id=ids), resamples=0)
    assert scores["detection_score"] == 1


def test_another_order_without_names_is_said_where_nothing_matches():
    with pytest.warns(KpbenchWarning, match="no detection matches .* check that an image_id means the same image"):
        assert score(truth_of((3, 2, 1, 0)), predictions_of(None), resamples=0)["detection_score"] == 0
    assert quietly(truth_of((3, 2, 1, 0), names=None), predictions_of()) == 0  # there is nothing to compare
    assert quietly(truth_of((0, 1, 3, 2)), predictions_of(None)) == 0.5


@pytest.mark.parametrize(
    ("names", "problem"),
    [
        (
            ("x.png", *NAMES[1:]),
            "image_id 0 is of the file 'x.png', which the dataset does not have (its image_id 0 is",
        ),
        (("a.png", *NAMES[1:]), "image_id 0 is of the file 'a.png', which the dataset has several times (its image_id"),
        ((NAMES[1], "", *NAMES[2:]), "image_id 0 and 1 are both of the file 'blur-3/b.png'"),
        ((NAMES[0], "/y/" + NAMES[0], *NAMES[2:]), "image_id 0 and 1 are both of the file 'blur-3/a.png'"),
    ],
)
def test_a_contradiction_is_an_error_that_says_what_to_do(names, problem):
    with pytest.raises(PredictionsError) as error:
        quietly(truth_of(), predictions_of(names), allow_missing=True)
    assert str(error.value).startswith(problem)
    assert str(error.value).endswith("leave `file` out of the predictions to match images by image_id")


def test_names_against_a_fingerprint_that_agrees_are_an_error():
    truth = truth_of((1, 0, 2, 3), fingerprint="a" * 64)
    with pytest.raises(PredictionsError, match=r"'blur-3/b\.png' in the dataset, although both have one fingerprint"):
        quietly(truth, predictions_of(fingerprint="a" * 64))


def test_images_that_share_a_name_are_matched_by_id():
    assert quietly(truth_of(), predictions_of(["film.mp4"] * 4, frame_index=[0, 1, 2, 3])) == 1
    assert quietly(truth_of(names=["a.png"] * 4), predictions_of()) == 1


def test_a_missing_image_is_missing_by_name_too():
    part = dataclasses.replace(predictions_of(), image_id=[0, 1, 2, 9], file=(*NAMES[:3], ""))
    with pytest.raises(PredictionsError, match="image_id 9 is not in the dataset"):
        quietly(truth_of(), part)
    found = [Detections([[100.0, 100.0]], [1], [0])]
    one = Predictions.from_detections(found, [2], file=["a.png"])
    names = ("c/a.png", "c/b.png", "c/c.png", "c/d.png")
    with pytest.warns(KpbenchWarning), pytest.raises(PredictionsError, match="no prediction for image_id 1; 3 of 4"):
        score(truth_of(names=names), one)
    with pytest.warns(KpbenchWarning, match="1 of 1 images differ"):
        assert score(truth_of(names=names), one, allow_missing=True, resamples=0)["detection_score"] == 0.25


def test_another_order_of_coco_annotations_changes_no_score(tmp_path):
    truths = []
    for name, ids in (("one", [0, 1, 2, 3]), ("other", [3, 2, 1, 0])):
        images = [{"id": k, "file_name": file} for k, file in zip(ids, NAMES, strict=True)]
        annotations = [
            {"id": k, "image_id": k, "category_id": 1, "radius": 10, "keypoints": [100 * n, 100 * n, 2]}
            for n, k in enumerate(ids, 1)
        ]
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps({"images": images[:: 1 - 2 * (name == "other")], "annotations": annotations}))
        truths.append(open_coco(path))
    assert quietly(truths[0], predictions_of()) == 1
    with pytest.warns(KpbenchWarning, match="matched by file name"):
        assert score(truths[1], predictions_of(), resamples=0)["detection_score"] == 1
