"""CSV and COCO: a value is read exactly, or its line is named. Nothing is read as something else."""

import json
import warnings

import cv2
import numpy as np
import pytest
from helpers import kpbench
from PIL import Image

from kpbench import read_predictions
from kpbench.errors import DataError, KpbenchWarning, PredictionsError
from kpbench.predictions import open_coco

HEAD = "image_id,x,y,score,id\n"


def read(folder, text):
    path = folder / "p.csv"
    path.write_bytes(text.encode())
    return read_predictions(path)


@pytest.mark.parametrize(
    "header", ["image_id, x, y, score, id", " image_id ,x,\ty,score , id", "image_id,x,y,score,id"]
)
@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize(
    "row", ["0, 10.5, 20.25, 0.9, 1", "0,10.5,20.25,0.9,1", "0 ,10.5 , 20.25,0.9 ,1 ", "0.0,10.5,20.25,.9,1e0"]
)
def test_spaces_around_names_and_numbers_are_left_out(tmp_path, header, ending, row):
    found = read(tmp_path, header + ending + row + ending)
    assert (found.image_id.tolist(), found.patch_id.tolist()) == ([0], [1])
    assert (found.xy.tolist(), found.score.tolist()) == ([[10.5, 20.25]], [0.9])


@pytest.mark.parametrize("value", [9007199254740993, 2**63 - 1, 2**53 + 1, 0])
def test_an_image_id_of_64_bits_is_exact_beside_one_with_a_point(tmp_path, value):
    assert read(tmp_path, f"image_id,x,y\n{value},1,2\n1.0,3,4\n").image_id.tolist() == sorted([value, 1])


REFUSED = [
    ("9223372036854775808,1,2,1,0", "image_id is '9223372036854775808', expected a whole number under"),
    ("123456789012345678901234567890,1,2,1,0", "image_id is '123456789012345678901234567890'"),
    ("1e-400,1,2,1,0", "image_id is '1e-400', expected a whole number"),
    ("1,1,2,1,1e-400", "id is '1e-400', expected a whole number"),
    ("1,1,2,1,0.5", "id is '0.5', expected a whole number"),
    ("1,1,2,1,9007199254740993", "id is '9007199254740993', expected a whole number under 9007199254740992"),
    ("1,1,2,1,1e999999999", "id is '1e999999999', expected a whole number"),
    ("1,1,2,1,nan", "id is 'nan', expected a whole number"),
    ("1,1,2,1,1_0", "id is '1_0', expected a whole number"),
    ("1,1,2,1,\u0661", "expected a whole number"),
    ("1,1,2,1,true", "id is 'true', expected a whole number"),
    ("1,1e999,2,1,0", "x is inf, expected a finite number"),
    (",1,2,1,0", "image_id is '', expected a whole number"),
    ("1,1,2", "has 3 values, expected 5"),
    ("1", "has 1 values, expected 5"),
    ("1,1,2,1,0,0", "has 6 values, expected 5"),
    ("", "has 0 values, expected 5"),
    ("-1,1,2,1,0", "image_id is -1, expected 0 or more"),
    ("1,1,2,1,-1", "id is -1.0, expected a patch id"),
    ("1,1,,1,0", "y is blank, expected a finite number"),
]


@pytest.mark.parametrize("comment", ["", '# {"schema": "kpbench.predictions/1"}\n'])
@pytest.mark.parametrize(("row", "problem"), REFUSED)
def test_a_bad_row_is_one_line_with_its_place(tmp_path, comment, row, problem):
    with pytest.raises(PredictionsError) as error:
        read(tmp_path, f"{comment}{HEAD}0,1,2,1,0\n{row}\n2,1,2,1,0\n")
    message = str(error.value)
    assert message.startswith(f"{tmp_path / 'p.csv'}: line {4 if comment else 3}")
    assert problem in message
    assert "\n" not in message


def test_a_last_line_without_its_end_is_said_and_read(tmp_path):
    with pytest.warns(KpbenchWarning, match=r"p\.csv: the last line has no line end; it may be cut off"):
        assert read(tmp_path, "image_id,x,y\n0,1,2\n1,99.123,4").xy.tolist() == [[1, 2], [99.123, 4]]
    with pytest.raises(PredictionsError, match="line 3 has 2 values, expected 3"):
        read(tmp_path, "image_id,x,y\n0,1,2\n1,99.123")


# --- COCO ----------------------------------------------------------------------------------------------------------

ONE = {"id": 1, "image_id": 1, "category_id": 1, "keypoints": [3, 4, 2], "num_keypoints": 1, "radius": 2}


def coco(folder, annotations, **image):
    content = {"images": [{"id": 1, "file_name": "1.jpg", **image}], "annotations": annotations, "categories": []}
    (folder / "truth.json").write_text(json.dumps(content))
    return folder / "truth.json"


@pytest.mark.parametrize("given", [{}, {"radius": None}, {"radius_major": None}, {"radius": 2}])
@pytest.mark.parametrize("place", [[0, 0, 0], [3, 4, 0]])
def test_v_0_is_no_keypoint_with_and_without_a_radius(tmp_path, given, place):
    unlabelled = {k: v for k, v in ONE.items() if k != "radius"} | {"keypoints": place} | given
    truth = open_coco(coco(tmp_path, [unlabelled | {"id": 5}, ONE, unlabelled | {"id": 6}])).truth
    assert truth.keypoints[["x", "y", "radius_major"]].tolist() == [(3, 4, 2)]


@pytest.mark.parametrize("v", [1, 2])
def test_a_labelled_keypoint_needs_its_radius(tmp_path, v):
    with pytest.raises(DataError, match=r"annotations\[0\] \(image_id 1\): has no radius"):
        open_coco(coco(tmp_path, [{k: w for k, w in ONE.items() if k != "radius"} | {"keypoints": [3, 4, v]}]))


def photo(path, orientation):
    """A photograph of 60 x 40 stored pixels."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(np.full((40, 60, 3), 90, np.uint8)).save(path, exif=exif)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("folder", ["", "images"])
def test_truth_in_the_other_orientation_is_said(tmp_path, orientation, folder):
    (tmp_path / folder).mkdir(exist_ok=True)
    photo(tmp_path / folder / "1.jpg", orientation)
    height, width = cv2.imread(str(tmp_path / folder / "1.jpg")).shape[:2]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read = open_coco(coco(tmp_path, [ONE], width=width, height=height)).image(0)
    assert read.shape == (height, width, 3)
    with pytest.warns(
        KpbenchWarning, match=f"1.jpg is {height} x {width} there, but {width} x {height} when it is read"
    ):
        open_coco(coco(tmp_path, [ONE], width=height, height=width))


def test_the_score_command_says_it_in_one_line(here):
    photo(here / "1.jpg", 6)
    coco(here, [ONE], width=60, height=40)
    (here / "p.csv").write_text("image_id,x,y,score,id\n1,3,4,1,0\n")
    lines = kpbench("score", "p.csv", "--gt", "truth.json").stderr.splitlines()
    assert sum("1.jpg is 60 x 40 there, but 40 x 60" in line for line in lines) == 1
