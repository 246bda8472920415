import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kpbench import portable
from kpbench.filters import MOST_DIRECT_WEIGHTS, filter_image, filter_separably, to_whole_weights

PATH = Path(__file__).parents[2] / "benchmarks" / "robustness" / "processors.py"


@pytest.fixture(scope="module")
def processors():
    spec = importlib.util.spec_from_file_location("benchmarks_processors", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_pixels_and_truth_are_the_same_on_a_processor_without_wide_instructions(processors):
    command = [sys.executable, str(PATH), "--here", "--n=2"]
    variables = [{}, processors.PROCESSORS["all of these"]]
    started = [
        subprocess.Popen(command, env={**os.environ, **more}, stdout=subprocess.PIPE, text=True) for more in variables
    ]
    here, there = (process.communicate()[0] for process in started)
    assert len(here) == 65
    assert here == there


@given(st.floats(-1000, 1000), st.floats(-600, 600), st.floats(1e-300, 1e300))
def test_elementary_functions_are_exact_to_a_few_units_in_the_last_place(angle, power, positive):
    cosine, sine = portable.cos_sin(angle)
    assert abs(cosine - np.cos(angle)) < 4e-16
    assert abs(sine - np.sin(angle)) < 4e-16
    assert np.isclose(portable.exp(power), np.exp(power), rtol=1e-15, atol=0)
    assert np.isclose(portable.log(positive), np.log(positive), rtol=1e-15, atol=1e-16)


@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
def test_the_angle_of_a_point_is_that_of_numpy(y, x):
    expected = np.arctan2(y, x)
    if y == 0 or x == 0:
        expected = np.arctan2(y + 0.0, x + 0.0)  # without the sign of zero
    assert abs(portable.arctan2(y, x) - expected) < 1e-15


def test_matrix_products_are_those_of_numpy():
    rng = np.random.default_rng(0)
    for A, B in ((rng.random((3, 3)), rng.random((3, 50))), (rng.random((7, 3, 3)), rng.random((7, 3, 3)))):
        np.testing.assert_allclose(portable.matmul(A, B), A @ B, rtol=1e-14)


@pytest.mark.parametrize("shape", [(24, 31), (24, 31, 3)])
@pytest.mark.parametrize("side", [3, 9, 13])
def test_both_ways_to_filter_round_the_same_sum(shape, side):
    """The direct sum and the Fourier transform agree with whole numbers in NumPy."""
    rng = np.random.default_rng(side)
    image, kernel = rng.integers(0, 256, shape, dtype=np.uint8), rng.random((side, side))
    reach = side // 2
    unit = 2**16 if side * side <= MOST_DIRECT_WEIGHTS else 2**24
    weights = to_whole_weights(kernel, unit).astype(np.int64)
    padded = np.pad(image.astype(np.int64), [(reach, reach)] * 2 + [(0, 0)] * (len(shape) - 2), mode="reflect")
    total = sum(weights[i, j] * padded[i : i + shape[0], j : j + shape[1]] for i in range(side) for j in range(side))
    np.testing.assert_array_equal(filter_image(image, kernel), np.rint(total / unit).astype(np.uint8))


def test_a_separable_filter_is_the_filter_of_its_outer_product_to_a_grey_level():
    rng = np.random.default_rng(0)
    image, taps = rng.integers(0, 256, (40, 50), dtype=np.uint8), np.array([1.0, 4, 6, 4, 1])
    difference = filter_separably(image, taps).astype(int) - filter_image(image, np.outer(taps, taps))
    assert abs(difference).max() <= 1
    assert (difference != 0).mean() < 0.05


def test_processors_are_imitated_by_variables_that_the_libraries_read(processors):
    """The variables change the features that OpenCV reports."""
    code = "import cv2; print(cv2.getCPUFeaturesLine())"
    run = [sys.executable, "-c", code]
    plain, imitated = (
        subprocess.run(run, env={**os.environ, **more}, capture_output=True, text=True, check=True).stdout
        for more in ({}, processors.PROCESSORS["all of these"])
    )
    assert imitated != plain or "AVX2" not in plain
