"""A page about a calibration: one HTML file that loads no other file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from kpbench.calibration.camera_solution import Calibration
from kpbench.calibration.observe import REJECTIONS
from kpbench.calibration.projection import camera_values
from kpbench.calibration.shape import SHAPE_NAMES
from kpbench.text import escape_markup
from kpbench.writing import write_file

MARK = "kpbench.calibration-page/1"
STYLE = """body{font:15px system-ui,sans-serif;max-width:70rem;margin:2rem auto;padding:0 1rem}
table{border-collapse:collapse}td,th{padding:.15rem .7rem;text-align:right;border-bottom:1px solid #8884}
th:first-child,td:first-child{text-align:left}
svg{max-width:40rem;width:100%;height:auto;border:1px solid #8888}h2{margin-top:2rem}.bad{color:#c2410c}"""
ARROW_TIMES = 200
"""Residuals are drawn this many times larger."""
MOST_ARROWS = 4000
"""Largest number of residuals that are drawn."""
UNITS = {"ratio": "", "skew": " rad", "bow_xx": " /mm", "bow_xy": " /mm", "bow_yy": " /mm"}


def write_calibration_page(path: str | Path, calibration: Calibration) -> None:
    """Write a page: parameters with their uncertainty, halves, coverage, residuals, photographs.

    Raises
    ------
    DataError
        If the file cannot be written, or exists and is no such page.

    Examples
    --------
    See :func:`kpbench.calibrate`.
    """
    write_file(Path(path), to_page(calibration).encode())


def to_page(calibration: Calibration) -> str:
    """Return the page as HTML."""
    camera, used, observed = calibration.camera, calibration.used, calibration.observed
    rms = calibration.bundle.rms_px()
    parts = [
        '<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n'
        f'<meta name="generator" content="{MARK}">\n<title>kpbench calibration</title>\n<style>{STYLE}</style>',
        f"<h1>Calibration with board {escape_markup(calibration.board.name)}</h1>",
        f"<p>{len(used)} of {len(observed)} photographs of {camera.width_px} x {camera.height_px} px were used. "
        f"The root mean square residual is {np.nanmedian(rms):.3f} px per coordinate (median of the photographs).</p>",
        "<h2>Camera and print</h2>",
        _table(["", "value", "sigma", "difference of halves", "its sigma"], _parameters(calibration)),
        _halves(calibration),
        "<h2>Coverage and residuals</h2>",
        f"<p>Dots are the points of the board, lines their residuals, drawn {ARROW_TIMES} times larger.</p>",
        _draw_residuals(calibration),
        f"<p>{(calibration.coverage() > 0).mean():.0%} of the image, in 8 x 6 cells, has points.</p>",
        "<h2>Photographs</h2>",
        _table(["photograph", "points", "left out", "rms px", "largest px", ""], _photographs(calibration)),
    ]
    if outliers := calibration.outliers():
        rows = [[photo, point, f"{size:.2f}"] for photo, point, size in outliers[:500]]
        parts += ["<h2>Points left out</h2>", _table(["photograph", "point", "residual px"], rows)]
    return "\n".join([*parts, "</html>", ""])


def _parameters(calibration: Calibration) -> list[list[str]]:
    bundle, halves = calibration.bundle, calibration.halves
    names, values = list(calibration.sigma), camera_values(bundle.camera)
    rows = [
        [name, f"{value:.6g}", f"{calibration.sigma[name]:.2g}", "", ""]
        for name, value in zip(names, values, strict=True)
    ]
    if halves is not None:
        for row, difference, sigma in zip(rows, halves.difference, halves.sigma, strict=False):
            row[3:] = [f"{difference:+.3g}", f"{sigma:.2g}"]
    deviations = np.sqrt(np.diag(bundle.covariance))[len(names) :]
    for name, value, sigma in zip(SHAPE_NAMES, bundle.shape.values, deviations, strict=True):
        rows.append([f"print: {name}{UNITS[name]}", f"{value:.3g}", f"{sigma:.2g}", "", ""])
    return rows


def _halves(calibration: Calibration) -> str:
    halves = calibration.halves
    if halves is None:
        return "<p>There are too few photographs to solve two halves apart.</p>"
    verdict = "agree" if halves.p >= 0.001 else "do <b class=bad>not</b> agree"
    return (
        f"<p>The first and the second half of the photographs, solved apart, {verdict} within the stated uncertainty "
        f"(chi-square {halves.chi2:.1f}, p = {halves.p:.2g}).</p>"
    )


def _photographs(calibration: Calibration) -> list[list[str]]:
    bundle, at = calibration.bundle, 0
    rows = list[list[str]]()
    for o in calibration.observed:
        if o.reason:
            rows.append([o.photo.name, str(len(o.points)), "", "", "", f"rejected: {o.reason}, {REJECTIONS[o.reason]}"])
            continue
        inlier, size = bundle.inlier[at], np.hypot(*bundle.residual[at].T)
        kept = size[inlier]
        rms = float(np.sqrt((kept**2).mean() / 2))
        rows.append(
            [o.photo.name, str(len(o.points)), str(int((~inlier).sum())), f"{rms:.3f}", f"{kept.max():.2f}", ""]
        )
        at += 1
    return rows


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    def row(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{escape_markup(cell)}</{tag}>" for cell in cells) + "</tr>"

    return "<table>" + row(head, "th") + "".join(row(cells, "td") for cells in rows) + "</table>"


def _draw_residuals(calibration: Calibration) -> str:
    bundle, camera = calibration.bundle, calibration.camera
    parts = list(zip(bundle.points, bundle.inlier, bundle.residual, strict=True))
    xy = np.concatenate([points.xy[inlier] for points, inlier, _ in parts])
    arrow = np.concatenate([residual[inlier] for _, inlier, residual in parts]) * ARROW_TIMES
    step = max(1, len(xy) // MOST_ARROWS)
    width = camera.width_px / 600
    lines = "".join(
        f"M{x:.0f} {y:.0f}h.1M{x:.0f} {y:.0f}l{dx:.0f} {dy:.0f}"
        for (x, y), (dx, dy) in zip(xy[::step].tolist(), arrow[::step].tolist(), strict=True)
    )
    return (
        f'<svg role="img" aria-label="Residuals in the image" viewBox="0 0 {camera.width_px} {camera.height_px}">'
        f'<path d="{lines}" fill="none" stroke="#0067a8" stroke-linecap="round" stroke-width="{width:.2f}"/></svg>'
    )
