"""The analysis of designs in one call: measure given designs or search for the best, and write the results."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from kpbench.analysis.figure import FIGURE_SUFFIXES, draw_designs
from kpbench.analysis.measures import MEASURE_STEPS, Analysis, measure_designs
from kpbench.analysis.natural_images import background_windows
from kpbench.analysis.search import SEARCH_STEPS, SearchResult, search_designs
from kpbench.errors import DesignError
from kpbench.patches.design import Patch, shipped_patches
from kpbench.printing.formats import PAGE_WRITERS
from kpbench.writing import require_writable, write_file

FIGURE_DPI = 200.0
"""Resolution of a figure that is written as PNG."""


@dataclass(frozen=True)
class AnalysisRun:
    """Result of :func:`analyse_patches`.

    Attributes
    ----------
    patches : tuple of Patch
        The designs that were measured: the given designs, or the best set of the search.
    analysis : Analysis
        Measures of ``patches``.
    search : SearchResult or None
        None if no search was run.

    Examples
    --------
    >>> import kpbench
    >>> run = kpbench.analysis.analyse_patches()  # doctest: +SKIP
    >>> [patch.name for patch in run.patches]  # doctest: +SKIP
    ['checker', 'trefoil', 'wheel', 'mushroom']
    """

    patches: tuple[Patch, ...]
    analysis: Analysis
    search: SearchResult | None


def analyse_patches(
    patches: Sequence[Patch] | None = None,
    *,
    search_family: bool = False,
    most_bias_px: float | None = None,
    backgrounds: str | Path | None = None,
    json_file: str | Path | None = None,
    figure_file: str | Path | None = None,
    progress: Callable[[int], None] = lambda steps: None,
) -> AnalysisRun:
    """Measure designs and write the results to files. The designs are given, or a search chooses them.

    Parameters
    ----------
    patches : sequence of Patch, optional
        The four shipped designs if left out.
    search_family : bool
        Whether to repeat the search that chose the shipped designs, and to measure the best set. ``patches`` must then
        be left out.
    most_bias_px : float, optional
        See :func:`kpbench.analysis.search_designs`; only with ``search_family``.
    backgrounds : str or Path, optional
        Folder of photographs in which the places that look like a design are counted. If left out, places in procedural
        backgrounds are counted.
    json_file : str or Path, optional
        File for all measures.
    figure_file : str or Path, optional
        .svg, .png or .pdf file for one page with the designs and their measures.
    progress : callable
        Called with the number of steps finished since the last call. The numbers add up to :func:`count_steps`.

    Returns
    -------
    AnalysisRun

    Raises
    ------
    DesignError
        If the figure's name does not end in .svg, .png or .pdf, or ``patches`` are given and ``search_family`` is True.
    DataError
        If the folder holds no photograph, or a file cannot be written.

    Examples
    --------
    >>> import kpbench
    >>> measured = kpbench.analysis.analyse_patches()  # doctest: +SKIP
    >>> [round(design.basin, 3) for design in measured.analysis.designs]  # doctest: +SKIP
    [0.175, 0.152, 0.114, 0.114]
    """
    if search_family and patches is not None:
        raise DesignError("`search_family=True` goes through a whole family of designs and takes no `patches`")
    if most_bias_px is not None and not search_family:
        raise DesignError("`most_bias_px` limits a search, expected `search_family=True` beside it")
    suffix = Path(figure_file or "a.svg").suffix.lower()
    if suffix not in FIGURE_SUFFIXES:
        raise DesignError(f"{figure_file}: expected a file that ends in {', '.join(FIGURE_SUFFIXES)}")
    for file, kind in ((json_file, "analysis"), (figure_file, "figure")):
        if file is not None:
            require_writable(Path(file), kind)
    windows = background_windows(backgrounds)
    search = partial(search_designs, windows, shipped_patches(), most_bias_px=most_bias_px, progress=progress)
    found = search() if search_family else None
    measured = found.sets[0] if found else tuple(patches or shipped_patches())
    analysis = measure_designs(measured, windows, progress)
    if json_file is not None:
        content = analysis.to_dict() | ({"search": found.to_dict()} if found else {})
        write_file(Path(json_file), (json.dumps(content, indent=1) + "\n").encode())
    if figure_file is not None:
        write_file(Path(figure_file), PAGE_WRITERS[suffix]([draw_designs(analysis, measured)], FIGURE_DPI)[0])
    return AnalysisRun(measured, analysis, found)


def count_steps(search_family: bool = False) -> int:
    """Return the number of steps that :func:`analyse_patches` reports."""
    return MEASURE_STEPS + (SEARCH_STEPS if search_family else 0)
