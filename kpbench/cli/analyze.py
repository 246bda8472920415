"""``kpbench analyze-patches``."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from kpbench.cli.options import BACKGROUNDS

if TYPE_CHECKING:
    from kpbench.analysis.measures import Analysis
    from kpbench.analysis.search import SearchResult
    from kpbench.types import UInt8


@click.command("analyze-patches")
@click.argument("files", nargs=-1, type=click.Path(path_type=Path))
@click.option("--search", "searching", is_flag=True, help="Repeat the search that chose the shipped designs.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write all measures as JSON.")
@click.option(
    "--figure", type=click.Path(path_type=Path), help="Draw the designs and their measures: .svg, .png, .pdf."
)
@BACKGROUNDS
def analyze_patches(
    files: tuple[Path, ...], searching: bool, json_file: Path | None, figure: Path | None, backgrounds: Path | None
) -> None:
    """Measure how well designs can be located, told apart, and told from natural images.

    FILES are designs (TOML). Default: the shipped four.

    \b
    Examples:
      kpbench analyze-patches
      kpbench analyze-patches my-patch.toml my-other-patch.toml --figure mine.svg
      kpbench analyze-patches --search --json search.json
    """
    from tqdm import tqdm

    from kpbench.analysis import measures as analysis
    from kpbench.analysis import search
    from kpbench.analysis.figure import design_figure
    from kpbench.files import write_atomic
    from kpbench.patches.design import load_patches, shipped_patches
    from kpbench.printing.formats import WRITERS

    if searching and files:
        raise click.UsageError("--search goes through a whole family of designs and takes no FILES")
    if figure is not None and figure.suffix.lower() not in (".svg", ".png", ".pdf"):
        raise click.UsageError(f"--figure {figure}: expected a file that ends in .svg, .png or .pdf")
    patches = load_patches(files) if files else shipped_patches()
    windows = _windows(backgrounds)
    found = None
    steps = analysis.STEPS + (search.STEPS if searching else 0)
    with tqdm(total=steps, desc="analysis", unit="step", disable=not sys.stderr.isatty(), dynamic_ncols=True) as bar:

        def step() -> None:
            bar.update()

        if searching:
            found = search.search(windows, shipped_patches(), progress=step)
            patches = found.sets[0]
        measured = analysis.analyse(patches, windows, step)
    if found:
        click.echo(_search_table(found) + "\n")
    click.echo(_table(measured))
    if json_file is not None:
        content = measured.to_dict() | ({"search": found.to_dict()} if found else {})
        write_atomic(json_file, (json.dumps(content, indent=1) + "\n").encode())
    if figure is not None:
        write_atomic(figure, WRITERS[figure.suffix.lower()]([design_figure(measured, patches)], 200.0)[0])


def _windows(backgrounds: Path | None) -> UInt8:
    import numpy as np

    from kpbench.analysis.measures import sample_windows
    from kpbench.render.background import PhotoFolder, procedural_background

    rng = np.random.default_rng(0)

    def photographs(folder: PhotoFolder) -> Iterator[UInt8]:
        order = rng.permutation(len(folder.files))
        while True:
            for n in order:
                image = folder.decode(folder.files[n], 1)
                if image is not None:
                    yield image

    if backgrounds is None:
        return sample_windows((procedural_background(rng, 640, 480) for _ in iter(int, 1)), rng)
    return sample_windows(photographs(PhotoFolder.open(backgrounds)), rng)


def _table(analysis: Analysis) -> str:
    from kpbench.analysis.measures import SIZES_PX

    lines = ["Bound of the centre in px, worst direction (noise 10, contrast 180 grey levels); frontal, then 60° tilt:"]
    head = [f"{r:g} px" for r in SIZES_PX] + [f"{r:g} px" for r in SIZES_PX] + ["5 px, no rim"]
    rows = [
        [f"{d.bound_at(r, tilt).worst_px:.4f}" for tilt in (0.0, 60.0) for r in SIZES_PX]
        + [f"{d.bound_without_rim_px:.4f}"]
        for d in analysis.designs
    ]
    names = [f"{d.patch_id} {d.name}" for d in analysis.designs]
    lines += _columns(names, head, rows)
    lines += ["", "Centre, orientation, smallest size, and look-alikes (share of places in images, correlation > 0.8):"]
    head = [
        "crossing",
        "tilt bias px",
        "basin",
        "turns alike",
        "mirror",
        "needs px",
        "in images",
        "blurred",
        "nearest",
        "distance",
    ]
    rows = []
    for n, d in enumerate(analysis.designs):
        name, distance = analysis.nearest(n)
        crossing = "yes" if d.centre_is_crossing else "no"
        shares = (f"{100 * d.natural_response[0]:.3f} %", f"{100 * d.natural_response_blurred[0]:.2f} %")
        measures = (f"{d.basin:.3f}", str(d.symmetry_order), f"{d.mirrored_distance:.3f}", f"{d.pixels_needed:.1f}")
        rows.append([crossing, f"{d.tilt_bias_px:.2f}", *measures, *shares, name or "-", f"{distance:.3f}"])
    lines += _columns(names, head, rows)
    if len(names) > 1:
        lines += [
            "",
            "Distance between designs, over rotation, tilt, mirror, gain and offset, blurred (ink contrasts):",
        ]
        lines += _columns(names, names, [[f"{v:.3f}" for v in row] for row in analysis.distance.tolist()])
    return "\n".join(lines)


def _search_table(found: SearchResult) -> str:
    lines = [f"{count:6d}  {name}" for name, count in found.counts.items()]
    lines.append(
        f"median of all crossings: bound {found.median_bound_px:.4f} px at 5 px, "
        f"basin {found.median_basin:.3f}, needs {found.median_pixels_needed:.1f} px"
    )
    for title, patches, distances in zip(("best set", "runner-up"), found.sets, found.distances, strict=False):
        listed = " ".join(f"{value:.3f}" for value in distances)
        lines.append(f"{title}: {', '.join(p.name for p in patches)}; distances {listed}")
    return "\n".join(lines)


def _columns(names: list[str], head: list[str], rows: list[list[str]]) -> list[str]:
    table = [["", *head], *([name, *row] for name, row in zip(names, rows, strict=True))]
    widths = [max(len(row[k]) for row in table) for k in range(len(table[0]))]
    return [
        "  ".join(
            cell.ljust(w) if k == 0 else cell.rjust(w) for k, (cell, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in table
    ]
