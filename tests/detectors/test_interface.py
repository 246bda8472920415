import re

import numpy as np
import pytest

from kpbench.detectors import prediction
from kpbench.detectors.interface import LoadedDetector, load_detector
from kpbench.detectors.suppression import suppress
from kpbench.errors import DataError
from kpbench.images import to_grey
from kpbench.types import Detections

MODULE = """
import numpy as np
from kpbench import Detections

def function(image):
    return Detections([[1.0, 2.0]], [0.5], [3])

class Class:
    name, version = "mine", "7"
    def detect(self, image):
        return function(image)

made = Class()
nothing = 5

def wrong(image):
    return [[1, 2]]

def endless(image):
    return Detections([[float("nan"), 2.0]], [0.5])
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    name = f"mine_{tmp_path.name}".replace("-", "_")
    (tmp_path / f"{name}.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    return name


IMAGE = np.zeros((8, 8), np.uint8)


@pytest.mark.parametrize("attribute", ["function", "Class", "made"])
def test_a_detector_of_ones_own_is_a_function_a_class_or_an_object(module, attribute):
    detector = load_detector(f"{module}:{attribute}")
    found = detector(IMAGE)
    assert found.xy.tolist() == [[1, 2]]
    assert found.patch_id.tolist() == [3]
    if attribute != "function":
        assert (detector.name, detector.version) == ("mine", "7")


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("tamplate", "detector 'tamplate' is not known; there are: superpoint-small"),
        ("no_such_module_here:f", "there is no module 'no_such_module_here'"),
        ("{module}:f", "has no attribute 'f'"),
        ("{module}:nothing", "cannot be called and has no method detect"),
    ],
)
def test_what_is_no_detector_is_one_line(module, name, says):
    with pytest.raises(DataError) as caught:
        load_detector(name.format(module=module))
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("attribute", "says"), [("wrong", "returned list, expected kpbench.Detections"), ("endless", "not finite")]
)
def test_what_a_detector_returns_is_checked(module, attribute, says):
    with pytest.raises(DataError, match=says):
        load_detector(f"{module}:{attribute}")(IMAGE)


def test_suppress_keeps_the_best_whatever_the_order():
    rng = np.random.default_rng(0)
    xy, score = rng.uniform(0, 50, (80, 2)), np.round(rng.random(80), 1)
    kept = xy[suppress(xy, score, 9.0)]
    distance = np.hypot(*(kept[:, None] - kept).T)
    assert distance[~np.eye(len(kept), dtype=bool)].min() >= 9
    assert all(np.hypot(*(kept - p).T).min() < 9 for p in xy)
    order = rng.permutation(80)
    assert (xy[order][suppress(xy[order], score[order], 9.0)] == kept).all()
    assert len(suppress(np.zeros((0, 2)), np.zeros(0), 5.0)) == 0


def test_to_grey_refuses_what_is_no_image():
    assert to_grey(np.zeros((4, 5, 3), np.uint8)).shape == (4, 5)
    for bad in (np.zeros((4, 5), float), np.zeros((4, 5, 4), np.uint8)):
        with pytest.raises(DataError, match="expected uint8"):
            to_grey(bad)


def test_detections_must_fit_together():
    with pytest.raises(ValueError, match="expected one per point"):
        Detections([[1, 2]], [0.5, 0.6])


@pytest.mark.parametrize(
    ("xy", "score", "ids", "said"),
    [
        (np.zeros((2, 4)), np.ones(4), None, "shape (2, 4)"),
        (np.zeros((2, 3)), np.ones(3), None, "shape (2, 3)"),
        (np.zeros((3, 2)), np.ones(2), None, "3 points have 2 scores"),
        (np.zeros((1, 2)), np.ones(1), [1.7], "not whole"),
        (np.zeros((1, 2)), np.ones(1), [1, 2], "1 points have 2 patch IDs"),
    ],
)
def test_detections_of_another_shape_are_refused(xy, score, ids, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        Detections(xy, score, ids)


def test_a_detector_that_exits_fails_on_its_image():
    def leave(image):
        raise SystemExit(3)

    result = prediction._detect(LoadedDetector("leaver", "1", leave), np.zeros((8, 8), np.uint8), None)
    assert len(result.detections) == 0
    assert "SystemExit" in result.problem
