import json

import numpy as np
import pytest
from helpers import kpbench

from kpbench.dataset.folder import open_dataset
from kpbench.errors import DataError
from kpbench.fitting import design_fit
from kpbench.fitting.pyramid import build_pyramid
from kpbench.patches.design import shipped_patches
from kpbench.render.placement import Limits, random_placements
from kpbench.render.scene import render_scene
from kpbench.synth.user_pipeline import load_augmentation, run_pipeline

WITH_ROOM = Limits(count=(6, 6), radius_px=(20, 50), tilt_deg=30)


def saved(tmp_path, *names_and_options, suffix="json"):
    """A file as albumentations.save writes it."""
    transforms = [{"__class_fullname__": name, "p": 1.0, **options} for name, options in names_and_options]
    whole = {"__class_fullname__": "Compose", "p": 1.0, "transforms": transforms}
    path = tmp_path / f"pipeline.{suffix}"
    path.write_text(json.dumps({"__version__": "2.0.8", "transform": whole}))  # JSON is YAML too
    return path


def scene(seed):
    placements = random_placements(np.random.default_rng(seed), 480, 480, shipped_patches(), WITH_ROOM)
    return render_scene(np.full((480, 480), 140, np.uint8), placements).image, placements


@pytest.mark.parametrize(
    "pipeline",
    [
        [("RandomResizedCrop", {"size": [480, 480], "scale": [0.5, 1.0]})],
        [("Resize", {"height": 960, "width": 960}), ("CenterCrop", {"height": 480, "width": 480})],
        [("Affine", {"scale": [0.8, 1.3], "rotate": [-30, 30], "shear": [-8, 8]})],
        [("Perspective", {})],
        [("OneOf", {"transforms": [{"__class_fullname__": "OpticalDistortion", "p": 1.0}]})],
    ],
    ids=lambda pipeline: pipeline[0][0],
)
def test_truth_goes_where_the_pixels_go(pipeline, tmp_path):
    canonical = load_augmentation(saved(tmp_path, *pipeline))
    off = []
    for seed in range(4):
        image, moved = run_pipeline(*scene(seed), canonical, seed)
        carried = [placement for placement in moved if placement is not None]
        H = np.array([placement.H_patch2image for placement in carried])
        affine = H[:, :2, :2] - H[:, :2, 2:] @ H[:, 2:, :2]
        fit = design_fit.fit(build_pyramid(image, 0), H[:, :2, 2], affine, [p.patch for p in carried])
        off.extend(np.linalg.norm(fit.xy - H[:, :2, 2], axis=1)[fit.ncc > 0.97])
    assert len(off) >= 6
    assert np.median(off) < 0.04
    assert max(off) < 0.25


def test_what_moves_nothing_leaves_the_truth_as_it_is(tmp_path):
    image, placements = scene(0)
    done, carried = run_pipeline(image, placements, load_augmentation(saved(tmp_path, ("GaussNoise", {}))), 3)
    assert carried == placements
    assert (done != image).any()


@pytest.mark.parametrize(
    ("name", "options", "said"),
    [
        ("HorizontalFlip", {}, "mirrors"),
        ("Resize", {"height": 100, "width": 100}, "makes 100x100"),
        ("RandomCrop", {"height": 900, "width": 900}, "`augmentation`: "),
    ],
)
def test_what_cannot_be_carried_is_refused(name, options, said, tmp_path):
    canonical = load_augmentation(saved(tmp_path, (name, options)))
    with pytest.raises(DataError) as refused:
        run_pipeline(*scene(1), canonical, 0)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("text", ["", "[1]", '{"transform": {"__class_fullname__": "NoSuchThing"}}', "{"])
def test_a_file_without_a_pipeline_is_refused(text, tmp_path):
    path = tmp_path / "wrong.json"
    path.write_text(text)
    refused = kpbench("synth", "--n", 2, "--augment", path, "--out", tmp_path / "set", code=1)
    assert f"{path}: no pipeline" in refused.stderr
    assert not (tmp_path / "set").exists()


def test_augmented_sets_are_the_same_whatever_the_workers(tmp_path):
    path = saved(tmp_path, ("SafeRotate", {}), ("GaussNoise", {}), suffix="yaml")
    command = ["synth", "--n", 6, "--size", "160x120", "--shard-size", 3, "--augment", path]
    for workers in ("1", "2"):
        kpbench(*command, "--workers", workers, "--out", tmp_path / workers)
    one, two = (open_dataset(tmp_path / workers) for workers in ("1", "2"))
    assert one.fingerprint == two.fingerprint
    assert one.config["augmentation"]["transform"]["transforms"][0]["__class_fullname__"] == "SafeRotate"
    assert one.effects(0)[-1]["effect"] == "augmentation"
