"""Prints of patches and boards, true to scale: pages in mm, one writer per file format, sheets and their sidecars.

Examples
--------
>>> from kpbench.printing import PageFormat, patch_sheet
>>> from kpbench.patches import shipped_patches
>>> sheet = patch_sheet(shipped_patches(), diameter_mm=30.0, page_format=PageFormat(210.0, 297.0))
>>> keypoint = sheet.sidecar["keypoints"][0]
>>> keypoint["page_x_mm"], keypoint["page_y_mm"]
(47.0, 30.0)
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
