"""COCO annotations with values that no keypoint has are refused, or warned of, by one rule; a key twice is refused."""

import json
import re
import warnings

import pytest
from helpers import kpbench as run

from kpbench import export_dataset, read_predictions, write_predictions
from kpbench.errors import DataError, KpbenchError, KpbenchWarning
from kpbench.files import DoubleKeyError, load_json
from kpbench.predictions import open_coco
from kpbench.printing import correct_sidecars, print_patches
from kpbench.types import Detections, Predictions

IMAGE = {"id": 1, "file_name": "1.png", "width": 640, "height": 480}
ANNOTATION = {"id": 1, "image_id": 1, "category_id": 1, "keypoints": [10.0, 20.0, 2], "radius": 5.0}


def coco(folder, annotations=(ANNOTATION,), images=(IMAGE,)):
    path = folder / "truth.json"
    path.write_text(json.dumps({"images": [*images], "annotations": [*annotations]}))
    return path


def at(x, y, v=2, **more):
    return ANNOTATION | {"id": None, "keypoints": [x, y, v]} | more


REFUSED = {
    "v of 7": ([at(1, 2, 7)], "visibility v of keypoints is 7, expected 0, 1 or 2"),
    "v of -1": ([at(1, 2, -1)], "visibility v of keypoints is -1, expected 0, 1 or 2"),
    "v of 0.5": ([at(1, 2, 0.5)], "visibility v of keypoints is 0.5, expected 0, 1 or 2"),
    "v of NaN": ([at(1, 2, float("nan"))], "visibility v of keypoints is nan"),
    "x of 1e308": ([at(1e308, 2)], "expected finite numbers up to 1000000"),
    "y of -1e7": ([at(1, -1e7)], "expected finite numbers up to 1000000"),
    "radius of 1e308": ([at(1, 2, radius=1e308)], "the radius is inf"),
    "major axis of 1e308": ([at(1, 2, radius_major=1e308)], "the radius is inf"),
    "minor axis of 1e308": ([at(1, 2, radius_minor=1e308)], "expected finite numbers up to"),
    "radius of 0": ([at(1, 2, radius=0)], "a radius over 0"),
    "angle of 1e308": ([at(1, 2, axis_angle=1e308)], "axis_angle is inf, expected degrees"),
    "visible of -1e308": ([at(1, 2, visible=-1e308)], "visible is -inf, expected a fraction"),
    "one id twice": (
        [ANNOTATION, at(3, 4, id=2), at(5, 6, id=1)],
        r"annotations\[2\] has the id 1 of annotations\[0\]",
    ),
    "one text id twice": ([at(3, 4, id="a"), at(5, 6, id="a")], r"annotations\[1\] has the id 'a' of annotations\[0\]"),
    "one place twice": ([at(1, 2), at(3, 4), at(1, 2)], r"annotations\[2\] .*is at the place of annotations\[0\]"),
    "one place, two patches": ([at(1, 2), at(1, 2, category_id=2)], "is at the place of"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_an_impossible_annotation_is_one_line(tmp_path, case):
    annotations, problem = REFUSED[case]
    path = coco(tmp_path, annotations)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # no RuntimeWarning of NumPy
        with pytest.raises(DataError, match=problem) as caught:
            open_coco(path)
    assert str(caught.value).startswith(f"{path}: annotations[")
    found = predictions(tmp_path / "p.json")
    [line] = run("score", found, "--gt", path, code=1).stderr.splitlines()
    assert "annotations[" in line


@pytest.mark.parametrize("name", ["width", "height"])
@pytest.mark.parametrize("value", [1e30, 10**7, -1, 640.5, float("nan"), float("inf")])
def test_an_impossible_size_of_an_image_is_one_line(tmp_path, name, value):
    path = coco(tmp_path, images=[IMAGE | {name: value}])
    with pytest.raises(DataError, match=rf"images\[0\] \(id 1\): {name} is .*expected a whole number of px up to"):
        open_coco(path)


@pytest.mark.parametrize("rung", [1e308, -1e308, float("nan")])
def test_an_impossible_rung_is_one_line(tmp_path, rung):
    with pytest.raises(DataError, match=r"images\[0\] \(id 1\): rung is .*expected a finite number"):
        open_coco(coco(tmp_path, images=[IMAGE | {"condition": "a", "rung": rung}]))


@pytest.mark.parametrize("size", [{"width": 640.0}, {"width": 0, "height": 0}, {"width": None}, {"height": 10**6}])
def test_sizes_that_are_whole_or_unknown_are_read(tmp_path, size):
    assert len(open_coco(coco(tmp_path, images=[IMAGE | size])).truth.keypoints) == 1


def test_values_within_the_rule_are_read(tmp_path):
    other = IMAGE | {"id": 2}
    kept = [
        at(0, 0, 0, radius=None),
        at(0, 0, 0, radius=None),
        at(-0.5, -0.5, 1),
        at(640, 480, 2.0),
        at(3, 4, image_id=2, axis_angle=-270, visible=0.5, id=7),
        at(3, 4, id="7"),
    ]
    keypoints = open_coco(coco(tmp_path, kept, [IMAGE, other])).truth.keypoints
    assert keypoints["x"].tolist() == [-0.5, 640, 3, 3]
    assert keypoints["visible"].tolist() == [1, 1, 1, 0.5]
    assert keypoints["axis_angle"].tolist() == [0, 0, 0, -270]


@pytest.mark.parametrize("place", [(-1, 5), (641, 5), (5, -1), (5, 481), (5, 1e5)])
def test_a_keypoint_outside_of_its_image_is_warned_of(tmp_path, place):
    path = coco(tmp_path, [at(*place), at(1, 2)])
    with pytest.warns(KpbenchWarning) as said:
        open_coco(path)
    [line] = [str(warning.message) for warning in said]
    assert line.startswith(f"{path}: 1 of 2 keypoints lie outside of the stated width and height of their images")
    assert "in the image 1 of 640 x 480" in line


def test_a_keypoint_is_inside_of_an_image_of_unknown_size(tmp_path):
    for size in ({"width": None, "height": None}, {"width": 0, "height": 0}):
        open_coco(coco(tmp_path, [at(-1, 9999)], [IMAGE | size]))


def test_an_export_of_ours_is_read_without_a_word(tmp_path, dataset):
    found = open_coco(export_dataset(dataset, "coco", tmp_path / "coco"))
    assert found.truth.keypoints["x"].tolist() == dataset.truth.keypoints["x"].tolist()
    assert found.truth.keypoints["visible"].tolist() == dataset.truth.keypoints["visible"].tolist()


# --- A key twice ---------------------------------------------------------------------------------------------------


def predictions(path):
    found = [Detections([[1.0, 2.0]], [0.5], [0]), Detections([[3.0, 4.0]], [0.25], [1])]
    write_predictions(path, Predictions.from_detections(found, detector={"name": "a:b"}, dataset="d"))
    return path


DOUBLE = {
    "p.json": [
        ('"dataset"', '"dataset":"x","dataset"'),
        ('"detector"', '"detector":{},"detector"'),
        ('"name"', '"name":"x","name"'),
        ('"image_id":1', '"image_id":7,"image_id":1'),
        ('"scores":[0.25]', '"scores":[1],"scores":[0.25]'),
        ('"ids":[1]', '"ids":null,"ids":[1]'),
        ('"ids":[1]', '"ids":[1],"\\u0069ds":[1]'),
        ('"predictions"', '"predictions":[],"predictions"'),
    ],
    "p.jsonl": [
        ('"dataset"', '"dataset":"x","dataset"'),
        ('"image_id":1', '"image_id":7,"image_id":1'),
        ('"scores":[0.25]', '"scores":[1],"scores":[0.25]'),
    ],
    "p.csv": [('"dataset"', '"dataset":"x","dataset"')],
}


@pytest.mark.parametrize(("name", "change"), [(name, change) for name, all_of in DOUBLE.items() for change in all_of])
def test_a_key_twice_in_predictions_is_one_line(tmp_path, name, change):
    path = predictions(tmp_path / name)
    text = path.read_text()
    assert change[0] in text
    path.write_text(text.replace(*change))
    with pytest.raises(KpbenchError, match=r"the key '.*' is there twice in ") as caught:
        read_predictions(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_key_twice_in_one_record_and_absent_in_another_is_found(tmp_path):
    path = predictions(tmp_path / "p.json")
    text = path.read_text().replace('"ids":[0]', '"ids":[1],"ids":[0]')
    path.write_text(text.replace('[[3.0,4.0]],"scores":[0.25],"ids":[1]', "[]"))
    with pytest.raises(KpbenchError, match="the key 'ids' is there twice"):
        read_predictions(path)


def test_results_of_coco_have_each_key_once(tmp_path):
    entry = '{"image_id":1,"category_id":1,"keypoints":[1,2,2],"score":0.5,"extra":{"a":1,"b":"x:y"}}'
    path = tmp_path / "r.json"
    path.write_text(f"[{entry},{entry}]")
    assert len(read_predictions(path).xy) == 2
    path.write_text(f"[{entry},{entry.replace('1,2,2]', '1,2,2],' + chr(34) + 'keypoints' + chr(34) + ':[3,4,2]')}]")
    with pytest.raises(KpbenchError, match="the key 'keypoints' is there twice"):
        read_predictions(path)


COCO_DOUBLE = [
    ('"images"', '"images": [], "images"'),
    ('"annotations"', '"annotations": [], "annotations"'),
    ('"annotations"', '"anno\\u0074ations": [], "annotations"'),
    ('"width"', '"width": 1, "width"'),
    ('"radius"', '"radius": 1, "radius"'),
    ('"keypoints"', '"keypoints": [1, 1, 0], "keypoints"'),
    ('"id": 1, "image_id"', '"id": 1, "id": 1, "image_id"'),
]


@pytest.mark.parametrize("change", COCO_DOUBLE)
def test_a_key_twice_in_annotations_is_one_line(tmp_path, change):
    path = coco(tmp_path, [ANNOTATION | {"bbox": [1, 2], "note": "a:b \\ é", "segmentation": {"size": [1]}}])
    open_coco(path)
    path.write_text(path.read_text().replace(*change, 1))
    with pytest.raises(DataError, match=r"the key '.*' is there twice"):
        open_coco(path)


def test_a_key_twice_in_a_sidecar_is_one_line(here):
    print_patches(out="print", formats=["svg"])
    text = (here / "print" / "patches.json").read_text()
    (here / "print" / "patches.json").write_text(text.replace('"ruler_mm"', '"ruler_mm": [1, 1], "ruler_mm"', 1))
    with pytest.raises(KpbenchError, match=r"patches\.json: .*the key 'ruler_mm' is there twice"):
        correct_sidecars("print", (100.0, 100.0))


def test_load_json_names_the_object():
    with pytest.raises(DoubleKeyError, match=re.escape("the key 'a' is there twice in {'n': 1, 'a': 2, ...}")):
        load_json('[{"n": 0}, {"n": 1, "a": 2, "b": 3, "a": 4}]')
    assert load_json('[{"a": 1}, {"a": 2, "b": {"a": 3}}]') == [{"a": 1}, {"a": 2, "b": {"a": 3}}]
