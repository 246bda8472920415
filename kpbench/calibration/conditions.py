"""Condition and rung of a photograph, from the names of its folders."""

from __future__ import annotations

import math
from pathlib import PurePosixPath

FREE = "free"
"""Condition of a photograph that belongs to no rung."""


def name_condition(name: str) -> tuple[str, float]:
    """Return condition and rung of a photograph: those of ``…/blur/7/photo.png``, else ``free`` and nan.

    Parameters
    ----------
    name : str
        Path of the photograph, with ``/`` between its parts.

    Examples
    --------
    >>> from kpbench.calibration.conditions import name_condition
    >>> name_condition("blur/7/a.jpg"), name_condition("monday/a.jpg")
    (('blur', 7.0), ('free', nan))
    """
    parts = PurePosixPath(name).parts
    if len(parts) >= 3:
        try:
            rung = float(parts[-2])
        except ValueError:
            rung = math.nan
        if math.isfinite(rung):
            return parts[-3], rung
    return FREE, math.nan
