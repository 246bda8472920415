"""A print is measured in photographs."""

import dataclasses
import json

import board_photos
import cv2
import numpy as np
from helpers import kpbench as run

import kpbench
from kpbench.calibration.print_check import check_print
from kpbench.render import pose_board


def stretched(sx):
    board = board_photos.BOARD
    marks = [dataclasses.replace(m, x_mm=m.x_mm * sx, width_mm=m.width_mm * sx) for m in board.references]
    points = [dataclasses.replace(k, x_mm=k.x_mm * sx) for k in board.keypoints]
    return dataclasses.replace(board, references=tuple(marks), keypoints=tuple(points))


def test_a_print_that_is_too_narrow_is_measured_and_its_sidecar_corrected(here):
    kpbench.print_boards([board_photos.BOARD], "print", formats=["svg"])
    board_photos.write_photos("photos", 5, board=stretched(0.985))
    done = run("print-check", "photos", "--board", "print/truth.json", "--ruler-mm", "98.5,100.0")
    assert "x to y: 0.98" in done.stdout
    assert "say" not in done.stderr
    assert "no ink gain, too few marks are sharp; come nearer" in done.stderr
    content = json.loads((here / "print" / "truth.measured.json").read_text())
    assert abs(content["print_scale"][0] - 0.985) < 5e-4
    assert abs(content["print_scale"][1] - 1.0) < 5e-4
    corrected = kpbench.load_board("print/truth.measured.json")
    assert abs(corrected.references[0].x_mm / board_photos.BOARD.references[0].x_mm - 0.985) < 5e-4
    swapped = run("print-check", "photos", "--board", "print/truth.json", "--ruler-mm", "100.0,98.5")
    assert "were the rulers swapped?" in swapped.stderr


FACE_PX_PER_MM = 14


def print_face(gain_mm):
    """The reference marks on paper; fillPoly adds half a pixel of ink on all sides."""
    board = board_photos.BOARD
    half = np.array([board.side_x_mm, board.side_y_mm]) / 2
    face = np.full((int(2 * half[1] * FACE_PX_PER_MM), int(2 * half[0] * FACE_PX_PER_MM)), 235, np.uint8)
    for mark in board.references:
        lines = [(line + half) * FACE_PX_PER_MM * 16 - 8 for line in mark.outlines(gain_mm - 0.5 / FACE_PX_PER_MM)]
        cv2.fillPoly(face, [np.rint(line).astype(np.int32) for line in lines], 40, cv2.LINE_8, 4)
    return face


def photograph_face(face, n):
    """A photograph of 1920 x 1440 px with a tone curve, which makes blurred black lines wider."""
    rng, board = np.random.default_rng([n, 3]), board_photos.BOARD
    camera = board_photos.CAMERA.without_distortion()
    turns = dict(zip(("pitch_deg", "yaw_deg", "roll_deg"), rng.uniform(-25, 25, 3), strict=True))
    pose = pose_board(camera, board, rng.uniform(14, 20), **turns)
    to_camera = np.column_stack([pose.R_board2camera[:, :2], pose.t_camera])
    half_x, half_y = board.side_x_mm / 2, board.side_y_mm / 2
    step = 1 / FACE_PX_PER_MM
    to_board = np.array([[step, 0, step / 2 - half_x], [0, step, step / 2 - half_y], [0, 0, 1]])
    larger = np.array([[4.0, 0, 1.5], [0, 4, 1.5], [0, 0, 1]])
    H = larger @ camera.K @ to_camera @ to_board
    fine = cv2.warpPerspective(face, H, (3840, 2880), flags=cv2.INTER_AREA, borderValue=120)
    light = cv2.GaussianBlur(cv2.resize(fine, (1920, 1440), interpolation=cv2.INTER_AREA).astype(float), (0, 0), 0.7)
    return np.clip(np.rint(255 * (light / 255) ** 0.45 + rng.normal(0, 1.5, light.shape)), 0, 255).astype(np.uint8)


def test_ink_gain_is_measured(here):
    gain_mm = 0.06
    kpbench.print_boards([board_photos.BOARD], "print", formats=["svg"])
    face = print_face(gain_mm)
    (here / "photos").mkdir()
    for n in range(4):
        cv2.imwrite(f"photos/{n}.png", photograph_face(face, n))
    value, sigma, unit = check_print("photos", "print/truth.json").values["ink gain"]
    assert unit == " mm"
    assert sigma < 0.03
    assert abs(value - gain_mm) < 3 * sigma
