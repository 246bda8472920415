"""The design analysis in one call: sample windows of backgrounds, measure or search, write JSON and figure."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kpbench.analysis import search
from kpbench.analysis.figure import FIGURE_SUFFIXES, design_figure
from kpbench.analysis.measures import ANALYSIS_STEPS, Analysis, analyse
from kpbench.analysis.natural_images import sample_windows
from kpbench.analysis.search import SEARCH_STEPS
from kpbench.errors import DesignError
from kpbench.files import write_atomic
from kpbench.patches.design import Patch, shipped_patches
from kpbench.printing.formats import PAGE_WRITERS
from kpbench.render.background import PhotoFolder, procedural_background
from kpbench.types import UInt8

FIGURE_DPI = 200.0
"""Resolution of a figure that is written as PNG."""
BACKGROUND_PX = (640, 480)
"""Width and height of the procedural backgrounds that windows are sampled from, px."""


@dataclass(frozen=True)
class AnalysedPatches:
    """The result of :func:`analyse_patches`.

    Attributes
    ----------
    patches : tuple of Patch
        The designs that were measured: those given, or the best set of the search.
    analysis : Analysis
    search : SearchResult or None
        None if no search was asked for.
    """

    patches: tuple[Patch, ...]
    analysis: Analysis
    search: search.SearchResult | None


def analyse_patches(
    patches: Sequence[Patch] | None = None,
    *,
    search_family: bool = False,
    backgrounds: str | Path | None = None,
    json_file: str | Path | None = None,
    figure_file: str | Path | None = None,
    progress: Callable[[], None] = lambda: None,
) -> AnalysedPatches:
    """Measure designs, or search the whole family for the best four and measure those; write the results to files.

    Parameters
    ----------
    patches : sequence of Patch, optional
        Default: the shipped four.
    search_family : bool
        Whether to repeat the search that chose the shipped designs; ``patches`` must then be None.
    backgrounds : str or Path, optional
        Folder of photographs in which look-alikes of the designs are counted. Default: procedural backgrounds.
    json_file : str or Path, optional
        File for all measures.
    figure_file : str or Path, optional
        File for one page with the designs and their measures: .svg, .png or .pdf.
    progress : callable
        Called :func:`count_steps` times in all.

    Returns
    -------
    AnalysedPatches

    Raises
    ------
    DesignError
        If the suffix of the figure is unknown, or ``patches`` and ``search_family`` are both given.
    DataError
        If there are no photographs in the folder, or a file cannot be written.

    Examples
    --------
    >>> import kpbench
    >>> measured = kpbench.analysis.analyse_patches()  # doctest: +SKIP
    >>> [round(design.basin, 3) for design in measured.analysis.designs]  # doctest: +SKIP
    [0.175, 0.152, 0.114, 0.114]
    """
    if search_family and patches is not None:
        raise DesignError("`search_family=True` goes through a whole family of designs and takes no `patches`")
    suffix = Path(figure_file or "a.svg").suffix.lower()
    if suffix not in FIGURE_SUFFIXES:
        raise DesignError(f"{figure_file}: expected a file that ends in {', '.join(FIGURE_SUFFIXES)}")
    windows = background_windows(backgrounds)
    found = search.search(windows, shipped_patches(), progress=progress) if search_family else None
    measured = found.sets[0] if found else tuple(patches or shipped_patches())
    analysis = analyse(measured, windows, progress)
    if json_file is not None:
        content = analysis.to_dict() | ({"search": found.to_dict()} if found else {})
        write_atomic(Path(json_file), (json.dumps(content, indent=1) + "\n").encode())
    if figure_file is not None:
        write_atomic(Path(figure_file), PAGE_WRITERS[suffix]([design_figure(analysis, measured)], FIGURE_DPI)[0])
    return AnalysedPatches(measured, analysis, found)


def count_steps(search_family: bool = False) -> int:
    """Return how often :func:`analyse_patches` reports progress."""
    return ANALYSIS_STEPS + (SEARCH_STEPS if search_family else 0)


def background_windows(backgrounds: str | Path | None = None) -> UInt8:
    """Sample small windows at random places of photographs, or of procedural backgrounds; the same ones in each call.

    Returns
    -------
    ndarray of shape (N, side, side), uint8

    Raises
    ------
    DataError
        If the folder holds no photograph that can be decoded.

    Examples
    --------
    >>> import cv2, numpy as np
    >>> import kpbench
    >>> cv2.imwrite("wall.png", np.random.default_rng(0).integers(0, 255, (200, 300), np.uint8))
    True
    >>> kpbench.analysis.background_windows(".").shape
    (20000, 21, 21)
    """
    rng = np.random.default_rng(0)
    images = _procedural(rng) if backgrounds is None else _photographs(PhotoFolder.open(backgrounds), rng)
    return sample_windows(images, rng)


def _procedural(rng: np.random.Generator) -> Iterator[UInt8]:
    while True:
        yield procedural_background(rng, *BACKGROUND_PX)


def _photographs(folder: PhotoFolder, rng: np.random.Generator) -> Iterator[UInt8]:
    """Photographs of a folder in one random order, again and again."""
    order = rng.permutation(len(folder.files))
    while True:
        for n in order:
            image = folder.decode(folder.files[n], 1)
            if image is not None:
                yield image
