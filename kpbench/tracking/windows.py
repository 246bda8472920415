"""Windows of an image around predicted patches: where a patch is, and how well it agrees with its design.

A window is a square of the image around a predicted patch, at the scale at which the patch has a semi-axis of at most
``WINDOW_RADIUS_PX``. All windows of a frame have the same side and lie below each other in one image, the strip.
Nothing else of the frame is read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from kpbench.fitting.align import WHOLE_RADIUS_PX, Poses, align_poses, short_semi_axis
from kpbench.fitting.pyramid import choose_level, normalise_rows, sample_pyramid
from kpbench.fitting.sampled_fit import SampledFit, fit_samples
from kpbench.fitting.templates import DesignTemplates
from kpbench.images import to_grey
from kpbench.patches.design import Patch
from kpbench.tracking.prediction import PredictedPatches
from kpbench.types import Float, Float32, Int, UInt8

WINDOW_RADIUS_PX = 24.0
"""Largest long semi-axis of a patch, rim included, in its window, px of the window."""
RIM = 1.4
"""Part of a window that the patch itself takes, in long semi-axes."""
LEAST_NCC = 0.7
"""Least correlation of a fitted patch with its design. What is no patch seldom reaches 0.6."""
LEAST_PATCH_CONTRAST = 4.0
"""Least contrast of a patch, white minus black, grey levels."""
USUAL_BLUR_PX = 0.8
"""Blur from which a first fit starts, px."""
SHIFT_STEP = 0.35
"""Distance of the shifts that are tried, in short semi-axes. The alignment finds its way from half as far."""


@dataclass(frozen=True)
class Windows:
    """N windows of an image.

    Attributes
    ----------
    strip : ndarray of shape (N * side, side), float32
        The windows, one below the other.
    side : int
        Side of a window, px of the window.
    origin : ndarray of shape (N, 2)
        Image point, px, of the first pixel of each window.
    scale : ndarray of shape (N,)
        Px of the image per px of each window: a power of two.
    """

    strip: Float32
    side: int
    origin: Float
    scale: Float

    def to_strip(self, xy: Float, A: Float) -> tuple[Float, Float]:
        """Convert poses from px of the image to px of the strip."""
        return (xy - self.origin) / self.scale[:, None] + self._offset, A / self.scale[:, None, None]

    def to_image(self, xy: Float, A: Float) -> tuple[Float, Float]:
        """Convert poses from px of the strip to px of the image."""
        return (xy - self._offset) * self.scale[:, None] + self.origin, A * self.scale[:, None, None]

    @property
    def _offset(self) -> Float:
        return np.column_stack([np.zeros(len(self.scale)), self.side * np.arange(len(self.scale))])


def cut_windows(image: UInt8, xy: Float, A: Float, extent: Float, reach: float) -> Windows:
    """Cut a window around each of N predicted patches.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    xy, A : ndarray of shape (N, 2) and (N, 2, 2)
        Predicted poses, px. Every centre lies in the image.
    extent : ndarray of shape (N,)
        Outer radius of each patch, in disc radii.
    reach : float
        Largest error of the prediction that the windows hold, in long semi-axes.
    """
    size = np.linalg.norm(A, 2, axis=(1, 2)) * extent
    level = np.ceil(np.log2(np.maximum(size / WINDOW_RADIUS_PX, 1.0))).astype(np.int64)
    scale = 2.0**level
    half = int(np.ceil((size / scale).max() * (RIM + reach))) + 2
    side, (height, width) = 2 * half, image.shape[:2]
    first = (np.rint(xy / scale[:, None]).astype(np.int64) - half) * 2 ** level[:, None]
    strip = np.empty((len(xy) * side, side), np.float32)
    for n, ((x, y), octaves) in enumerate(zip(first.tolist(), level.tolist(), strict=True)):
        right, bottom = x + side * 2**octaves, y + side * 2**octaves
        part = to_grey(image[max(y, 0) : min(bottom, height), max(x, 0) : min(right, width)])
        if part.shape != (bottom - y, right - x):
            margins = max(-y, 0), max(bottom - height, 0), max(-x, 0), max(right - width, 0)
            part = np.asarray(cv2.copyMakeBorder(part, *margins, cv2.BORDER_REPLICATE), np.uint8)
        window = part.astype(np.float32)
        for _ in range(octaves):
            window = np.asarray(cv2.pyrDown(window), np.float32)
        strip[n * side : (n + 1) * side] = window
    return Windows(strip, side, first.astype(np.float64), scale)


@dataclass(frozen=True)
class WindowSearch:
    """The search for patches in their windows.

    Attributes
    ----------
    templates : DesignTemplates
        Of the designs of a board.
    design : ndarray of shape (N,), int64
        Index of the design of each patch.
    """

    templates: DesignTemplates
    design: Int

    @property
    def patches(self) -> list[Patch]:
        """The design of each patch."""
        return [self.templates.patches[n] for n in self.design]

    def find(
        self, windows: Windows, predicted: PredictedPatches, blur_px: Float, largest_shift: float
    ) -> tuple[SampledFit, Float]:
        """Find patches near their predicted poses.

        Parameters
        ----------
        windows : Windows
        predicted : PredictedPatches
            N patches.
        blur_px : ndarray of shape (N,)
            Standard deviations of the blur to start from, px of the image.
        largest_shift : float
            Half the side of the square of shifts, common to all patches, that are tried first, in mean short
            semi-axes. 0 tries none.

        Returns
        -------
        fit : SampledFit
            In px of the image.
        moved : ndarray of shape (N,)
            Distance of the fitted centre from the aligned one, in short semi-axes.
        """
        levels = [np.asarray(cv2.GaussianBlur(windows.strip, (0, 0), 0.7), np.float32)]
        while len(levels) < 3:
            levels.append(np.asarray(cv2.pyrDown(levels[-1]), np.float32))
        xy, A = windows.to_strip(predicted.xy, predicted.A)
        if largest_shift:
            xy = xy + self._find_shift(levels, xy, A, largest_shift) / windows.scale[:, None] * windows.scale.mean()
        poses = Poses(xy, A, self.design, np.zeros(len(xy)))
        poses = align_poses(levels, poses, self.templates.whole, 2, WHOLE_RADIUS_PX)
        fit = fit_samples(windows.strip, poses.xy, poses.A, predicted.bend, self.patches, blur_px / windows.scale)
        moved = np.linalg.norm(fit.xy - poses.xy, axis=1) / np.maximum(short_semi_axis(poses.A), 0.5)
        centres, maps = windows.to_image(fit.xy, fit.A)
        covariance = fit.covariance * windows.scale[:, None, None] ** 2
        return SampledFit(centres, maps, fit.contrast, fit.blur_px * windows.scale, fit.ncc, covariance), moved

    def _find_shift(self, levels: Sequence[Float32], xy: Float, A: Float, largest: float) -> Float:
        """Return the shift (2,), px of the strip, at which the designs agree best with the windows."""
        whole, minor = self.templates.whole, short_semi_axis(A)
        ticks = np.arange(-largest, largest + SHIFT_STEP / 2, SHIFT_STEP) * float(minor.mean())
        shifts = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 1, 2)
        count = len(shifts)
        level = np.tile(choose_level(minor, WHOLE_RADIUS_PX, levels), count)
        places = (xy + shifts).reshape(-1, 2)
        values = normalise_rows(sample_pyramid(levels, level, places, np.tile(A, (count, 1, 1)), whole.points))
        ncc = np.einsum("snm,nm->sn", values.reshape(count, len(xy), -1), whole.ink[self.design])
        return np.asarray(shifts[np.maximum(ncc, 0).mean(axis=1).argmax(), 0])
