"""The pose of a board, frame by frame.

1. A filter with constant velocity predicts the pose (:mod:`kpbench.tracking.motion_filter`).
2. Each patch is aligned and fitted in a window around its predicted place (:mod:`kpbench.tracking.windows`). If too few
   patches are there, shifts of the whole board are tried.
3. A patch counts if it agrees with its design, and if its place agrees with the pose of the others.
4. If this fails, the detector looks at the whole image.
5. If this fails, too, the filter guesses for a while.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from kpbench.boards.frames import straighten
from kpbench.boards.matching import BoardMatch, find_board
from kpbench.boards.pose import BoardPose, estimate_pose, rotation_vector
from kpbench.detectors.interface import LoadedDetector, load_detector
from kpbench.errors import DataError
from kpbench.fitting.align import short_semi_axis
from kpbench.fitting.templates import build_templates
from kpbench.geometry.camera import Camera
from kpbench.patches.board import Board
from kpbench.patches.symmetry import board_turns_deg
from kpbench.tracking.motion_filter import PoseFilter
from kpbench.tracking.prediction import predict_patches
from kpbench.tracking.windows import LEAST_NCC, LEAST_PATCH_CONTRAST, USUAL_BLUR_PX, WindowSearch, cut_windows
from kpbench.types import Detections, Int, UInt8

State = Literal["seen", "tracked", "predicted", ""]
LEAST_TRACKED = 4
"""Smallest number of patches that make a tracked pose. With three, no error would show."""
LARGEST_MOVE = 0.2
"""Largest distance of the fitted centre from the aligned one, in short semi-axes."""
LEAST_SHARE = 0.5
"""Part of the patches that must agree with their designs before shifts of the whole board are left untried."""
WINDOW_REACH, SHIFT_REACH = 0.6, 2.2
"""Largest error of the prediction that windows hold, in long semi-axes: without and with shifts."""
LARGEST_OFF = 36.0
"""Largest squared distance of a point from its projection, in standard deviations."""
OFF_FLOOR_PX = 0.15
"""Standard deviation that is added to every point's for this: what no fit knows, such as a bent board."""


@dataclass(frozen=True)
class TrackedPose:
    """What a tracker knows of a frame.

    Attributes
    ----------
    state : {"seen", "tracked", "predicted", ""}
        ``seen``: the detector found the board in the whole image. ``tracked``: the board was found in windows.
        ``predicted``: it was not found, and ``filtered`` is a guess. "": nothing is known.
    pose : BoardPose or None
        Measured in this frame alone; None unless the board was found.
    filtered : BoardPose or None
        The pose that the filter makes of this and of all frames before; None if nothing is known.
    match : BoardMatch or None
        The points that ``pose`` was computed from.
    reason : str
        Why the board was not found; "" if it was.
    """

    state: State
    pose: BoardPose | None = None
    filtered: BoardPose | None = None
    match: BoardMatch | None = None
    reason: str = ""


class Tracker:
    """Tracks a board through the frames of a film; call the tracker with each frame, in order.

    Parameters
    ----------
    board : Board
    camera : Camera
        Frames may have a whole-number multiple or fraction of its size.
    detector : str or LoadedDetector
        Looks at whole images. It must know the designs of the board.
    guess_s : float
        After so many seconds without the board, the filter guesses no more.
    fps : float
        Frames per second of frames without a time.

    Examples
    --------
    >>> import numpy as np
    >>> import kpbench
    >>> from kpbench.geometry import Camera
    >>> from kpbench.render import Appearance, Pose, render_board
    >>> board, camera = kpbench.hexagon_board(kpbench.shipped_patches()[1], 100.0), Camera(320, 240, 300.0)
    >>> tracker = kpbench.Tracker(board, camera)
    >>> for n in range(4):
    ...     pose = Pose(np.eye(3), np.array([2.0 * n, 0.0, 250.0]))
    ...     frame = render_board(np.full((240, 320), 90, np.uint8), camera, pose, board, Appearance(30, 220)).image
    ...     tracked = tracker(frame, time_s=n / 30)
    ...     print(tracked.state, round(tracked.pose.translation_mm[0]))
    seen 0
    seen 2
    tracked 4
    tracked 6
    """

    def __init__(
        self,
        board: Board,
        camera: Camera,
        detector: str | LoadedDetector = "superpoint-small",
        guess_s: float = 0.5,
        fps: float = 30.0,
    ) -> None:
        self.board, self.camera, self.guess_s, self.fps = board, camera, guess_s, fps
        self.detector = load_detector(detector) if isinstance(detector, str) else detector
        templates = build_templates(board.patches)
        ids = [patch.patch_id for patch in board.patches]
        self._design = np.array([ids.index(k.patch_id) for k in board.keypoints], np.int64)
        self._templates = templates
        self._ids = np.array([k.patch_id for k in board.keypoints])
        self._radius_mm = np.array([k.diameter_mm for k in board.keypoints]) / 2
        self._extent = np.array([k.patch.extent for k in board.keypoints])
        gap = np.linalg.norm(board.points_mm[:, None] - board.points_mm, axis=2)
        self._gap_mm = float(gap[gap > 0].min(initial=np.inf))
        self._is_symmetric = bool(board_turns_deg(board))
        self.reset()

    def reset(self) -> None:
        """Forget all frames, as before another film."""
        self._filter: PoseFilter | None = None
        self._found_s, self._time_s = -np.inf, -1 / self.fps
        self._points_ambiguous = False
        self._blur_px = np.full(len(self.board.keypoints), USUAL_BLUR_PX)

    def __call__(self, image: UInt8 | None, time_s: float | None = None) -> TrackedPose:
        """Return what is known of the next frame.

        Parameters
        ----------
        image : ndarray of shape (H, W) or (H, W, 3), uint8, or None
            Grey or RGB; None for a frame that cannot be read.
        time_s : float, optional
            Time of the frame. None: one frame after the last one.

        Raises
        ------
        DataError
            If the frame has another size than the camera, and no whole-number multiple or fraction of it.
        """
        self._time_s = self._time_s + 1 / self.fps if time_s is None else time_s
        if self._filter is not None:
            self._filter.predict(self._time_s)
        if image is None:
            return self._guess("the frame cannot be read")
        camera = self.camera.at_size(image.shape[1], image.shape[0])
        if self._filter is not None and self._filter.updates >= 2:
            found = self._track(image, camera, self._filter.pose)
            if found is not None:
                return self._accept("tracked", *found)
        found, reason = self._look(image, camera)
        return self._guess(reason) if found is None else self._accept("seen", *found)

    def _accept(self, state: State, match: BoardMatch, pose: BoardPose) -> TrackedPose:
        """Return a measured pose, and tell the filter."""
        before = self._filter
        if before is not None and pose.second is not None:  # of two poses, the nearer to the prediction is likelier
            nearest = min((pose, pose.second), key=lambda p: _turn_rad(p, before))
            if nearest is not pose:
                pose = replace(nearest, ambiguous=True, second=replace(pose, ambiguous=False, second=None))
        self._points_ambiguous = match.ambiguous if state == "seen" else self._points_ambiguous
        pose = replace(pose, ambiguous=pose.ambiguous or self._points_ambiguous)
        if before is None:
            self._filter = PoseFilter(pose, self._time_s)
        else:
            before.update(pose)
        self._found_s = self._time_s
        if match.detections.blur_px is not None:
            self._blur_px[match.points] = match.detections.blur_px
        assert self._filter is not None
        return TrackedPose(state, pose, self._filter.pose, match)

    def _guess(self, reason: str) -> TrackedPose:
        """Return the prediction, if it is not too old."""
        if self._filter is None or self._time_s - self._found_s > self.guess_s:
            self._filter = None
            return TrackedPose("", reason=reason)
        return TrackedPose("predicted", None, self._filter.pose, reason=reason)

    def _look(self, image: UInt8, camera: Camera) -> tuple[tuple[BoardMatch, BoardPose] | None, str]:
        """Look for the board in the whole image. Return it, or why it has no pose."""
        matches = find_board(self.detector(image), self.board, camera)
        if not matches:
            return None, "the board was not found"
        match = matches[0]
        if not match.is_sure or (match.alternatives and not self._is_symmetric):
            return None, "the points are ambiguous"
        if self._filter is None and len(match.points) < LEAST_TRACKED:
            return None, f"{len(match.points)} points, expected at least {LEAST_TRACKED} to begin with"
        try:
            return (match, estimate_pose(match, camera)), ""
        except DataError as error:
            return None, str(error).removeprefix(f"board {self.board.name!r}: ")

    def _track(self, image: UInt8, camera: Camera, pose: BoardPose) -> tuple[BoardMatch, BoardPose] | None:
        """Look for the board in windows around its predicted patches."""
        H = np.column_stack([pose.rotation[:, :2], pose.translation_mm])
        predicted = predict_patches(H, self.board, camera, (camera.width_px, camera.height_px))
        points, A = predicted.points, predicted.A
        if len(points) < LEAST_TRACKED:
            return None
        radius = short_semi_axis(A)
        gap_px = self._gap_mm * float(
            np.median(np.sqrt(np.abs(np.linalg.det(A / self._radius_mm[points, None, None]))))
        )
        largest = min(SHIFT_REACH, 0.45 * gap_px / float(radius.mean()))  # a longer shift would fit other patches
        for reach, shift in ((WINDOW_REACH, 0.0), (WINDOW_REACH + largest, largest)):
            search = WindowSearch(self._templates, self._design[points])
            windows = cut_windows(image, predicted.xy, A, self._extent[points], reach)
            fit, moved = search.find(windows, predicted, self._blur_px[points], shift)
            good = np.flatnonzero(
                (fit.ncc >= LEAST_NCC) & (moved <= LARGEST_MOVE) & (fit.contrast > LEAST_PATCH_CONTRAST)
            )
            if len(good) < max(LEAST_TRACKED, LEAST_SHARE * len(points)) and not shift:
                continue
            detections = Detections(
                fit.xy, np.maximum(fit.ncc, 0), self._ids[points], fit.A, fit.covariance, fit.blur_px
            )
            found = self._verify(points[good], detections[good], camera)
            if found is not None:
                return found
        return None

    def _verify(self, points: Int, detections: Detections, camera: Camera) -> tuple[BoardMatch, BoardPose] | None:
        """Return the points that agree with one pose, and the pose."""
        while len(points) >= LEAST_TRACKED:
            frames, agrees = straighten(detections, camera), np.ones(len(points), bool)
            index = np.arange(len(points))
            match = BoardMatch(self.board, index, points, detections, agrees, camera=camera, frames=frames)
            try:
                pose = estimate_pose(match, camera)
            except DataError:
                return None
            off = camera.project(self.board.points_mm[points] @ pose.rotation.T + pose.translation_mm) - detections.xy
            assert detections.covariance is not None
            spread = detections.covariance + OFF_FLOOR_PX**2 * np.eye(2)
            squares = np.einsum("ni,ni->n", off, np.linalg.solve(spread, off[..., None])[..., 0])
            if squares.max() <= LARGEST_OFF:
                return match, pose
            kept = np.delete(index, int(squares.argmax()))
            points, detections = points[kept], detections[kept]
        return None


def _turn_rad(pose: BoardPose, motion: PoseFilter) -> float:
    """Return the angle between a pose and the filtered one."""
    return float(np.linalg.norm(rotation_vector(pose.rotation @ motion.rotation.T)))
