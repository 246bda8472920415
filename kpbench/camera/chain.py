"""The camera: from linear light in front of the lens to the levels of a file."""

from __future__ import annotations

from typing import Any

import numpy as np

from kpbench.camera.optics import blur_linear, psf_kernel, vignetting
from kpbench.camera.processing import demosaic, develop, guided_denoise, unsharp_mask
from kpbench.camera.sensor import expose, mosaic
from kpbench.camera.tone import ToneCurve
from kpbench.types import Float32, UInt8

SCENE_TONE = ToneCurve("srgb")
"""The tone curve that inks and photographs are taken to be encoded with. Cameras' own curves are mostly near it."""
BLACK_LEVEL_BITS = 6
"""The digital number of no light is a 2**6-th of the largest one, so that read noise is not clipped."""
DENOISE_PX = 5
"""Side of the window of denoising, px."""


def scene_light(levels: UInt8) -> Float32:
    """Return the linear light of a scene from its levels, a photograph's or those of inks.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera import scene_light
    >>> scene_light(np.array([[0, 128, 255]], np.uint8)).round(3)
    array([[0.   , 0.216, 1.   ]], dtype=float32)
    """
    return SCENE_TONE.decode(levels)


def photograph(light: Float32, rng: np.random.Generator, record: dict[str, Any]) -> UInt8:
    """Take a picture of linear light: lens, sensor, processing. JPEG is an effect of its own.

    The gain of the sensor makes up for an exposure under 1, so that an image keeps its brightness. Over 1, light clips.

    Parameters
    ----------
    light : ndarray of shape (H, W) or (H, W, 3), float32
        Linear light; 1.0 is what the tone curve maps to 255.
    rng : numpy.random.Generator
        Gives the noise of the sensor.
    record : dict
        From :meth:`kpbench.camera.CameraPreset.draw`.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera import load_camera_preset, photograph, scene_light
    >>> record = load_camera_preset("webcam").draw(np.random.default_rng(0))
    >>> image = photograph(scene_light(np.full((48, 64), 128, np.uint8)), np.random.default_rng(1), record)
    >>> image.shape, image.dtype.name
    ((48, 64), 'uint8')
    """
    kernel = psf_kernel(*(record[name] for name in ("wavelength_um", "f_number", "pixel_um", "defocus_px")))
    light = blur_linear(light, kernel)
    if record["corner_loss"]:
        light = vignetting(light, polynomial=(-record["corner_loss"],))
    has_filters = light.ndim == 3 and record["bayer"]
    bits, exposure = record["bits"], record["exposure"]
    black_dn = 2**bits >> BLACK_LEVEL_BITS
    raw = expose(
        mosaic(light) if has_filters else light,
        rng,
        full_well_e=record["full_well_e"],
        gain=max(1.0, 1 / exposure),
        read_noise_e=record["read_noise_e"],
        prnu=record["prnu"],
        dsnu_e=record["dsnu_e"],
        exposure=max(1.0, exposure),
        row_noise_e=record["row_noise_e"],
        bits=bits,
        black_dn=black_dn,
        camera_seed=record["camera_seed"],
    )
    red, blue = record["balance"]
    curve = ToneCurve(record["tone"]["name"], tuple(record["tone"]["parameters"]))
    image = develop(demosaic(raw) if has_filters else raw, curve, bits, black_dn, (red, 1.0, blue))
    if record["denoise_sigma"]:
        image = guided_denoise(image, DENOISE_PX, record["denoise_sigma"])
    if record["sharpen_amount"]:
        image = unsharp_mask(image, record["sharpen_amount"], record["sharpen_sigma_px"])
    return image
