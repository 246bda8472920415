from .chain import photograph as photograph
from .chain import scene_light as scene_light
from .optics import blur_linear as blur_linear
from .optics import chromatic_scales as chromatic_scales
from .optics import psf_kernel as psf_kernel
from .optics import vignetting as vignetting
from .preset import CameraPreset as CameraPreset
from .preset import load_camera_preset as load_camera_preset
from .preset import shipped_cameras as shipped_cameras
from .processing import demosaic as demosaic
from .processing import develop as develop
from .processing import guided_denoise as guided_denoise
from .processing import median_denoise as median_denoise
from .processing import raw_to_light as raw_to_light
from .processing import unsharp_mask as unsharp_mask
from .processing import white_balance as white_balance
from .sensor import dn_per_electron as dn_per_electron
from .sensor import expose as expose
from .sensor import mosaic as mosaic
from .tone import ToneCurve as ToneCurve
from .tone import random_tone_curve as random_tone_curve

__all__: list[str]
