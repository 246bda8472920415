"""Model a camera, from linear light to the 8-bit file.

Linear light is a float32 array of shape (H, W) or (H, W, 3). The light 1.0 is the light that the tone curve maps to
level 255. Light is never negative. Light over 1 clips at the sensor.

Examples
--------
>>> import numpy as np
>>> from kpbench.camera import ToneCurve, blur_linear, develop, expose, psf_kernel
>>> light = np.full((40, 60), 0.2, np.float32)
>>> light = blur_linear(light, psf_kernel(wavelength_um=0.55, f_number=2.8, pixel_um=3.0, defocus_px=1.0))
>>> raw = expose(light, np.random.default_rng(0), full_well_e=10_000, read_noise_e=3, bits=12)
>>> image = develop(raw, ToneCurve("srgb"), bits=12)
>>> image.dtype, round(image.mean())
(dtype('uint8'), 124)
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
