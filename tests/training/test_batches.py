import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kpbench.errors import DataError
from kpbench.geometry.homography import project_disc
from kpbench.patches.design import shipped_patches
from kpbench.render.placement import Limits, Placement
from kpbench.training.batches import BatchJob, SampleConfig, load_photos, make_batch, training_batches
from kpbench.training.crop_effects import DegradedCrop
from kpbench.training.crops import Disc, _paint_all, _poses_at

PATCHES = shipped_patches()
CROPS = SampleConfig(size=(96, 96))
PHOTOS = [np.random.default_rng(n).integers(0, 256, (60 + 90 * n, 200), np.uint8) for n in range(2)]


def crops(index=0, count=8, severity=0.0, seed=0, config=CROPS):
    return make_batch(config, PATCHES, PHOTOS, seed, index, count, severity)


@pytest.mark.parametrize("kind", ["crops", "scenes"])
def test_a_batch_is_a_function_of_seed_and_index(kind):
    config = SampleConfig(kind, (320, 240), 5)
    first, again = crops(3, config=config), crops(3, config=config)
    assert np.array_equal(first.images, again.images)
    assert np.array_equal(first.keypoints, again.keypoints)
    for other in (crops(4, config=config), crops(3, seed=1, config=config)):
        assert not np.array_equal(first.images, other.images)


def test_scenes_repeat_after_the_set_and_degradations_do_not():
    config = SampleConfig("scenes", (320, 240), 4)
    clean = crops(0, 8, config=config)
    assert np.array_equal(clean.images[:4], clean.images[4:])
    worn = crops(0, 8, 1.0, config=config)
    assert np.array_equal(worn.keypoints, clean.keypoints)
    assert not np.array_equal(worn.images[:4], worn.images[4:])


def test_severity_changes_the_image_but_no_position():
    clean, worn = crops(1, 32), crops(1, 32, 1.0)
    assert np.array_equal(clean.keypoints[:, 0, :3], worn.keypoints[:, 0, :3])
    assert np.mean(clean.images != worn.images) > 0.5


def test_keypoints_lie_inside_and_pad_rows_are_marked():
    batch = crops(2, 64)
    present = batch.keypoints[..., 2] >= 0
    assert present.any()
    assert (~present).any()
    inside = (batch.keypoints[..., :2] >= -0.5) & (batch.keypoints[..., :2] < 95.5)
    assert inside[present].all()
    assert set(batch.keypoints[present][:, 2]) == {0.0, 1.0, 2.0, 3.0}


def test_what_is_drawn_is_the_design_about_the_keypoint():
    """Ink at points of the patch, looked up through the pose, against the pixels of the crop."""
    canvas = np.full((96, 96), 128, np.uint8)
    H = np.array([[30.0, -4.0, 40.3], [6.0, 22.0, 50.8], [0.05, -0.08, 1.0]])
    disc = Disc(Placement(PATCHES[3], H, 10.0, 240.0), 3, H[0, 2], H[1, 2], 32.0, 20.0)
    _paint_all([canvas], [[disc]])
    v, u = np.mgrid[-20:21, -20:21] / 21.0
    points = np.column_stack([u.ravel(), v.ravel()])[np.hypot(u, v).ravel() < 0.9]
    mapped = np.column_stack([points, np.ones(len(points))]) @ H.T
    columns, rows = np.rint(mapped[:, :2] / mapped[:, 2:]).astype(int).T
    black = PATCHES[3].is_black(points)
    right = np.where(black, canvas[rows, columns] < 60, canvas[rows, columns] > 190)
    assert right.mean() > 0.9  # all but pixels on edges
    assert canvas[2, 2] == 128


@given(st.integers(0, 2**31))
def test_poses_keep_the_papers_limits_wherever_they_are_put(seed):
    limits, at = Limits(), np.array([[-4.0, 90.0], [30.0, 31.0]])
    for H, place in zip(_poses_at(np.random.default_rng(seed), at, limits), at, strict=True):
        assert H[:, 2] == pytest.approx([*place, 1], abs=1e-9)
        ellipse = project_disc(H)
        assert 2 * ellipse.minor >= limits.minor_axis_px - 1e-6
        assert (ellipse.major - ellipse.minor) / ellipse.major <= limits.axis_difference + 1e-9


def test_buried_keypoints_are_ignored_and_clean_ones_are_not(monkeypatch):
    clean = crops(3, 128).keypoints
    wanted = clean[clean[..., 2] >= 0][:, 3] == 0
    assert 0.7 < wanted.mean() < 1.0  # patches of a board may be smaller than the limits
    noisy = lambda image, *_: DegradedCrop(image, image.astype(np.float32), 1e6)  # noqa: E731
    monkeypatch.setattr("kpbench.training.crops.degrade_crop", noisy)
    batch = crops(0, 64)
    present = batch.keypoints[..., 2] >= 0
    assert (batch.keypoints[present][:, 3] > 0).all()  # the ignore radius


@pytest.mark.parametrize("workers", [0, 1])
def test_training_batches_keep_the_order_of_their_jobs(workers, tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), PHOTOS[0])
    jobs = [BatchJob(n, 2, 0.5) for n in (5, 3, 9)]
    got = list(training_batches(CROPS, PATCHES, tmp_path, 7, jobs, workers))
    for job, batch in zip(jobs, got, strict=True):
        assert np.array_equal(batch.images, make_batch(CROPS, PATCHES, PHOTOS[:1], 7, job.index, 2, 0.5).images)


def test_every_tenth_photograph_is_kept_for_validation(tmp_path):
    for n in range(21):
        cv2.imwrite(str(tmp_path / f"{n:02}.png"), np.full((16, 16), n, np.uint8))
    (tmp_path / "05.png").write_bytes(b"broken")
    assert [int(p[0, 0]) for p in load_photos(tmp_path, "validation")] == [0, 10, 20]
    assert [int(p[0, 0]) for p in load_photos(tmp_path, "training")] == [n for n in range(21) if n % 10 and n != 5]


def test_large_photographs_are_kept_at_640_px(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((100, 1280), np.uint8))
    assert load_photos(tmp_path, "training")[0].shape == (50, 640)


@pytest.mark.parametrize("workers", [0, 1])
def test_photographs_that_cannot_be_used_are_one_line(tmp_path, workers):
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((50, 60), np.uint8))
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((5, 5), np.uint8))  # smaller than any window
    cv2.imwrite(str(tmp_path / "2.png"), np.zeros((8, 2000), np.uint8))  # and so are 640 columns of it
    with pytest.raises(DataError, match="none of the 2 photographs for training can be decoded"):
        list(training_batches(SampleConfig(), shipped_patches(), tmp_path, 0, [BatchJob(0, 2, 0.0)], workers))
