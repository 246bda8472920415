"""The lens: its point-spread function, its fall of light towards the corners, and its lateral chromatic aberration.

All functions give the same bits on every processor, see :mod:`kpbench.portable` and :mod:`kpbench.filters`.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from kpbench.filters import BORDER_MODE, to_whole_weights
from kpbench.portable import arctan2, cos_sin, matmul
from kpbench.types import Float, Float32

LIGHT_UNIT, WEIGHT_UNIT = 2**20, 2**20
"""Steps of the light 1.0, and the sum of the whole weights of a kernel. Sums of products are whole numbers below 2⁴⁴,
which float64 holds exactly. The error of a Fourier transform is far below one half, and rounding removes the error."""
BRIGHTEST_LIGHT = 16
"""Light beyond this number is cut before the blur, so that sums stay below 2⁴⁴."""
MOST_DIRECT_KERNEL_WEIGHTS = 49
"""Largest number of weights that are summed directly. With more weights, the Fourier transform is faster."""
REACH_IN_AIRY_RADII = 3.24
"""Reach of the kernel in units of wavelength x f-number: the third dark ring, within which 94 % of the light falls."""
JINC_STEP, JINC_END, JINC_NODES = 1 / 64, 160.0, 224
"""Step and end of the table of 2 J₁(x) / x, and the number of nodes of its integral."""

LARGEST_DEFOCUS_PX = 35.0
"""Largest radius of the disc of defocus; with this radius, the table reaches the largest frequency, 0.71 per px."""


@lru_cache(maxsize=1)
def _jinc_table() -> Float:
    """Return 2 J₁(x) / x on the grid of the table.

    J₁(x) = (1/π) ∫₀^π cos(τ - x sin τ) dτ (Bessel's integral; Abramowitz & Stegun 9.1.21). The rule of equal steps is
    exact to rounding once it has more nodes than x, since the integrand is periodic.
    """
    x = np.arange(1, int(JINC_END / JINC_STEP) + 2) * JINC_STEP
    total = np.zeros_like(x)
    cosines, sines = cos_sin((np.arange(JINC_NODES) + 0.5) * (np.pi / JINC_NODES))
    for cosine, sine in zip(cosines.tolist(), sines.tolist(), strict=True):
        c, s = cos_sin(x * sine)
        total += cosine * c + sine * s  # cos(τ - x sin τ)
    return np.concatenate([[1.0], 2 * total / JINC_NODES / x])


def _jinc(x: Float) -> Float:
    """Return 2 J₁(x) / x for x from 0 to 160, linear between the table's entries, accurate to 1e-5."""
    steps = x / JINC_STEP
    below = np.floor(steps).astype(np.int64)
    table = _jinc_table()
    low = table[below]
    return np.asarray(low + (table[below + 1] - low) * (steps - below))


def _transfer_function(frequency: Float, airy_unit_px: float, defocus_px: float) -> Float:
    """Return the optical transfer function of a lens at frequencies in cycles per px."""
    share = np.minimum(frequency * airy_unit_px, 1)
    rest = np.sqrt(1 - share * share)
    diffraction = (2 / np.pi) * (arctan2(rest, share) - share * rest)
    return np.asarray(diffraction * _jinc(2 * np.pi * defocus_px * frequency))


@lru_cache(maxsize=64)
def psf_kernel(
    wavelength_um: float, f_number: float, pixel_um: float, defocus_px: float = 0.0, reach_px: int | None = None
) -> Float:
    """Return the point-spread function of a lens as a kernel: diffraction, then the disc of defocus.

    Diffraction at a circular aperture in incoherent light spreads a point to the Airy pattern ``(2 J₁(v) / v)²`` with
    ``v = π r / (wavelength f-number)``. Its transfer function is ``2/π (arccos ν - ν √(1 - ν²))``, where ν is the
    frequency times wavelength and f-number (Goodman, Introduction to Fourier Optics, 3rd ed., eq. 6-31; Born & Wolf,
    Principles of Optics, 8.5.2). Defocus spreads a point to a uniform disc (geometrical optics; Goodman, 6.4.4).

    The kernel has the transfer function of the lens up to the Nyquist frequency. The aperture of the pixel is not part
    of the kernel, since the area coverage of the scene already holds it. Negative weights are set to 0 and light beyond
    the reach is left out. Both change the transfer function by at most 0.09, and by less than 0.05 as a rule.

    Parameters
    ----------
    wavelength_um : float
        Wavelength of the light, μm; 0 leaves out diffraction.
    f_number : float
        Focal length divided by the diameter of the aperture.
    pixel_um : float
        Distance between pixels, μm.
    defocus_px : float
        Radius of the disc of defocus, px, at most 35.
    reach_px : int, optional
        Number of weights on each side of the middle. As a rule, the third dark ring beyond the disc of defocus.

    Returns
    -------
    ndarray of shape (2 reach + 1, 2 reach + 1), read-only
        Weights of at least 0 with the sum 1. The kernel is equal to its mirror images and to its transpose.

    Examples
    --------
    >>> from kpbench.camera import psf_kernel
    >>> kernel = psf_kernel(wavelength_um=0.55, f_number=2.8, pixel_um=3.0)
    >>> kernel.shape, float(kernel[2, 2].round(2))
    ((5, 5), 0.77)
    """
    if not 0 <= defocus_px <= LARGEST_DEFOCUS_PX:
        raise ValueError(f"defocus_px is {defocus_px:g}, expected 0 to {LARGEST_DEFOCUS_PX:g}")
    airy_unit_px = wavelength_um * f_number / pixel_um
    if reach_px is None:
        reach_px = max(1, int(np.ceil(REACH_IN_AIRY_RADII * airy_unit_px + defocus_px)))
    half = 1 << max(6, (2 * reach_px).bit_length())  # half a period of the kernel in px
    fx = np.arange(half + 1) / (2 * half)
    transfer = _transfer_function(np.sqrt(fx * fx + (fx * fx)[:, None]), airy_unit_px, defocus_px)
    # inverse cosine transform of a function that is even in both frequencies
    weights = np.where((fx > 0) & (fx < 0.5), 2.0, 1.0)
    cosines = cos_sin(2 * np.pi * np.arange(reach_px + 1)[:, None] * fx)[0] * weights
    quadrant = np.maximum(matmul(matmul(cosines, transfer), cosines.T.copy()), 0)
    quadrant = quadrant + quadrant.T
    rows = np.concatenate([quadrant[:0:-1], quadrant])
    kernel = np.concatenate([rows[:, :0:-1], rows], axis=1)
    kernel /= kernel.sum(axis=0).sum()
    kernel.flags.writeable = False
    return kernel


@lru_cache(maxsize=4)
def _kernel_spectrum(weights: bytes, side: tuple[int, int], shape: tuple[int, int]) -> Any:
    """Return the packed spectrum of a kernel of whole weights, padded to a shape."""
    padded = np.zeros(shape)
    padded[: side[0], : side[1]] = np.frombuffer(weights).reshape(side)
    return cv2.dft(padded)


def _filter_plane(plane: Any, weights: Float) -> Any:
    """Correlate a plane of whole numbers with whole weights; return the exact sums, float64."""
    if weights.size <= MOST_DIRECT_KERNEL_WEIGHTS:
        return cv2.filter2D(plane, -1, weights, borderType=BORDER_MODE)
    height, width = plane.shape
    rows, columns = weights.shape
    shape = cv2.getOptimalDFTSize(height + rows - 1), cv2.getOptimalDFTSize(width + columns - 1)
    reach_y, reach_x = rows // 2, columns // 2
    padded = cv2.copyMakeBorder(plane, reach_y, reach_y, reach_x, reach_x, BORDER_MODE)
    # the sums near the far ends are those that the circle of the transform spoils, and nobody reads them
    padded = cv2.copyMakeBorder(
        padded, 0, shape[0] - padded.shape[0], 0, shape[1] - padded.shape[1], cv2.BORDER_CONSTANT, value=0
    )
    spectrum = cv2.dft(padded, nonzeroRows=height + rows - 1)
    product = cv2.mulSpectrums(spectrum, _kernel_spectrum(weights.tobytes(), (rows, columns), shape), 0, conjB=True)
    sums: Any = cv2.dft(product, flags=cv2.DFT_INVERSE | cv2.DFT_SCALE, nonzeroRows=height)
    sums = sums[:height, :width]
    return np.rint(sums, out=sums)


def blur_linear(light: Float32, kernel: Float) -> Float32:
    """Correlate linear light with a kernel.

    The light is rounded to whole 2⁻²⁰, the weights too. All sums are exact, so every processor gives the same bits.
    Beyond its border, the image continues as its mirror image about the outermost pixel.

    Parameters
    ----------
    light : ndarray of shape (H, W) or (H, W, 3), float32
        Cut to the range 0 to 16.
    kernel : ndarray of shape (h, w), h and w odd
        Weights of at least 0; scaled to the sum 1.

    Returns
    -------
    ndarray of the same shape, float32

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera import blur_linear
    >>> blur_linear(np.array([[0, 0, 0.5, 0, 0]], np.float32), np.array([[1, 2, 1]])).tolist()
    [[0.0, 0.125, 0.25, 0.125, 0.0]]
    """
    weights = to_whole_weights(kernel, WEIGHT_UNIT)
    steps = light * np.float32(LIGHT_UNIT)
    np.rint(np.clip(steps, 0, BRIGHTEST_LIGHT * LIGHT_UNIT, out=steps), out=steps)
    planes = [steps] if light.ndim == 2 else cv2.split(steps)
    sums = [_filter_plane(plane.astype(np.float64), weights) for plane in planes]
    blurred = [(total * (1 / (LIGHT_UNIT * WEIGHT_UNIT))).astype(np.float32) for total in sums]
    return np.asarray(blurred[0] if light.ndim == 2 else cv2.merge(blurred), np.float32)


@lru_cache(maxsize=4)
def _square_distances(shape: tuple[int, int], centre_px: tuple[float, float]) -> Float32:
    """Return the square of each pixel's distance from the centre, px², ndarray of shape (H, W), float32."""
    height, width = shape
    dx, dy = np.arange(width) - centre_px[0], np.arange(height) - centre_px[1]
    return np.asarray(dx * dx + (dy * dy)[:, None], np.float32)


def _vignetting_map(
    shape: tuple[int, int],
    focal_length_px: float | None,
    polynomial: tuple[float, ...],
    centre_px: tuple[float, float],
) -> Float32:
    """Return the fraction of the light that reaches each pixel, ndarray of shape (H, W), float32."""
    square = _square_distances(shape, centre_px)
    gain = np.full_like(square, polynomial[-1] if polynomial else 0.0)
    scale = np.float32(4 / (shape[0] ** 2 + shape[1] ** 2))  # half of the diagonal is the unit
    for coefficient in (*reversed(polynomial[:-1]), 1.0):
        gain *= square
        gain *= scale
        gain += np.float32(coefficient)
    np.maximum(gain, 0, out=gain)
    if focal_length_px is not None:
        slant = 1 + square * np.float32(1 / focal_length_px**2)
        gain /= slant * slant
    return np.asarray(gain, np.float32)


def vignetting(
    light: Float32,
    focal_length_px: float | None = None,
    polynomial: tuple[float, ...] = (),
    centre_px: tuple[float, float] | None = None,
) -> Float32:
    """Darken an image towards its corners. The light at the centre stays.

    The natural fall is cos⁴ of the angle to the axis, ``(1 + r²/f²)⁻²`` (Born & Wolf, 4.8.2). Shading by the barrel is
    ``1 + p₁ ρ² + p₂ ρ⁴ + …``, where ρ is the distance from the centre divided by half the diagonal of the image
    (Goldman, Vignette and Exposure Calibration and Compensation, PAMI 2010). The two factors are multiplied.

    Parameters
    ----------
    light : ndarray of shape (H, W) or (H, W, 3), float32
    focal_length_px : float, optional
        Focal length of the cos⁴ law, px. Without it, there is no natural fall.
    polynomial : tuple of float
        p₁, p₂, …; a factor below 0 counts as 0.
    centre_px : (float, float), optional
        x and y of the centre, px; the image's centre if left out.

    Returns
    -------
    ndarray of the same shape, float32

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera import vignetting
    >>> vignetting(np.ones((1, 5), np.float32), focal_length_px=2).tolist()
    [[0.25, 0.6399999856948853, 1.0, 0.6399999856948853, 0.25]]
    """
    height, width = light.shape[:2]
    centre = centre_px or ((width - 1) / 2, (height - 1) / 2)
    gain = _vignetting_map((height, width), focal_length_px, tuple(polynomial), centre)
    return np.asarray(light * (gain if light.ndim == 2 else gain[..., None]))


def chromatic_scales(red_px: float, blue_px: float, size_px: tuple[int, int]) -> tuple[float, float, float]:
    """Return the scales of the red, green and blue image about the centre under lateral chromatic aberration.

    The lens images each colour at its own magnification (Mallon & Whelan, Calibration and removal of lateral chromatic
    aberration in images, 2007, the terms of first order). Green is the colour of the truth.

    Parameters
    ----------
    red_px, blue_px : float
        Shift of red and of blue at the image's corner, px, away from the centre.
    size_px : (int, int)
        Width and height of the image.

    Returns
    -------
    red, green, blue : float
        A point at the vector v from the centre lies at v times the scale of its colour.

    Examples
    --------
    >>> from kpbench.camera import chromatic_scales
    >>> chromatic_scales(1.0, -0.5, (640, 480))
    (1.0025, 1.0, 0.99875)
    """
    half_diagonal = float(np.sqrt(size_px[0] ** 2 + size_px[1] ** 2)) / 2
    return 1 + red_px / half_diagonal, 1.0, 1 + blue_px / half_diagonal
