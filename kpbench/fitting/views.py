"""The image in the frame of a patch, as the judges see it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kpbench.fitting.align import short_axis
from kpbench.fitting.pyramid import outside_image, sample
from kpbench.fitting.templates import LOOKUP_HALF, VIEW_PX, Bank, view_points
from kpbench.types import Float, Float32, Int


def rectify(levels: Sequence[Float32], xy: Float, A: Float, which: Int, known: Bank) -> tuple[Float32, Float]:
    """What the image shows in the frame of a patch: upright, undistorted, and free of its inks.

    Returns
    -------
    (N, VIEW_PX²) ink, white 1 and black -1 by the least-squares line over the disc, clipped to ±2.5, nan outside the
    image; (N,) half of the contrast, grey levels, from 2 to 128, 2 also where the inks are the other way round.
    """
    points = view_points()
    px = short_axis(A) * 2 * LOOKUP_HALF / VIEW_PX
    level = np.clip(np.rint(np.log2(np.maximum(px, 1e-6))), 0, len(levels) - 1).astype(np.int64)
    grey = sample(levels, level, xy, A, points)
    cut, outside = outside_image(levels[0], xy, A, points)
    grey[cut] = np.where(outside, np.nan, grey[cut])
    disc = np.hypot(*points.T) < 1
    part, model = grey[:, disc], known.picture[which][:, disc]
    inside = ~np.isnan(part)
    weight = inside / np.maximum(inside.sum(axis=1, keepdims=True), 1, dtype=np.float32)
    part = np.where(inside, part, 0)
    middle, mean = (np.einsum("nm,nm->n", weight, column) for column in (part, model))
    centred = weight * (model - mean[:, None])
    slope = np.einsum("nm,nm->n", part, centred) / (np.einsum("nm,nm->n", model, centred) + 0.01)
    slope = np.clip(slope, 2.0, 128.0)
    level_grey = middle - slope * mean
    return np.clip((grey - level_grey[:, None]) / slope[:, None], -2.5, 2.5), slope.astype(np.float64)


def blurred(pictures: Float32, A: Float, blur_px: Float) -> Float32:
    """Pictures (N, VIEW_PX²) in the frame of a patch, under a Gaussian blur of so many px (N,) of the image."""
    side = VIEW_PX
    waves = 2 * np.pi * np.fft.fftfreq(side, 2 * LOOKUP_HALF / side)
    wave = np.stack(np.meshgrid(waves, waves[: side // 2 + 1], indexing="ij")[::-1], axis=-1)
    in_image = np.einsum("yxi,nij->nyxj", wave, np.linalg.inv(A))
    passed = np.exp(-0.5 * np.einsum("nyxj,nyxj,n->nyx", in_image, in_image, blur_px**2))
    spectrum = np.fft.rfft2(pictures.reshape(-1, side, side))
    return np.fft.irfft2(spectrum * passed, s=(side, side)).reshape(pictures.shape).astype(np.float32)


OCTAVES = 4
"""Octaves of :func:`surroundings`: 32 to 256 px of the image."""


def surroundings(levels: Sequence[Float32], xy: Float, A: Float | None = None) -> Float32:
    """Grey values (N, OCTAVES, VIEW_PX, VIEW_PX) around places (N, 2) px: as many px of each octave.

    ``A`` (N, 2, 2) turns and scales what is shown.
    """
    ticks = np.arange(VIEW_PX) - (VIEW_PX - 1) / 2
    points = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    A = np.tile(np.eye(2), (len(xy), 1, 1)) if A is None else A
    grey = np.empty((len(xy), OCTAVES, len(points)), np.float32)
    for octave in range(OCTAVES):
        level = np.full(len(xy), min(octave, len(levels) - 1))
        grey[:, octave] = sample(levels, level, xy, A * 2.0**octave, points)
    return grey.reshape(-1, OCTAVES, VIEW_PX, VIEW_PX)
