"""A second look: patches that a detector missed, where the other patches of their board say that they must be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kpbench.boards.frames import straighten
from kpbench.boards.images import find_boards
from kpbench.boards.matching import BoardMatch
from kpbench.boards.pose import fit_board
from kpbench.detectors.interface import LoadedDetector
from kpbench.fitting.align import short_semi_axis
from kpbench.fitting.templates import build_templates
from kpbench.geometry.camera import Camera
from kpbench.patches.board import Board
from kpbench.tracking.prediction import predict_patches
from kpbench.tracking.windows import LEAST_NCC, LEAST_PATCH_CONTRAST, USUAL_BLUR_PX, WindowSearch, cut_windows
from kpbench.types import Detections, Float, UInt8

LOOK_REACH = 0.6
"""Largest error of the prediction that windows hold, in long semi-axes."""
FREE = 0.5
"""A patch is missing if no detection is nearer to its place than this, in short semi-axes."""
MOST_BESIDE, MOST_CHANGED = 0.3, 0.25
"""Largest distance of a found patch from its predicted place, in short semi-axes, and largest change of its frame, as a
part of it."""


def find_missed(image: UInt8, detections: Detections, match: BoardMatch, camera: Camera | None = None) -> Detections:
    """Find patches of a board that a detector missed.

    Each patch is fitted where the homography of the board puts it, and is kept if it agrees with its design.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
        Grey or RGB.
    detections : Detections
        All detections of the image. Where one of them is, no patch is looked for.
    match : BoardMatch
        The board, from :func:`kpbench.find_board`.
    camera : Camera, optional
        Camera of the image.

    Returns
    -------
    Detections
        Only the new ones. Their ``score`` is the correlation of image and design.

    Examples
    --------
    >>> import numpy as np
    >>> import kpbench
    >>> from kpbench.geometry import Camera
    >>> from kpbench.render import Appearance, Pose, render_board
    >>> from kpbench.tracking import find_missed
    >>> board, camera = kpbench.hexagon_board(kpbench.shipped_patches()[1], 100.0), Camera(320, 240, 300.0)
    >>> pose, grey = Pose(np.eye(3), np.array([0.0, 0.0, 250.0])), np.full((240, 320), 90, np.uint8)
    >>> image = render_board(grey, camera, pose, board, Appearance(30, 220)).image
    >>> found = kpbench.load_detector("superpoint-small")(image)[:4]  # as if it had missed two
    >>> [match] = kpbench.find_board(found, board, camera)
    >>> len(find_missed(image, found, match, camera))
    2
    """
    board = match.board
    frames = match.frames if match.camera == camera and match.frames is not None else None
    H = fit_board(match, straighten(match.detections, camera) if frames is None else frames)
    middle = np.append(board.points_mm[match.points, :2].mean(axis=0), 1.0)
    H = H * np.sign(H[2] @ middle)
    missing = predict_patches(H, board, camera, (image.shape[1], image.shape[0]))
    radius = short_semi_axis(missing.A)
    gap = np.linalg.norm(missing.xy[:, None] - detections.xy, axis=2)
    is_free = gap.min(axis=1, initial=np.inf) > FREE * radius
    missing = missing[is_free & ~np.isin(missing.points, match.points)]
    if not len(missing):
        return detections[:0]
    ids = np.array([k.patch_id for k in board.keypoints])[missing.points]
    templates = build_templates(board.patches)
    known = [patch.patch_id for patch in board.patches]
    search = WindowSearch(templates, np.array([known.index(patch_id) for patch_id in ids.tolist()], np.int64))
    extent = np.array([board.keypoints[n].patch.extent for n in missing.points])
    windows = cut_windows(image, missing.xy, missing.A, extent, LOOK_REACH)
    found = match.detections.blur_px
    blur_px = np.full(len(missing), USUAL_BLUR_PX if found is None else np.median(found))
    fit, _ = search.find(windows, missing, blur_px, 0.0)
    beside = np.linalg.norm(fit.xy - missing.xy, axis=1) / short_semi_axis(missing.A)
    good = (fit.ncc >= LEAST_NCC) & (fit.contrast > LEAST_PATCH_CONTRAST) & (beside <= MOST_BESIDE)
    good &= _changes(missing.A, fit.A) <= MOST_CHANGED
    all_found = Detections(fit.xy, np.maximum(fit.ncc, 0), ids, fit.A, fit.covariance, fit.blur_px)
    return all_found[np.flatnonzero(good)]


def _changes(before: Float, after: Float) -> Float:
    """Return the change of maps (n, 2, 2), as a part of each."""
    return np.asarray(np.linalg.norm(np.linalg.solve(before, after) - np.eye(2), 2, axis=(1, 2)))


def look_twice(detector: LoadedDetector, boards: Sequence[Board], camera: Camera | None = None) -> LoadedDetector:
    """Return a detector that finds boards in its detections, and then the patches that it missed on them.

    Parameters
    ----------
    detector : LoadedDetector
    boards : sequence of Board
    camera : Camera, optional
        Camera of all images; images may have a whole-number multiple or fraction of its size.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.tracking import look_twice
    >>> board = kpbench.hexagon_board(kpbench.shipped_patches()[1], 100.0)
    >>> look_twice(kpbench.load_detector("superpoint-small"), [board]).name
    'superpoint-small, two looks'
    """

    def run(image: UInt8) -> Detections:
        found = detector(image)
        of_image = None if camera is None else camera.at_size(image.shape[1], image.shape[0])
        for matches in find_boards(found, boards, of_image):
            for match in matches:
                more = Detections.none() if match.ambiguous else find_missed(image, found, match, of_image)
                if len(more):
                    found = _join(found, more)
        return found

    return replace(detector, name=f"{detector.name}, two looks", run=run, run_many=None, identity=None)


def _join(first: Detections, second: Detections) -> Detections:
    """Return all detections of two tables; an optional column stays if both tables have it."""
    pairs = ((getattr(first, name), getattr(second, name)) for name in vars(first))
    return Detections(*(None if a is None or b is None else np.concatenate([a, b]) for a, b in pairs))  # type: ignore[arg-type]
