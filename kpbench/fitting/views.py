"""Views: the image in the frame of a patch, as the networks of the verification see it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kpbench.fitting.align import short_semi_axis
from kpbench.fitting.pyramid import find_samples_outside, sample_pyramid
from kpbench.fitting.templates import VIEW_PX, VIEW_REACH, DesignTemplates, view_points
from kpbench.types import Float, Float32, Int

OCTAVES = 4
"""Number of octaves of :func:`sample_surroundings`: squares of 32, 64, 128 and 256 px of the image."""
INK_LIMIT = 2.5
"""The inks of a view are clipped to ± this limit. White is 1 and black is -1."""
HALF_CONTRAST_RANGE = (2.0, 128.0)
"""Range to which a measured half contrast, (white - black) / 2, is clipped, grey levels."""


def rectify(
    levels: Sequence[Float32], xy: Float, A: Float, design: Int, templates: DesignTemplates
) -> tuple[Float32, Float]:
    """Return views of N patches: the image in the patch frame, with grey levels converted to inks.

    Parameters
    ----------
    levels : list of ndarray
        From :func:`kpbench.fitting.pyramid.build_pyramid`.
    xy, A : ndarray of shape (N, 2) and (N, 2, 2)
        Poses, px.
    design : ndarray of shape (N,), int64
        Index of each patch's design.
    templates : DesignTemplates

    Returns
    -------
    views : ndarray of shape (N, VIEW_PX²), float32
        ink = (grey − offset) / half_contrast, so white is 1 and black is -1. ``offset`` and ``half_contrast`` come from
        a linear regression of the grey level on the design's ink, over the pixels of the disc. Inks are clipped to
        ±INK_LIMIT. Pixels outside the image are nan.
    half_contrast : ndarray of shape (N,)
        (white - black) / 2, grey levels, clipped to ``HALF_CONTRAST_RANGE``. If white is darker than black, the value
        is therefore the lower limit.
    """
    points = view_points()
    px = short_semi_axis(A) * 2 * VIEW_REACH / VIEW_PX
    level = np.clip(np.rint(np.log2(np.maximum(px, 1e-6))), 0, len(levels) - 1).astype(np.int64)
    grey = sample_pyramid(levels, level, xy, A, points)
    cut, outside = find_samples_outside(levels[0], xy, A, points)
    grey[cut] = np.where(outside, np.nan, grey[cut])
    disc = np.hypot(*points.T) < 1
    part, model = grey[:, disc], templates.view[design][:, disc]
    inside = ~np.isnan(part)
    weight = inside / np.maximum(inside.sum(axis=1, keepdims=True), 1, dtype=np.float32)
    part = np.where(inside, part, 0)
    mean_grey, mean_ink = (np.einsum("nm,nm->n", weight, column) for column in (part, model))
    centred = weight * (model - mean_ink[:, None])
    slope = np.einsum("nm,nm->n", part, centred) / (np.einsum("nm,nm->n", model, centred) + 0.01)
    slope = np.clip(slope, *HALF_CONTRAST_RANGE)
    offset = mean_grey - slope * mean_ink
    return np.clip((grey - offset[:, None]) / slope[:, None], -INK_LIMIT, INK_LIMIT), slope.astype(np.float64)


def blur_views(views: Float32, A: Float, blur_px: Float) -> Float32:
    """Blur views (N, VIEW_PX²) as if the image had Gaussian blurs of standard deviations ``blur_px`` (N,) px.

    ``A`` (N, 2, 2) maps the frame of each patch to the image.
    """
    side = VIEW_PX
    waves = 2 * np.pi * np.fft.fftfreq(side, 2 * VIEW_REACH / side)
    wave = np.stack(np.meshgrid(waves, waves[: side // 2 + 1], indexing="ij")[::-1], axis=-1)
    in_image = np.einsum("yxi,nij->nyxj", wave, np.linalg.inv(A))
    passed = np.exp(-0.5 * np.einsum("nyxj,nyxj,n->nyx", in_image, in_image, blur_px**2))
    spectrum = np.fft.rfft2(views.reshape(-1, side, side))
    return np.fft.irfft2(spectrum * passed, s=(side, side)).reshape(views.shape).astype(np.float32)


def sample_surroundings(
    levels: Sequence[Float32], xy: Float, A: Float | None = None, octave: Int | None = None
) -> Float32:
    """Return the grey values around N places in several octaves of the image.

    Parameters
    ----------
    levels : list of ndarray
        From :func:`kpbench.fitting.pyramid.build_pyramid`.
    xy : ndarray of shape (N, 2)
        Places, px.
    A : ndarray of shape (N, 2, 2), optional
        Map from px of the result's finest octave to px of level ``octave``. None: the identity.
    octave : ndarray of shape (N,), int64, optional
        Level of the result's finest octave. None: the image itself, level 0.

    Returns
    -------
    ndarray of shape (N, OCTAVES, VIEW_PX, VIEW_PX), float32
    """
    ticks = np.arange(VIEW_PX) - (VIEW_PX - 1) / 2
    points = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    A = np.tile(np.eye(2), (len(xy), 1, 1)) if A is None else A
    finest = np.zeros(len(xy), np.int64) if octave is None else octave
    grey = np.empty((len(xy), OCTAVES, len(points)), np.float32)
    for k in range(OCTAVES):
        level = np.minimum(finest + k, len(levels) - 1)
        grey[:, k] = sample_pyramid(levels, level, xy, A * 2.0 ** (finest + k)[:, None, None], points)
    return grey.reshape(-1, OCTAVES, VIEW_PX, VIEW_PX)
