"""Boards for other programs, read back."""

import cv2
import numpy as np
import pytest
import yaml
from helpers import kpbench as run

import kpbench
from kpbench.errors import DesignError
from kpbench.printing import write_targets

GRID = kpbench.grid_board(kpbench.shipped_patches(), rows=3, columns=4, diameter_mm=20.0, pitch_mm=35.0)


def test_opencv_reads_its_file(tmp_path):
    [path] = write_targets([GRID], tmp_path, ["opencv"])
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    np.testing.assert_allclose(file.getNode("object_points").mat(), GRID.points_mm)
    assert file.getNode("patch_id").mat().ravel().tolist() == [k.patch_id for k in GRID.keypoints]


def test_a_grid_is_a_target_of_kalibr(tmp_path):
    [path] = write_targets([GRID], tmp_path, ["kalibr"])
    assert yaml.safe_load(path.read_text()) == {
        "target_type": "circlegrid",
        "targetCols": 4,
        "targetRows": 3,
        "spacingMeters": 0.035,
        "asymmetricGrid": False,
    }
    with pytest.raises(DesignError, match="is no grid of one pitch"):
        write_targets([kpbench.hexagon_board(kpbench.shipped_patches()[1], 100.0)], tmp_path, ["kalibr"])


def test_mrcal_reads_a_table_in_metres(tmp_path):
    [path] = write_targets([GRID], tmp_path, ["mrcal"])
    legend = next(line for line in path.read_text().splitlines() if not line.startswith("##"))
    assert legend.split() == ["#", "point", "patch_id", "x", "y", "z"]
    np.testing.assert_allclose(1000 * np.loadtxt(path)[:, 2:], GRID.points_mm)


def test_the_command_writes_targets_into_a_subfolder(tmp_path):
    made = ("render-patches", "--board", "grid", "--svg", "--target", "opencv", "--target", "mrcal", "--out", tmp_path)
    for _ in range(2):  # its own files are replaced
        run(*made)
    assert sorted(path.name for path in (tmp_path / "targets").iterdir()) == ["grid.mrcal.vnl", "grid.opencv.yaml"]
    assert [path.name for path in tmp_path.glob("*.json")] == ["grid.json"]
    assert "--target describes a board" in run("render-patches", "--target", "opencv", code=2).stderr
