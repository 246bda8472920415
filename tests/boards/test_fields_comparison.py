"""A printed field in a photograph: PDF, raster, bent sheet, camera, detector, places."""

import importlib.util
import sys
from pathlib import Path

import numpy as np

from kpbench.camera import load_camera_preset

path = Path(__file__).parents[2] / "benchmarks" / "accuracy" / "fields_comparison.py"
spec = importlib.util.spec_from_file_location("fields_comparison", path)
comparison = sys.modules["fields_comparison"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(comparison)
comparison.FINER = 1  # as fast as it goes
GREY = np.full((60, 80), 90, np.uint8)


def test_a_bent_print_is_found_in_a_photograph():
    target, rng = comparison.make_field(), np.random.default_rng(3)
    view = comparison.random_view(rng, bent=True)
    around = comparison.surround(view, GREY, GREY, comparison.random_covers(rng, 0.2))
    image = comparison.take(
        comparison.draw(target, view, *around, (40, 220)), [0], load_camera_preset("industrial"), worn=False
    )
    right, wrong, *_ = comparison.judge(target, view, image)
    assert right >= 40
    assert wrong == 0


def test_a_sample_of_a_bent_sheet_projects_back_to_its_pixel():
    """The rays that draw the image, and the map that tells the truth, are independent of each other."""
    for seed in range(2):
        view = comparison.random_view(np.random.default_rng(seed), bent=True)
        rows, columns = np.nonzero(np.isfinite(view.on_sheet[..., 0]))
        chosen = np.random.default_rng(seed).integers(0, len(rows), 50)
        places = np.column_stack([view.on_sheet[rows[chosen], columns[chosen]], np.zeros(50)])
        sample = np.column_stack([columns[chosen], rows[chosen]])
        xy = (sample + 0.5) / comparison.FINER - 0.5
        np.testing.assert_allclose(view.project(places), xy, atol=1e-6)
