"""Scenes of single patches as a camera takes them: in linear light, in motion, behind a lens."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from kpbench.camera.chain import SCENE_TONE, photograph, scene_light
from kpbench.camera.shutter import PatchMotion, Shutter
from kpbench.degrade.effects import jpeg
from kpbench.geometry.camera import Camera
from kpbench.geometry.warp import PointMap
from kpbench.render.exposure import expose_patches, true_placement
from kpbench.render.placement import Placement
from kpbench.render.scene import Rendering, keypoint_table, measure_contrast, paint_patch
from kpbench.types import UInt8


def lens_warp(k1: float, width_px: int, height_px: int) -> PointMap | None:
    """Return the map of image points that a lens with the coefficient k1 causes; None for no distortion.

    The focal length is the width of the image. The centre of the image stays.
    """
    if not k1:
        return None
    camera = Camera(width_px, height_px, float(width_px), (k1, 0.0, 0.0, 0.0))
    return lambda points: camera.distort((points - camera.K[:2, 2]) / camera.focal_px)


def photograph_scene(
    background: UInt8, placements: Sequence[Placement], rng: np.random.Generator, record: dict[str, Any]
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

    Returns
    -------
    Rendering
        The truth is the pose at the middle of the exposure of the row on which the centre falls, behind the lens.
        Patches whose centre leaves the image are not drawn.
    """
    height, width = background.shape[:2]
    motion = PatchMotion(velocity_px=tuple(record["velocity_px"]))
    shutter = Shutter.rolling(record["row_time"], height) if record["row_time"] else None
    warp = lens_warp(record["k1"], width, height)
    true = [true_placement(placement, motion, shutter, warp) for placement in placements]
    rows = [n for n, placement in enumerate(true) if _is_inside(placement, width, height)]
    drawn, true = [placements[n] for n in rows], [true[n] for n in rows]
    masks = expose_patches(drawn, [motion] * len(drawn), shutter, warp, record["ink_gain"])
    light = scene_light(background)
    inks = SCENE_TONE.light(np.array([[p.black, p.white] for p in drawn]).reshape(-1, 2) / 255).tolist()
    visible = [paint_patch(light, mask, *ink) for mask, ink in zip(masks, inks, strict=True)]
    image = photograph(light, rng, record)
    if record["jpeg_quality"]:
        image = jpeg(image, record["jpeg_quality"])
    keypoints = keypoint_table(true, visible)
    keypoints["contrast"] = measure_contrast(image, masks)
    return Rendering(image, keypoints, tuple(masks))


def _is_inside(placement: Placement, width_px: int, height_px: int) -> bool:
    H = placement.H_patch2image
    x, y = H[0, 2] / H[2, 2], H[1, 2] / H[2, 2]
    return bool(-0.5 <= x <= width_px - 0.5 and -0.5 <= y <= height_px - 0.5)
