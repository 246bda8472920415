"""Two datasets compared: config, truth, pixels, distributions, and the gate."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
from helpers import kpbench, write_dataset
from scipy import ndimage, stats

from kpbench import SynthConfig, diff, export_dataset, generate
from kpbench.dataset import open_labelled
from kpbench.drift import compute_shift, exchange_scenes
from kpbench.drift.distributions import SceneValues, compare_distributions
from kpbench.drift.images import compare_truth
from kpbench.drift.quantities import _measure_edge_widths, _measure_noise
from kpbench.errors import DataError
from kpbench.types import KEYPOINT_DTYPE, Truth

ROWS = [[(10, 10, 5, 0), (50, 10, 5, 1), (30, 40, 5, 2)]] * 4


def shift_of(difference, name):
    return next(d for d in difference.distributions if d.name == name)


@pytest.fixture(scope="module")
def worn(tmp_path_factory):
    """Forty scenes without deteriorations, and the same scenes with them."""
    made = tmp_path_factory.mktemp("worn")
    config = SynthConfig(40, size_px=(160, 120), deteriorate="none")
    clean = generate(config, made / "clean", workers=1).dataset
    return clean, generate(replace(config, deteriorate="paper"), made / "worn", workers=1).dataset


def test_a_dataset_equals_itself_and_its_export(dataset, tmp_path):
    coco = export_dataset(dataset, "coco", tmp_path / "coco")
    for other in (dataset, coco, coco.parent, open_labelled(coco)):
        difference = diff(dataset, other)
        assert (difference.truth.changed, difference.pixels.changed, difference.drifted) == (0, 0, ())
        assert difference.pixels.compared == len(dataset)
        assert {d.shift for d in difference.distributions} <= {0.0, None}
    assert diff(coco, coco).truth.matched_by == "file"
    assert shift_of(difference, "contrast, levels").shift is None  # annotations do not tell it


def test_changes_of_the_truth_are_told_one_by_one(here):
    old = write_dataset(here / "old", ROWS)
    new = [list(rows) for rows in ROWS]
    new[0][0] = (13, 14, 5, 0)  # moved by 5 px, its radius
    new[1][1] = (50, 10, 5, 3)  # another ID
    new[2] = new[2][:2]  # one removed
    new[3] = [*new[3], (5, 50, 5, 0)]  # one added
    changes = diff(old, write_dataset(here / "new", [*new, []], seed=1))
    truth = changes.truth
    assert changes.config == {"seed": (0, 1)}
    assert (truth.common, truth.only_a, truth.only_b, truth.changed) == (4, (), ("4",), 4)
    assert (truth.added, truth.removed, truth.moved_px, truth.id_changed) == (1, 1, (5.0,), 1)
    assert truth.columns["radius_major"] == 0
    assert truth.columns["H_patch2image"] == 1
    new[0][0] = (13, 14.1, 5, 0)  # further than its radius: another keypoint
    gone = diff(old, write_dataset(here / "gone", new)).truth
    assert (gone.added, gone.removed, gone.moved_px) == (2, 2, ())


def truth_of(rows):
    """The truth of one image with keypoints (x, y, radius, id)."""
    keypoints = np.zeros(len(rows), KEYPOINT_DTYPE)
    for name, column in zip(("x", "y", "radius_major", "patch_id"), np.transpose(rows), strict=True):
        keypoints[name] = column
    return Truth(np.array([0]), np.array([0, len(rows)]), keypoints, np.array([""]), np.array([np.nan]), np.array([0]))


def test_another_ignored_patch_is_a_change_of_the_truth():
    truth = truth_of([(10, 10, 5, 0)])
    more = replace(truth, ignored=truth_of([(30, 30, 5, 1)]).keypoints, ignored_image=np.array([0]))
    assert [compare_truth(*pair).changed for pair in ((truth, truth), (more, more), (truth, more))] == [0, 0, 1]


def test_keypoints_are_paired_as_brute_force_pairs_them():
    """As many pairs as possible, then the smallest sum of distances."""
    rng = np.random.default_rng(5)
    for _ in range(40):
        a, b = ([(*rng.uniform(0, 12, 2), 4, 0) for _ in range(rng.integers(1, 5))] for _ in range(2))
        found = compare_truth(*map(truth_of, (a, b)))
        few, many = sorted((a, b), key=len)
        best = (0, 0.0)
        for chosen in itertools.permutations(range(len(many)), len(few)):
            distances = [np.hypot(few[k][0] - many[j][0], few[k][1] - many[j][1]) for k, j in enumerate(chosen)]
            near = [d for d in distances if d <= 4]
            best = min(best, (-len(near), sum(near)))
        assert len(found.moved_px) == -best[0]
        assert sum(found.moved_px) == pytest.approx(best[1])
        assert (found.removed, found.added) == (len(a) + best[0], len(b) + best[0])


def test_pixels_are_compared_image_by_image(worn):
    clean, dirty = worn
    pixels = diff(clean, dirty).pixels
    levels = [np.abs(clean.image(n).astype(int) - dirty.image(n)) for n in range(40)]
    assert pixels.changed == sum(part.any() for part in levels)
    assert pixels.largest_levels == max(part.max() for part in levels)
    assert pixels.mean_levels == pytest.approx(np.median([part.mean() for part in levels if part.any()]))


def test_worn_images_drift_in_what_was_worn_and_in_nothing_else(worn):
    difference = diff(*worn)
    drifted = {d.name.split(",")[0] for d in difference.drifted}
    assert (
        {"effects", "contrast", "edge width"} <= drifted <= {"effects", "contrast", "edge width", "noise", "brightness"}
    )
    assert replace(difference, max_shift=0.99).drifted == (shift_of(difference, "effects"),)


@pytest.mark.parametrize("sizes", [(5, 9), (40, 200)])
def test_the_shift_is_that_of_scipy(sizes):
    rng = np.random.default_rng(1)
    for values in (lambda n: rng.normal(size=n), lambda n: rng.integers(0, 4, n)):
        a, b = map(values, sizes)
        assert compute_shift(a, b) == pytest.approx(stats.ks_2samp(a, b).statistic)
    a, b = (rng.choice(["x", "y", "z"], n) for n in sizes)
    shares = [np.array([(part == name).mean() for name in "xyz"]) for part in (a, b)]
    assert compute_shift(a, b) == pytest.approx(np.abs(shares[0] - shares[1]).sum() / 2)


def test_the_p_value_is_that_of_all_exchanges_and_of_scipy():
    rng = np.random.default_rng(3)
    a, b = rng.normal(0, 1, 10), rng.normal(1, 1, 8)
    alone = exchange_scenes(SceneValues(a, np.arange(10)), SceneValues(b, np.arange(8)), 0)
    statistic = lambda x, y: stats.ks_2samp(x, y, method="asymp").statistic  # noqa: E731
    expected = stats.permutation_test((a, b), statistic, alternative="greater", n_resamples=400, rng=rng).pvalue
    assert alone == pytest.approx(expected, abs=0.06)
    scene_a, scene_b = np.array([0, 0, 0, 1, 1, 2, 3, 3, 3, 3]), np.array([5, 5, 6, 6, 7, 7, 7, 8])
    values, scene = np.concatenate([a, b]), np.concatenate([scene_a, scene_b])
    shifts = [
        compute_shift(values[mask], values[~mask])
        for chosen in itertools.combinations((0, 1, 2, 3, 5, 6, 7, 8), 4)
        for mask in [np.isin(scene, chosen)]
    ]
    exact = np.mean(np.array(shifts) >= compute_shift(a, b) - 1e-12)
    assert exchange_scenes(SceneValues(a, scene_a), SceneValues(b, scene_b), 0) == pytest.approx(exact, abs=0.05)


def test_the_same_scenes_are_exchanged_in_pairs():
    a, b, scenes = np.arange(8.0), np.arange(8.0) + 3.5, np.arange(8)
    shifts = []
    for coins in itertools.product((False, True), repeat=8):
        swap = np.array(coins)
        shifts.append(compute_shift(np.where(swap, b, a), np.where(swap, a, b)))
    exact = np.mean(np.array(shifts) >= compute_shift(a, b) - 1e-12)
    assert exchange_scenes(SceneValues(a, scenes), SceneValues(b, scenes), 0) == pytest.approx(exact, abs=0.04)


def test_values_of_one_scene_count_once():
    """Forty values that all hang on four scenes are no proof of drift; forty scenes are."""
    a, b = np.repeat([0.0, 1, 0, 1], 10), np.repeat([1.0, 1, 1, 1], 10)
    few = [SceneValues(values, np.repeat([0, 1, 2, 3], 10) + shift) for values, shift in ((a, 0), (b, 9))]
    many = [SceneValues(values, np.arange(40) + shift) for values, shift in ((a, 0), (b, 99))]
    assert exchange_scenes(*few, 0) > 0.2
    assert exchange_scenes(*many, 0) == 0.001


def test_chance_alone_is_rarely_called_drift():
    """p-values of two samples of one distribution are uniform, or larger; scenes hold several equal values."""
    rng = np.random.default_rng(2)
    p = []
    for _ in range(60):
        sizes = ((0, 20), (50, 23))
        parts = [SceneValues(np.repeat(rng.normal(size=n), 3), np.repeat(np.arange(n), 3) + k) for k, n in sizes]
        p.append(exchange_scenes(*parts, 0))
    assert np.mean(np.array(p) <= 0.1) <= 0.2
    assert np.mean(np.array(p) <= 0.5) >= 0.3


def test_dust_is_no_drift_however_many_values_show_it():
    rng = np.random.default_rng(4)
    a, b = (SceneValues(rng.normal(mean, 1, 100_000), np.arange(100_000) + n) for mean, n in ((0, 0), (0.04, 10**6)))
    found = replace(compare_distributions("x", a, b, 0), p_holm=0.001)
    assert 0.01 < found.shift < 0.05
    assert not found.is_drift(0.05)
    assert found.is_drift(0.01)


def test_the_edge_width_is_that_of_the_blur_and_noise_that_of_the_noise():
    image = np.full((61, 61), 40.0)
    image[:, 31:] = 200
    keypoint = np.zeros(1, KEYPOINT_DTYPE)
    keypoint["x"] = keypoint["y"] = 30
    keypoint["radius_major"] = 20
    for sigma in (2, 4):
        blurred = ndimage.gaussian_filter(image, sigma).astype(np.float32)
        assert _measure_edge_widths(blurred, keypoint)[0] == pytest.approx(sigma * np.sqrt(2 * np.pi), rel=0.08)
    noise = np.random.default_rng(0).normal(0, 6, (200, 200))
    assert _measure_noise((100 + noise).astype(np.float32)) == pytest.approx(6, rel=0.03)
    assert _measure_noise(np.add.outer(np.arange(50.0), np.arange(50.0)).astype(np.float32)) == pytest.approx(
        0, abs=1e-4
    )


def test_the_command_and_its_exit_codes(worn, here):
    clean, dirty = (dataset.path for dataset in worn)
    assert "no drift" in kpbench("diff", clean, clean, "--fail-on-drift").stdout
    told = kpbench("diff", clean, dirty, "--json", "d.json", "--fail-on-drift", code=1)
    assert "drift: contrast" in told.stdout
    assert told.stderr.startswith("kpbench: distributions drifted by more than 0.05: contrast by 0.")
    assert "deteriorate: none -> paper" in told.stdout
    content = json.loads((here / "d.json").read_text())
    assert (content["schema"], content["drift"], content["truth"]["moved_px"]["count"]) == ("kpbench.diff/1", True, 0)
    assert kpbench("diff", clean, "nothing", code=1).stderr.count("\n") == 1
    kpbench("diff", clean, dirty, "--max-shift", "1", code=2)
    with pytest.raises(DataError, match="`max_shift` is 1, expected a number from 0 to below 1"):
        diff(clean, clean, max_shift=1)


def test_images_of_other_sizes_and_colours(here, dataset):
    grey = SynthConfig(2, size_px=(80, 64), deteriorate="none")
    made = [
        generate(config, here / name, workers=1).dataset
        for name, config in (
            ("grey", grey),
            ("rgb", replace(grey, channels=3)),
            ("large", replace(grey, size_px=(96, 80))),
        )
    ]
    assert diff(made[0], made[1]).pixels.compared == 2
    assert diff(made[0], made[2]).pixels.other_size == 2
    assert shift_of(diff(made[0], made[2]), "image size").shift == 1
