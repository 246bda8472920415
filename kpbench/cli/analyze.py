"""``kpbench analyze-patches``."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from kpbench.cli.messages import echo
from kpbench.cli.options import BACKGROUNDS, FileOfSuffix

if TYPE_CHECKING:
    from kpbench.analysis.measures import Analysis
    from kpbench.analysis.search import SearchResult
    from kpbench.report.tables import Table


def figure_suffixes() -> Iterable[str]:
    """Return the suffixes of figure files."""
    from kpbench.analysis.figure import FIGURE_SUFFIXES

    return FIGURE_SUFFIXES


@click.command("analyze-patches")
@click.argument("files", nargs=-1, type=click.Path(path_type=Path))
@click.option("--search", "search_family", is_flag=True, help="Repeat the search that chose the shipped designs.")
@click.option(
    "--most-bias-px",
    type=click.FloatRange(min=0.0),
    metavar="PX",
    help="With --search: keep designs whose centre a camera moves by at most PX, at 20 px radius.",
)
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write all measures as JSON.")
@click.option(
    "--figure",
    "figure_file",
    type=FileOfSuffix(figure_suffixes),
    help="Draw the designs and their measures: .svg, .png, .pdf.",
)
@BACKGROUNDS
def analyze_patches(
    files: tuple[Path, ...],
    search_family: bool,
    most_bias_px: float | None,
    json_file: Path | None,
    figure_file: Path | None,
    backgrounds: Path | None,
) -> None:
    """Measure how well designs can be located, and told apart from each other and from natural images.

    FILES are designs (TOML). Default: the shipped four.

    \b
    Examples:
      kpbench analyze-patches
      kpbench analyze-patches my-patch.toml my-other-patch.toml --figure mine.svg
      kpbench analyze-patches --search --json search.json
      kpbench analyze-patches --search --most-bias-px 0.02
    """
    from kpbench.analysis.analyse import analyse_patches, count_steps
    from kpbench.cli.progress import progress_bar
    from kpbench.patches.design import load_patches
    from kpbench.report.tables import to_plain

    if search_family and files:
        raise click.UsageError("--search goes through a whole family of designs and takes no FILES")
    if most_bias_px is not None and not search_family:
        raise click.UsageError("--most-bias-px only with --search")
    patches = load_patches(files) if files else None
    with progress_bar(count_steps(search_family), "analysis", unit="step") as progress:
        found = analyse_patches(
            patches,
            search_family=search_family,
            most_bias_px=most_bias_px,
            backgrounds=backgrounds,
            json_file=json_file,
            figure_file=figure_file,
            progress=progress,
        )
    if found.search:
        echo(_search_summary(found.search) + "\n", lines=True)
    echo("\n\n".join(f"{table.title}:\n{to_plain(table)}" for table in _tables(found.analysis)), lines=True)


def _tables(analysis: Analysis) -> list[Table]:
    """Return tables with a row per design: bounds, other measures, and for several designs their distances."""
    from kpbench.analysis.bias import BIAS_EFFECTS
    from kpbench.report.tables import Table

    names = [f"{design.patch_id} {design.name}" for design in analysis.designs]
    sizes_px = analysis.designs[0].sizes_px
    sizes = [f"{radius_px:g} px" for radius_px in sizes_px]
    bounds, measures = [], []
    for n, (label, design) in enumerate(zip(names, analysis.designs, strict=True)):
        worst_px = [design.bound_at(radius_px, tilt).worst_px for tilt in (0.0, 60.0) for radius_px in sizes_px]
        bounds.append((label, *(f"{value:.4f}" for value in (*worst_px, design.bound_without_rim_px))))
        nearest, distance = analysis.nearest(n)
        measures.append(
            (
                label,
                "yes" if design.centre_is_crossing else "no",
                f"{design.tilt_bias_px:.2f}",
                f"{design.basin:.3f}",
                design.symmetry_order,
                f"{design.mirrored_distance:.3f}",
                f"{design.pixels_needed:.1f}",
                f"{100 * design.natural_response[0]:.3f} %",
                f"{100 * design.natural_response_blurred[0]:.2f} %",
                nearest or "-",
                f"{distance:.3f}",
            )
        )
    title = "Bound of the centre's error in px, worst direction (noise 10, contrast 180 grey levels); frontal, 60° tilt"
    tables = [Table(title, ("", *sizes, *sizes, "5 px, no rim"), tuple(bounds))]
    title = "Centre, orientation, smallest size, and look-alikes (share of places in images, correlation > 0.8)"
    columns = ("crossing", "tilt bias px", "basin", "turns alike", "mirror", "needs px", "in images", "blurred")
    tables.append(Table(title, ("", *columns, "nearest", "distance"), tuple(measures)))
    title = (
        "Bias of the centre in px at 20 px radius, blur 1 px, noise-free: a fit that takes the camera for linear; in "
    )
    title += "brackets a fit with an unknown tone curve"
    rows = tuple(
        (label, *(f"{d.camera_bias_px[name]:.3f} ({d.camera_bias_toned_px[name]:.3f})" for name in BIAS_EFFECTS))
        for label, d in zip(names, analysis.designs, strict=True)
    )
    tables.append(Table(title, ("", *BIAS_EFFECTS), rows))
    if len(names) > 1:
        title = "Distance between designs, over rotation, tilt, mirror, gain and offset, blurred (ink contrasts)"
        distances = zip(names, analysis.distance.tolist(), strict=True)
        rows = tuple((label, *(f"{value:.3f}" for value in row)) for label, row in distances)
        tables.append(Table(title, ("", *names), rows))
    return tables


def _search_summary(found: SearchResult) -> str:
    """Return the number of designs after each step of the search, the medians, and the best sets."""
    lines = [f"{count:6d}  {name}" for name, count in found.counts.items()]
    lines.append(
        f"median of all crossings: bound {found.median_bound_px:.4f} px at 5 px, "
        f"basin {found.median_basin:.3f}, needs {found.median_pixels_needed:.1f} px"
    )
    for title, patches, distances in zip(("best set", "runner-up"), found.sets, found.distances, strict=False):
        listed = " ".join(f"{value:.3f}" for value in distances)
        lines.append(f"{title}: {', '.join(patch.name for patch in patches)}; distances {listed}")
    return "\n".join(lines)
