"""Detections of every shipped detector on 30 fixed images stay what they are, whatever is moved or renamed."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import kpbench
from kpbench.detectors.interface import DETECTORS

GOLDEN = Path(__file__).parent / "golden"
EXPECTED = json.loads((GOLDEN / "detections.json").read_text())
TOLERANCE = 1e-3  # px, and of the score


@pytest.mark.parametrize("name", [name for name in DETECTORS if name in EXPECTED["00.png"]])
def test_detections_are_the_golden_ones(name):
    detect = kpbench.load_detector(name)
    for file, by_detector in EXPECTED.items():
        image = cv2.imread(str(GOLDEN / "images" / file), cv2.IMREAD_GRAYSCALE)
        expected = np.array(by_detector[name]).reshape(-1, 4)
        found = detect(image)
        if name not in ("orb", "sift"):  # of which only the strongest are kept
            assert len(found) == len(expected), file
        ids = np.full(len(found), -1) if found.patch_id is None else found.patch_id
        rows = np.column_stack([found.xy, found.score, ids])
        for point in expected:
            near = np.abs(rows[:, :3] - point[:3]).max(axis=1) <= TOLERANCE
            assert (rows[near, 3] == point[3]).any(), f"{file}: no detection like {point}"
