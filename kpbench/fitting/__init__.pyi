from .design_fit import Fit as Fit
from .design_fit import fit as fit
from .pyramid import build_pyramid as build_pyramid

__all__: list[str]
