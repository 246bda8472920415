"""Scenes of single patches as a camera takes them: in linear light, in motion, behind a lens."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.camera.chain import SCENE_TONE, photograph, scene_light
from kpbench.camera.optics import chromatic_scales
from kpbench.camera.paper import Bow, Cylinder, Saddle
from kpbench.camera.shutter import BoardMotion, PatchMotion, Shutter
from kpbench.degrade.effects import jpeg
from kpbench.geometry.camera import Camera
from kpbench.geometry.homography import project
from kpbench.geometry.warp import PointMap
from kpbench.patches.board import BoardLike
from kpbench.portable import cos_sin
from kpbench.render.board_exposure import ExposedBoard, paint_board
from kpbench.render.board_projection import Pose
from kpbench.render.board_view import Appearance
from kpbench.render.detail import paint_detail
from kpbench.render.exposure import expose_patches, true_placement
from kpbench.render.placement import Placement
from kpbench.render.scene import Mask, Rendering, fraction_inside, keypoint_table, measure_contrast, paint_patch
from kpbench.types import Float32, UInt8


def scene_camera(record: dict[str, Any], width_px: int, height_px: int, calibration: Camera | None = None) -> Camera:
    """Return the camera of a scene of single patches.

    Without a calibration, the lens has the coefficient k1 of the record, and the width of the image as focal length.
    """
    if calibration is not None:
        return calibration.at_size(width_px, height_px)
    return Camera(width_px, height_px, float(width_px), (record["k1"], 0.0, 0.0, 0.0))


def photograph_scene(
    background: UInt8,
    placements: Sequence[Placement],
    rng: np.random.Generator,
    record: dict[str, Any],
    calibration: Camera | None = None,
) -> Rendering:
    """Draw patches in linear light before a background, and take a picture of them.

    Parameters
    ----------
    background : ndarray of shape (H, W) or (H, W, 3), uint8
        Not changed. It neither moves nor bends.
    placements : sequence of Placement
        The poses at the middle of the exposure of the image's middle row, before the lens bends them.
    rng : numpy.random.Generator
        Gives the noise of the sensor.
    record : dict
        From :meth:`kpbench.camera.CameraPreset.draw`.
    calibration : Camera, optional
        See :class:`kpbench.camera.CameraPreset`.

    Returns
    -------
    Rendering
        The truth is the pose at the middle of the exposure of the row on which the centre falls, behind the lens.
        Patches whose centre leaves the image are not drawn, nor those that reach out of the valid region of the lens.
    """
    height, width = background.shape[:2]
    motion = PatchMotion(velocity_px=tuple(record["velocity_px"]), turn_deg=record["turn_deg"][2])
    shutter = Shutter.rolling(record["row_time"], height) if record["row_time"] else None
    camera = scene_camera(record, width, height, calibration)
    focal_px, middle = np.diag(camera.K)[:2], camera.K[:2, 2]
    warp: PointMap | None = None
    if camera.is_bent:
        warp = lambda points: camera.distort((points - middle) / focal_px)  # noqa: E731
        placements = [p for p in placements if _is_valid(p, camera)]
    true = [true_placement(placement, motion, shutter, warp) for placement in placements]
    rows = [n for n, placement in enumerate(true) if _is_inside(placement, width, height)]
    drawn, true = [placements[n] for n in rows], [true[n] for n in rows]
    light = scene_light(background)
    inks = SCENE_TONE.light(np.array([[p.black, p.white] for p in drawn]).reshape(-1, 2) / 255).tolist()

    def paint(plane: Float32, seen: PointMap | None) -> list[Mask]:
        masks = expose_patches(drawn, [motion] * len(drawn), shutter, seen, record["ink_gain"])
        visible[:] = [paint_patch(plane, mask, *ink) for mask, ink in zip(masks, inks, strict=True)]
        return masks

    visible: list[float] = []
    scales = _colour_scales(light, record)
    if scales:
        planes = [np.ascontiguousarray(plane) for plane in np.moveaxis(light, 2, 0)]
        painted = [paint(plane, _magnify(warp, k, width, height)) for plane, k in zip(planes, scales, strict=True)]
        light, masks = np.stack(planes, axis=2), painted[1]
    else:
        masks = paint(light, warp)
    keypoints = keypoint_table(true, visible)
    _paint_details(light, keypoints, [white for _, white in inks], record)
    image = _take(light, rng, record)
    keypoints["contrast"] = measure_contrast(image, masks)
    return Rendering(image, keypoints, tuple(masks))


def photograph_board(
    background: UInt8,
    camera: Camera,
    exposed: ExposedBoard,
    appearance: Appearance,
    rng: np.random.Generator,
    record: dict[str, Any],
) -> Rendering:
    """Draw a board in linear light before a background, and take a picture of it.

    Parameters
    ----------
    background : ndarray of shape (H, W) or (H, W, 3), uint8
        As large as the camera's image; not changed. It neither moves nor bends. A camera with colour filters or with
        chromatic aberration needs colours.
    camera : Camera
    exposed : ExposedBoard
        From :func:`expose_board`.
    appearance : Appearance
        The inks are grey levels of the scene's tone curve, as in :func:`kpbench.camera.scene_light`.
    rng : numpy.random.Generator
        Gives the noise of the sensor.
    record : dict
        From :meth:`kpbench.camera.CameraPreset.draw`.

    Returns
    -------
    Rendering
        The image is grey. Under chromatic aberration, green is the colour of the truth.
    """
    light = scene_light(background)
    scales = _colour_scales(light, record)
    if scales:
        planes = [np.ascontiguousarray(plane) for plane in np.moveaxis(light, 2, 0)]
        painted = [
            paint_board(plane, camera.scaled(k), exposed, appearance) for plane, k in zip(planes, scales, strict=True)
        ]
        light, masks = np.stack(planes, axis=2), painted[1]
    else:
        masks = paint_board(light, camera, exposed, appearance)
    keypoints = exposed.keypoints(camera)
    white = float(SCENE_TONE.light(np.array(appearance.white / 255))) * appearance.light
    _paint_details(light, keypoints, [white] * len(keypoints), record)
    image = _take(light, rng, record)
    if image.ndim == 3:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    keypoints["visible"] = [fraction_inside(image, mask) for mask in masks]
    keypoints["contrast"] = measure_contrast(image, masks)
    return Rendering(image, keypoints, masks)


def expose_board(board: BoardLike, pose: Pose, camera: Camera, record: dict[str, Any]) -> ExposedBoard:
    """Return a board with the motion, the bow and the ink gain of a camera's record.

    Parameters
    ----------
    board : Board or TagBoard
    pose : Pose
        The pose at the middle of the exposure of the image's middle row.
    camera : Camera
    record : dict
        From :meth:`kpbench.camera.CameraPreset.draw`. ``velocity_px`` is the velocity of the board's centre, parallel
        to the image. ``bow`` and ``twist`` are fractions of the board's width.
    """
    vx, vy = (v * float(pose.t_camera[2]) / camera.focal_px for v in record["velocity_px"])
    motion = BoardMotion((vx, vy, 0.0), tuple(record["turn_deg"]))
    shutter = Shutter.rolling(record["row_time"], camera.height_px) if record["row_time"] else Shutter()
    width_mm = min(board.side_x_mm, board.side_y_mm)
    bow: Bow | None = None
    if record["bow"]:
        bow = Cylinder.of_sagitta(record["bow"] * width_mm, width_mm, record["axis_deg"])
    elif record["twist"]:
        bow = Saddle(4 * record["twist"] / width_mm, record["axis_deg"])
    return ExposedBoard(board, pose, motion, shutter, bow, record["ink_gain"])


def needs_colour(record: dict[str, Any]) -> bool:
    """Return whether a camera sees more than the grey levels of a scene: colour filters, chromatic aberration."""
    return bool(record["bayer"] or record["red_px"] or record["blue_px"])


def _colour_scales(light: Float32, record: dict[str, Any]) -> tuple[float, ...]:
    """Return the scales of red, green and blue; an empty tuple without chromatic aberration, and for grey light."""
    if light.ndim == 2 or not (record["red_px"] or record["blue_px"]):
        return ()
    return chromatic_scales(record["red_px"], record["blue_px"], (light.shape[1], light.shape[0]))


def _magnify(warp: PointMap | None, scale: float, width_px: int, height_px: int) -> PointMap:
    """Return a warp that is followed by a scale about the image's centre."""
    middle = np.array([(width_px - 1) / 2, (height_px - 1) / 2])
    return lambda points: middle + scale * ((points if warp is None else warp(points)) - middle)


def _take(light: Float32, rng: np.random.Generator, record: dict[str, Any]) -> UInt8:
    image = photograph(light, rng, record)
    return jpeg(image, record["jpeg_quality"]) if record["jpeg_quality"] else image


def _paint_details(light: Float32, keypoints: NDArray[Any], white: Sequence[float], record: dict[str, Any]) -> None:
    """Draw the details of all patches at their true poses, in place. Details are not blurred by motion."""
    for n, H_patch2image in enumerate(keypoints["H_patch2image"] if record["detail"] else ()):
        rng = np.random.default_rng([record["detail_seed"], n])
        paint_detail(light, H_patch2image, rng, record["detail"], white=white[n])


def _is_valid(placement: Placement, camera: Camera) -> bool:
    """Return whether all of a patch lies in the valid region of the lens, before the lens bends it."""
    angles = np.arange(16) * (2 * np.pi / 16)
    extent = 1.1 * placement.patch.extent
    rim = project(placement.H_patch2image, extent * np.column_stack(cos_sin(angles)))
    rays = (rim - camera.K[:2, 2]) / np.diag(camera.K)[:2]
    return bool(np.sqrt((rays * rays).sum(axis=1)).max() < camera.lens.largest_radius)


def _is_inside(placement: Placement, width_px: int, height_px: int) -> bool:
    H = placement.H_patch2image
    x, y = H[0, 2] / H[2, 2], H[1, 2] / H[2, 2]
    return bool(-0.5 <= x <= width_px - 0.5 and -0.5 <= y <= height_px - 0.5)
