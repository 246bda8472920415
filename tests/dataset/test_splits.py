from dataclasses import replace

import numpy as np
import pytest

from kpbench.dataset import split_scenes
from kpbench.dataset.export import export_dataset
from kpbench.errors import DataError


def of_scenes(dataset, scenes):
    return replace(dataset.truth, scene_id=np.array(scenes, np.int64), image_id=np.arange(len(scenes)))


@pytest.mark.parametrize(("share", "scenes"), [(0.0, 0), (0.001, 1), (0.2, 8), (0.5, 20), (0.999, 39)])
def test_a_scene_is_in_one_split_and_the_share_is_kept(dataset, share, scenes):
    scene_id = np.tile(np.arange(40), 3)
    splits = np.array(split_scenes(of_scenes(dataset, scene_id), share))
    held_out = {*scene_id[splits == "val"]}
    assert len(held_out) == scenes
    assert not held_out & {*scene_id[splits == "train"]}


def test_the_split_of_a_scene_does_not_depend_on_the_order(dataset):
    scenes = np.random.default_rng(0).permutation(50)
    one, two = (dict(zip(s, split_scenes(of_scenes(dataset, s)), strict=True)) for s in (scenes, np.sort(scenes)))
    assert one == two


@pytest.mark.parametrize(("share", "expected"), [(1.0, "val_share"), (-0.1, "val_share"), (float("nan"), "val_share")])
def test_an_impossible_share_is_refused(dataset, share, expected):
    with pytest.raises(DataError, match=expected):
        split_scenes(dataset.truth, share)


def test_one_scene_cannot_be_split(dataset, tmp_path):
    truth = of_scenes(dataset, [4, 4, 4])
    with pytest.raises(DataError, match="one scene"):
        split_scenes(truth)
    assert split_scenes(truth, 0) == ["train"] * 3
    export_dataset(dataset, "yolo", tmp_path / "yolo", val_share=0)
    assert "train: images/train\nval: images/train\n" in (tmp_path / "yolo" / "data.yaml").read_text()


def test_an_unfinished_export_is_not_continued_with_another_split(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr("kpbench.dataset.export.write_card", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        export_dataset(dataset, "yolo", tmp_path / "yolo", val_share=0.2)
    with pytest.raises(DataError, match="holds another unfinished export"):
        export_dataset(dataset, "yolo", tmp_path / "yolo", val_share=0.5)
    monkeypatch.undo()
    export_dataset(dataset, "yolo", tmp_path / "yolo", val_share=0.2)
