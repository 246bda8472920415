"""The sensor: from linear light to raw digital numbers, by the linear camera model of EMVA Standard 1288.

Random numbers come from 16-bit draws and from tables. The same generator gives the same bits on every processor.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.portable import exp, normal_quantiles
from kpbench.types import Float32, UInt8

UInt16 = NDArray[np.uint16]

FEW_ELECTRONS = 32
"""Below this mean, photon noise is Poisson-distributed by table. From this mean on, photon noise is normal."""
POISSON_LEVELS, POISSON_BITS = 128, 12
"""Number of means in the table of the Poisson distribution, and bits of the uniform number that picks a count."""


def draw_normals(shape: tuple[int, ...], rng: np.random.Generator) -> Float32:
    """Draw standard normal numbers, each one of 2¹⁶ equally likely values from -4.3 to 4.3.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera.sensor import draw_normals
    >>> round(float(draw_normals((100, 100), np.random.default_rng(4)).std()), 1)
    1.0
    """
    draws = _draw_16_bits(int(np.prod(shape)), rng)
    return np.asarray(cv2.LUT(draws.reshape(shape[0], -1), _normal_table()), np.float32).reshape(shape)


def _draw_16_bits(count: int, rng: np.random.Generator) -> UInt16:
    return np.frombuffer(rng.bytes(2 * count), "<u2").astype(np.uint16, copy=False)


@lru_cache(maxsize=1)
def _normal_table() -> Any:
    return normal_quantiles().astype(np.float32)


@lru_cache(maxsize=1)
def _poisson_table() -> UInt8:
    """Return the counts of the Poisson distribution.

    Row k belongs to the mean ``FEW_ELECTRONS * (k / (POISSON_LEVELS - 1))²``. A row holds each count as often as the
    count is likely, in ascending order.

    Returns
    -------
    ndarray of shape (POISSON_LEVELS * 2**POISSON_BITS,), uint8
    """
    means = FEW_ELECTRONS * (np.arange(POISSON_LEVELS) / (POISSON_LEVELS - 1)) ** 2
    counts = np.arange(128)
    likely = exp(-means)
    below, rows = np.zeros(POISSON_LEVELS), []
    for count in counts.tolist():
        below = below + likely
        rows.append(np.rint(np.minimum(below, 1) * 2**POISSON_BITS))
        likely = likely * means / (count + 1)
    often = np.diff(np.array(rows), axis=0, prepend=0).astype(np.int64)
    often[-1] += 2**POISSON_BITS - often.sum(axis=0)
    return np.repeat(np.tile(counts.astype(np.uint8), POISSON_LEVELS), often.T.ravel())


def _draw_poisson(mean: Any, rng: np.random.Generator) -> Any:
    """Draw Poisson-distributed counts for means below ``FEW_ELECTRONS``, ndarray of shape (n,), float32.

    A mean between two rows of the table takes one of the two at random, so that the expectation stays. Four of the 16
    random bits choose the row.
    """
    draws = _draw_16_bits(mean.size, rng)
    place = np.sqrt(mean * np.float32((POISSON_LEVELS - 1) ** 2 / FEW_ELECTRONS))
    place += ((draws >> POISSON_BITS).astype(np.float32) + np.float32(0.5)) * np.float32(2.0 ** (POISSON_BITS - 16))
    index = place.astype(np.int32)
    index <<= POISSON_BITS
    index |= (draws & (2**POISSON_BITS - 1)).astype(np.int32)
    return _poisson_table().take(index).astype(np.float32)


def _draw_electrons(mean: Any, read_noise_e: float, rng: np.random.Generator) -> Any:
    """Add photon noise and read noise to mean numbers of electrons, ndarray of shape (H, W), float32."""
    normals = draw_normals(mean.shape, rng)
    deviation = mean + np.float32(read_noise_e * read_noise_e)
    np.sqrt(deviation, out=deviation)
    deviation *= normals
    deviation += mean
    few = np.flatnonzero(mean.ravel() < FEW_ELECTRONS)
    if few.size:
        counts = _draw_poisson(mean.ravel()[few], rng)
        deviation.ravel()[few] = counts + np.float32(read_noise_e) * normals.ravel()[few]
    return deviation


@lru_cache(maxsize=4)
def _fixed_pattern(shape: tuple[int, ...], camera_seed: int, nth: int) -> Float32:
    """Return the fixed standard normal number of each pixel of a camera."""
    return draw_normals(shape, np.random.default_rng([camera_seed, nth]))


def dn_per_electron(full_well_e: float, gain: float = 1.0, bits: int = 12, black_dn: int = 0) -> float:
    """Return the overall system gain K of a sensor, in digital numbers per electron (EMVA 1288, section 2.2).

    Examples
    --------
    >>> from kpbench.camera import dn_per_electron
    >>> dn_per_electron(full_well_e=8190, bits=12)
    0.5
    """
    return float((2**bits - 1 - black_dn) * gain / full_well_e)


def expose(
    light: Float32,
    rng: np.random.Generator,
    full_well_e: float = 10_000.0,
    gain: float = 1.0,
    read_noise_e: float = 2.0,
    prnu: float = 0.0,
    dsnu_e: float = 0.0,
    exposure: float = 1.0,
    row_noise_e: float = 0.0,
    bits: int = 12,
    black_dn: int = 0,
    camera_seed: int = 0,
) -> UInt16:
    """Expose a sensor to linear light and read it.

    The linear camera model of EMVA Standard 1288 (release 4.0, section 2): the number of electrons is
    Poisson-distributed, reading adds normal noise, the converter multiplies by a gain, rounds and clips. The light 1.0
    at the exposure 1 gives the largest digital number. A mean of 32 electrons or more has normal photon noise. For
    smaller means, the probabilities of the counts are rounded to 2⁻¹².

    Parameters
    ----------
    light : ndarray of shape (H, W) or (H, W, 3), float32
        Light of at least 0. A sensor with colour filters takes :func:`mosaic` of an RGB image.
    rng : numpy.random.Generator
        Gives photon noise, read noise and row noise.
    full_well_e : float
        Electrons of the largest digital number at the gain 1.
    gain : float
        Analogue gain. The light 1.0 gives ``full_well_e / gain`` electrons.
    read_noise_e : float
        Standard deviation of the read noise, electrons.
    prnu : float
        Photo response non-uniformity: relative standard deviation of the pixels' sensitivities.
    dsnu_e : float
        Dark signal non-uniformity: standard deviation of the pixels' offsets, electrons.
    exposure : float
        Factor of all light.
    row_noise_e : float
        Standard deviation of the offset that all pixels of a row share, drawn anew per image, electrons.
    bits : int
        Resolution of the converter, at most 16.
    black_dn : int
        Digital number of no light.
    camera_seed : int
        Identity of the camera. Images of one camera and one size share their fixed pattern.

    Returns
    -------
    ndarray of the same shape, uint16
        Raw digital numbers from 0 to ``2**bits - 1``.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera import expose
    >>> raw = expose(np.full((100, 100), 0.5, np.float32), np.random.default_rng(0), full_well_e=4095, bits=12)
    >>> round(raw.mean()), round(raw.std())
    (2048, 46)
    """
    mean = light * np.float32(exposure * full_well_e / gain)
    if prnu:
        sensitivity = 1 + np.float32(prnu) * _fixed_pattern(light.shape, camera_seed, 0)
        mean *= np.maximum(sensitivity, 0)
    electrons = _draw_electrons(mean, read_noise_e, rng)
    if gain < 1:
        np.minimum(electrons, np.float32(full_well_e), out=electrons)
    if dsnu_e:
        electrons += np.float32(dsnu_e) * _fixed_pattern(light.shape, camera_seed, 1)
    if row_noise_e:
        rows = draw_normals((len(light),), rng) * np.float32(row_noise_e)
        electrons += rows.reshape(-1, *[1] * (light.ndim - 1))
    electrons *= np.float32(dn_per_electron(full_well_e, gain, bits, black_dn))
    electrons += np.float32(black_dn)
    np.rint(electrons, out=electrons)
    return np.asarray(np.clip(electrons, 0, 2**bits - 1, out=electrons).astype(np.uint16))


def mosaic(light: Float32, transmissions: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Float32:
    """Return the light behind the colour filters of a sensor, one colour per pixel, in the Bayer pattern RGGB.

    Red filters lie on even rows and even columns, blue filters on odd rows and odd columns, green filters elsewhere
    (Bayer, US patent 3971065, 1976).

    Parameters
    ----------
    light : ndarray of shape (H, W, 3), float32
        RGB.
    transmissions : (float, float, float)
        Factor of the light of red, green and blue. White balance makes up for them.

    Returns
    -------
    ndarray of shape (H, W), float32

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera import mosaic
    >>> mosaic(np.float32([[[1, 2, 3], [1, 2, 3]], [[1, 2, 3], [1, 2, 3]]])).tolist()
    [[1.0, 2.0], [2.0, 3.0]]
    """
    red, green, blue = (np.float32(factor) for factor in transmissions)
    filtered = light[..., 1] * green
    filtered[::2, ::2] = light[::2, ::2, 0] * red
    filtered[1::2, 1::2] = light[1::2, 1::2, 2] * blue
    return filtered
