import multiprocessing
import os
import runpy
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import albumentations
import cv2
import h5py
import numpy as np
import pytest
from helpers import digests, kpbench

from kpbench.dataset.folder import open_dataset
from kpbench.dataset.generation import generate, generate_part, merge
from kpbench.errors import DataError
from kpbench.patches.design import shipped_patches
from kpbench.render.placement import Limits, Placement
from kpbench.render.scene import rasterise_patches
from kpbench.synth.finish import unoccluded_fraction
from kpbench.synth.synthetic import SynthConfig
from kpbench.synth.user_pipeline import load_augmentation


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    rng = np.random.default_rng(0)
    for n in range(5):
        cv2.imwrite(str(folder / f"{n}.png"), rng.integers(0, 256, (100, 130), dtype=np.uint8))
    (folder / "broken.jpg").write_bytes(b"no image")
    return folder


def config(photos, **changes):
    return SynthConfig(**{"n": 10, "size_px": (160, 120), "backgrounds": photos, "shard_size": 4, **changes})


def test_neither_workers_nor_an_interruption_change_a_byte(photos, tmp_path):
    generate(config(photos), tmp_path / "one", workers=1)
    generate(config(photos), tmp_path / "two", workers=2)
    assert digests(tmp_path / "one") == digests(tmp_path / "two")

    class Stop(Exception):
        pass

    done = 0

    def interrupt(images):
        nonlocal done
        done += images
        if done >= 6:
            raise Stop

    with pytest.raises(Stop):
        generate(config(photos), tmp_path / "three", workers=1, progress=interrupt)
    assert [p.name for p in (tmp_path / "three").iterdir()] == ["shard-00000.h5"]
    with pytest.raises(DataError, match="holds an unfinished dataset; add `resume=True`"):
        generate(config(photos), tmp_path / "three", workers=1)
    run = generate(config(photos), tmp_path / "three", workers=1, resume=True)
    assert run.kept == 4
    assert digests(tmp_path / "one") == digests(tmp_path / "three")


def test_the_shard_size_changes_no_image(photos, tmp_path):
    one = generate(config(photos), tmp_path / "one", workers=1).dataset
    two = generate(config(photos, shard_size=10), tmp_path / "two", workers=1).dataset
    assert all((one.image(n) == two.image(n)).all() for n in range(10))
    assert (one.truth.keypoints == two.truth.keypoints).all()
    assert one.fingerprint != two.fingerprint


def test_an_image_depends_on_its_index_and_not_on_n(photos):
    image = config(photos).make(7)[0]
    again = config(photos, n=5000).make(7)[0]
    assert (image.image == again.image).all()
    other = config(photos, seed=1).make(7)[0]
    assert (image.image != other.image).any()


@pytest.mark.parametrize("how", ["paper", "ladder"])
def test_deterioration_leaves_the_scene_and_lowers_contrast(photos, how):
    clean, worn = (config(photos, deteriorate=d).make(3)[0] for d in ("none", how))
    assert len(clean.keypoints)
    hidden = any(entry["effect"] == "occlusion" for entry in worn.effects)
    for name in clean.keypoints.dtype.names:
        same = np.array_equal(clean.keypoints[name], worn.keypoints[name])
        assert same == (name != "contrast" and not (name == "visible" and hidden))
    assert clean.effects == []
    assert worn.effects


def test_occlusion_of_the_ladder_lowers_what_is_visible():
    shares = []
    for index in range(60):
        clean, worn = (config(None, n=60, deteriorate=d).make(index)[0] for d in ("none", "ladder"))
        if any(entry["effect"] == "occlusion" for entry in worn.effects):
            shares += list(worn.keypoints["visible"] / clean.keypoints["visible"])
    assert max(shares) <= 1
    assert min(shares) < 0.8
    assert 0.6 < np.mean(shares) < 0.95  # a circle around the disc is hidden by 0 to 40 %


def test_what_an_occlusion_hides_outside_the_image_counts_for_nothing(photos):
    sample = config(photos, limits=Limits(count=(9, 9), radius_px=(20, 30))).make(0)[0]
    placements = [Placement(shipped_patches()[0], np.array([[20.0, 0, 0], [0, 20, 60], [0, 0, 1]]), 0.0, 255.0)]
    masks = tuple(rasterise_patches(placements))
    effects = [{"effect": "occlusion", "strips": [[-21.0, 60.0, 40.0, 100.0, 0.0, 90.0]]}]  # its end is at x = -1
    assert unoccluded_fraction(sample.image, effects, masks)[0] == pytest.approx(1)
    effects[0]["strips"][0][0] = 20.0
    assert unoccluded_fraction(sample.image, effects, masks)[0] < 0.05


def test_a_pipeline_keeps_what_an_occlusion_hid(photos, tmp_path):
    albumentations.save(albumentations.Compose([albumentations.Rotate((20, 20), p=1)]), tmp_path / "a.json", "json")
    pipeline = load_augmentation(tmp_path / "a.json")
    shares = []
    for index in range(40):
        worn, turned = (
            config(None, n=40, deteriorate="ladder", augmentation=a).make(index)[0] for a in (None, pipeline)
        )
        if any(entry["effect"] == "occlusion" for entry in worn.effects):
            shares += [worn.keypoints["visible"].mean(), turned.keypoints["visible"].mean()]
    before, after = np.array(shares).reshape(-1, 2).T
    assert before.min() < 0.9
    assert np.nanmean(after) < 0.97


def test_radii_are_kept_and_small_ones_asked_for(photos):
    limits = Limits.of_radius(3, 12)
    keypoints = np.concatenate([config(photos, limits=limits).make(n)[0].keypoints for n in range(12)])
    assert 3 <= keypoints["radius_minor"].min() < 5
    assert keypoints["radius_major"].max() < 13
    assert Limits.of_radius(5, 80) == Limits()
    for bad in ((80, 5), (3, 3), (0, 9), (float("nan"), 9), (5, 1e9)):
        with pytest.raises(DataError, match="`radius_px` is"):
            Limits.of_radius(*bad)


def test_broken_backgrounds_are_counted_in_the_manifest(photos, tmp_path):
    run = generate(config(photos, n=20), tmp_path / "set", workers=1)
    assert run.broken_files == ("broken.jpg",)
    assert run.dataset.provenance["broken_backgrounds"] == ["broken.jpg"]
    assert "broken.jpg" not in {run.dataset._open(0)["background"].asstr()[0]}


def test_another_dataset_in_the_folder_is_kept(photos, tmp_path):
    generate(config(photos), tmp_path, workers=1)
    before = digests(tmp_path)
    for changed in (config(photos, seed=9), config(photos, n=6), config(None)):
        with pytest.raises(DataError, match="already holds a dataset"):
            generate(changed, tmp_path, workers=1)
        with pytest.raises(DataError, match=r"of another dataset.*; pass `overwrite=True`"):
            generate(changed, tmp_path, workers=1, resume=True)
    assert digests(tmp_path) == before
    generate(config(photos, n=3), tmp_path, workers=1, overwrite=True)
    assert sorted(digests(tmp_path)) == ["README.md", "dataset.json", "preview.png", "shard-00000.h5"]


def _hold(folder, config, ready, release):
    def wait(images):
        ready.set()
        release.wait(30)

    generate(config, folder, workers=1, progress=wait)


def test_a_second_run_into_one_folder_is_refused(photos, tmp_path):
    spawn = multiprocessing.get_context("spawn")
    ready, release = spawn.Event(), spawn.Event()
    first = spawn.Process(target=_hold, args=(tmp_path, config(photos), ready, release))
    first.start()
    try:
        assert ready.wait(30)
        with pytest.raises(DataError, match="another kpbench run is writing to it"):
            generate(config(photos), tmp_path, workers=1)
    finally:
        release.set()
        first.join()
    assert len(open_dataset(tmp_path)) == 10


def test_a_disk_too_small_is_told_before_the_start(tmp_path):
    with pytest.raises(DataError, match=r"need about 16.3 TB, the disk has [\d.]+ .B (free|in all)"):
        generate(config(None, n=10**9, shard_size=10**6), tmp_path / "set", workers=1)
    assert not any((tmp_path / "set").glob("*"))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"n": 0}, "`n` is 0"),
        ({"n": -5}, "`n` is -5"),
        ({"size_px": (10, 480)}, "`size_px` is 10x480"),
        ({"channels": 2}, "`channels` is 2"),
        ({"shard_size": 0}, "`shard_size` is 0"),
        ({"seed": -1}, "`seed` is -1"),
        ({"deteriorate": "much"}, "`deteriorate` is 'much'"),
    ],
)
def test_a_value_out_of_range_is_one_line(changes, says):
    with pytest.raises(DataError, match=says):
        config(None, **changes)


def test_another_run_is_told_what_differs(photos, tmp_path):
    generate(config(photos), tmp_path, workers=1)
    with pytest.raises(DataError, match=r"\(seed is 0 there, 9 here\)"):
        generate(config(photos, seed=9), tmp_path, workers=1, resume=True)
    with pytest.raises(DataError, match=r"\(radius_px is \[5.0, 80.0\] there, \[3.0, 20.0\] here\)"):
        generate(config(photos, limits=Limits(radius_px=(3.0, 20.0))), tmp_path, workers=1, resume=True)


def test_a_folder_with_other_files_is_left_alone(photos, tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    for how in ({}, {"resume": True}, {"overwrite": True}):
        with pytest.raises(DataError, match=r"holds other files \(thesis.txt"):
            generate(config(photos), tmp_path, workers=1, **how)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.parametrize("apart", [False, True])
def test_parts_are_put_together_to_the_same_bytes(photos, tmp_path, apart):
    """Ten images are three shards; the parts share a folder, or have one each."""
    generate(config(photos), tmp_path / "whole", workers=1)
    folders = [tmp_path / ("b" if apart else "a"), tmp_path / "a"]
    assert generate_part(config(photos), folders[0], range(2, 3), workers=1) == 2
    with pytest.raises(DataError, match="shards are missing, first is number 0"):
        merge(folders[0])
    assert generate_part(config(photos), folders[1], range(2), workers=1) == 8
    dataset = merge(tmp_path / "a", [folders[0]])
    assert len(dataset) == 10
    assert digests(tmp_path / "a") == digests(tmp_path / "whole")


def test_parts_of_different_sets_are_not_put_together(photos, tmp_path):
    generate_part(config(photos), tmp_path, range(2), workers=1)
    generate_part(config(photos, seed=1), tmp_path, range(2, 3), workers=1)
    with pytest.raises(DataError, match=r"shard-00002\.h5: of another dataset"):
        merge(tmp_path)
    with pytest.raises(DataError, match="`shards` is 2:4, expected A:B with 0 <= A < B <= 3"):
        generate_part(config(photos), tmp_path, range(2, 4), workers=1)
    with pytest.raises(DataError, match="holds an unfinished dataset"):
        generate_part(config(photos), tmp_path, range(2), workers=1)
    assert generate_part(config(photos), tmp_path, range(2), workers=1, resume=True) == 8


def test_any_executor_gives_the_same_bytes(photos, tmp_path):
    generate(config(photos), tmp_path / "one", workers=1)
    seen = []
    with ThreadPoolExecutor(2) as executor:
        generate(config(photos), tmp_path / "two", executor=executor, progress=seen.append)
    assert digests(tmp_path / "one") == digests(tmp_path / "two")
    assert sum(seen) == 10


@pytest.mark.filterwarnings("default")
def test_dask_gives_the_same_bytes(photos, tmp_path):
    distributed = pytest.importorskip("distributed")
    generate(config(photos), tmp_path / "one", workers=1)
    local = {"n_workers": 1, "threads_per_worker": 2, "processes": False, "dashboard_address": None}
    with distributed.LocalCluster(**local) as cluster:
        generate(config(photos), tmp_path / "two", scheduler=cluster.scheduler_address)
    assert digests(tmp_path / "one") == digests(tmp_path / "two")


def test_whatever_ends_a_run_what_is_finished_stays():
    """One random moment of each kind; `benchmarks/robustness/interrupt.py` tries many, and a full disk."""
    if not Path("/proc/self/task").exists():
        pytest.skip("finds worker processes in /proc")
    interrupt = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "robustness" / "interrupt.py"))
    kinds = ("parent", "worker", "interrupt")
    assert interrupt["strike_often"](kinds, 1).keys() == set(kinds)


def test_a_url_takes_a_dataset_as_a_folder_does(photos, tmp_path):
    pytest.importorskip("upath")
    local = generate(config(photos), tmp_path / "set", workers=1).dataset
    url = f"memory://bucket-{os.getpid()}/set"
    for shards in (range(0, 1), range(1, 3)):
        generate_part(config(photos), url, shards, workers=1)
    assert merge(url).fingerprint == local.fingerprint
    there = open_dataset(Path(url))  # as the command line has it
    assert (there.image(7) == local.image(7)).all()
    assert len(list(there.verify())) == 3
    for command in ("inspect", "preview", "verify"):
        kpbench(command, url)
    with pytest.raises(DataError, match="already holds a dataset"):
        generate(config(photos), url, workers=1)
    with pytest.raises(DataError, match=r"nosuch:.* cannot be reached"):
        generate(config(photos), "nosuch://bucket/set", workers=1)


def test_work_in_this_process_leaves_its_threads_as_they_were(tmp_path):
    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(2)
        generate(SynthConfig(1, size_px=(64, 64)), tmp_path / "set", workers=1)
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)


@pytest.mark.parametrize(
    ("radii", "code", "said"),
    [("5", 2, "is not LEAST:MOST, expected two numbers such as 5:80"), ("80:5", 1, "--radius-px is 80:5")],
)
def test_bad_radii_are_refused_in_a_line(tmp_path, radii, code, said):
    out = tmp_path / "set"
    refused = kpbench("synth", "--n", 1, "--radius-px", radii, "--out", out, code=code)
    assert said in refused.stderr
    assert not out.exists()


def test_processes_of_the_caller_are_left_alone(tmp_path):
    own = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60,))
    own.start()
    try:
        generate(SynthConfig(2, size_px=(64, 64), shard_size=1), tmp_path / "set", workers=2)
        assert own.is_alive()
    finally:
        own.terminate()
        own.join()


def test_a_damaged_shard_is_not_taken_for_a_whole_one(tmp_path):
    generate(SynthConfig(4, size_px=(64, 64), shard_size=2), tmp_path / "set", workers=1)
    before = digests(tmp_path / "set")
    path = tmp_path / "set" / "shard-00001.h5"
    with h5py.File(path) as file:
        inside = file["images"].id.get_chunk_info(0).byte_offset + 9
    data = bytearray(path.read_bytes())
    data[inside] ^= 1
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"shard-00001\.h5: damaged since it was written; delete it, and resume"):
        generate(SynthConfig(4, size_px=(64, 64), shard_size=2), tmp_path / "set", workers=1, resume=True)
    with pytest.raises(DataError, match="damaged"):
        merge(tmp_path / "set")
    path.unlink()
    generate(SynthConfig(4, size_px=(64, 64), shard_size=2), tmp_path / "set", workers=1, resume=True)
    assert digests(tmp_path / "set") == before


def test_a_file_url_is_a_path(tmp_path):
    data = generate(SynthConfig(1, size_px=(64, 64)), f"file://{tmp_path}/a%20set", workers=1).dataset
    assert data.path == tmp_path / "a set"


def test_a_rim_beyond_the_horizon_is_drawn_anew(tmp_path):
    wide = replace(shipped_patches()[0], rim=1.0, quiet_zone=2.0)
    made = generate(SynthConfig(40, size_px=(160, 120), patches=(wide,)), tmp_path / "set", workers=1).dataset
    assert np.isfinite(made.truth.keypoints["x"]).all()
