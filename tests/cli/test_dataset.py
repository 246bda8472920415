import os
import subprocess
import sys

import cv2
import pytest
from helpers import kpbench


def test_inspect_verify_and_preview(dataset, tmp_path):
    told = kpbench("inspect", dataset.path)
    assert "6 of 320x240, grey" in told.stdout
    checked = kpbench("verify", dataset.path)
    assert "all as written" in checked.stdout
    sheet = tmp_path / "sheet.png"
    kpbench("preview", dataset.path, "--out", sheet, "--count", 4, "--columns", 2, "--tile-width", 160)
    assert cv2.imread(str(sheet)).shape == (2 * 124 + 4, 2 * 164 + 4, 3)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["synth", "--n", "0"], "--n is 0, expected a number of images from 1 to 1,000,000,000"),
        (["synth", "--n", "-5"], "--n is -5"),
        (["synth", "--n", "5", "--backgrounds", "nowhere"], "nowhere: no such folder of background images"),
        (["inspect", "nowhere"], "nowhere: no dataset there"),
        (["verify", "nowhere"], "nowhere: no dataset there"),
        (["preview", "nowhere"], "nowhere: no dataset there"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_1(arguments, says, here):
    result = kpbench(*arguments, code=1)
    assert result.stdout == ""
    assert result.stderr.startswith("kpbench: ")
    assert says in result.stderr
    assert result.stderr.count("\n") == 1


def test_designs_of_ones_own(tmp_path):
    design = 'name = "half"\nid = 7\nsemicircles = [{ start_deg = 90, ink = "black" }]\n'
    (tmp_path / "half.toml").write_text(design)
    for given in (tmp_path, tmp_path / "half.toml"):
        made = ("synth", "--n", 4, "--size", "160x120", "--patches", given, "--out", tmp_path / "set", "--overwrite")
        result = kpbench(*made)
        assert "4 images, 1 shards, fingerprint" in result.stdout
        told = kpbench("inspect", tmp_path / "set").stdout
        ids = told.partition("patch ID\n")[2].partition("radius")[0].split("\n")
        assert [line.split()[0] for line in ids if line] == ["7"]
    (tmp_path / "empty").mkdir()
    refused = kpbench("synth", "--n", 4, "--patches", tmp_path / "empty", "--out", tmp_path / "other", code=1)
    assert "empty: no designs in it" in refused.stderr


def test_a_second_synth_into_the_folder_changes_nothing(dataset):
    before = (dataset.path / "dataset.json").read_bytes()
    result = kpbench("synth", "--n", 7, "--out", dataset.path, code=1)
    assert "already holds a dataset; add --resume" in result.stderr
    assert (dataset.path / "dataset.json").read_bytes() == before


@pytest.mark.parametrize(
    "arguments", [["synth"], ["synth", "--n", "1", "--size", "big"], ["synth", "--n", "1", "--resume", "--overwrite"]]
)
def test_wrong_usage_is_exit_code_2(arguments):
    kpbench(*arguments, code=2)


def test_without_a_terminal_stderr_stays_empty(tmp_path):
    command = [sys.executable, "-m", "kpbench", "synth", "--n", "2", "--size", "160x120", "--out", str(tmp_path / "a")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert done.stderr == ""


@pytest.mark.parametrize(
    "arguments",
    [
        ["score", "preds.json", "--eps", "nan"],
        ["detect", "photos", "--threshold", "inf"],
        ["render-patches", "--diameter-mm", "nan"],
        ["synth", "--n", "5", "--workers", "0"],
        ["synth", "--n", "5", "--seed", "-1"],
        ["degrade", "photo.png", "--effect", "blur", "--level", "7", "--seed", "-1"],
    ],
)
def test_numbers_that_are_none_are_wrong_usage(arguments):
    kpbench(*arguments, code=2)


def test_a_full_standard_output_is_one_line(dataset):
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "kpbench", "verify", str(dataset.path)]
        buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False, env=buffered)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert done.stderr == "kpbench: the disk is full\n"
