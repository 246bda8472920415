"""``kpbench render-patches``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kpbench.cli.messages import echo, print_warning
from kpbench.cli.options import Finite, Two

if TYPE_CHECKING:
    from kpbench.patches.board import Board


@click.command("render-patches")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("patches-print"),
    show_default=True,
    help="Folder to write into.",
)
@click.option(
    "--pdf", is_flag=True, help="Write a vector PDF that asks the viewer not to scale. This is the default format."
)
@click.option("--svg", is_flag=True, help="Write SVG in mm with true arcs.")
@click.option("--png", is_flag=True, help="Write 8-bit grey PNG. The file contains its resolution.")
@click.option("--dxf", is_flag=True, help="Write DXF in mm with true arcs, for laser cutters and plotters.")
@click.option(
    "--diameter-mm",
    type=Finite(0.1, 5000),
    metavar="MM",
    help="Diameter of a disc, without rim and quiet zone. Default: 30, or 24 for the truth board, 16 for a field. The "
    "side of a hexagon board is MM / 0.16.",
)
@click.option("--page", default="a4", show_default=True, help="Page: a4, a3, a2, letter, legal or WIDTHxHEIGHTmm.")
@click.option("--landscape", is_flag=True, help="Use the page in landscape format.")
@click.option("--dpi", type=click.IntRange(36, 4800), default=600, show_default=True, help="Resolution of the PNG.")
@click.option(
    "--target",
    "targets",
    type=click.Choice(["opencv", "kalibr", "mrcal"]),
    multiple=True,
    help="Also write the board for this program, into the subfolder targets; repeatable. Needs --board.",
)
@click.option(
    "--board", metavar="hexagon|grid|truth|field|FILE.toml", help="Print a board instead of patches to cut out."
)
@click.option("--rows", type=click.IntRange(3, 100), default=10, show_default=True, help="Rows of a field.")
@click.option("--columns", type=click.IntRange(3, 100), default=7, show_default=True, help="Columns of a field.")
@click.option(
    "--fields",
    type=click.IntRange(1, 1000),
    default=1,
    show_default=True,
    help="Number of fields, for several boards that are told from each other.",
)
@click.option("--reference", is_flag=True, help="Put a ring of reference marks around the board.")
@click.option("--tile", is_flag=True, help="Spread a board that is larger than the page over several pages.")
@click.option(
    "--design",
    "designs",
    type=click.Path(path_type=Path),
    multiple=True,
    help="Design of your own (TOML); repeatable. Default: the shipped four.",
)
@click.option("--patch", "chosen", multiple=True, metavar="NAME|ID", help="Print only this design; repeatable.")
@click.option(
    "--copies",
    type=click.IntRange(1, 10_000),
    default=1,
    show_default=True,
    help="Number of copies of each patch to cut out.",
)
@click.option("--mirror", is_flag=True, help="Swap left and right, for transfer film.")
@click.option(
    "--invert",
    is_flag=True,
    help="Swap black and white within each patch, for engraving and film that invert the print.",
)
@click.option("--no-labels", is_flag=True, help="Print no text. Rulers and cut marks stay.")
@click.option(
    "--measured",
    type=Two(float, "X_MM,Y_MM", ",", "99.8,100.1"),
    help="Lengths of the x ruler and the y ruler, measured on the paper. Correct the sidecars in --out; print nothing.",
)
@click.pass_context
def render_patches(
    ctx: click.Context,
    /,
    out: Path,
    pdf: bool,
    svg: bool,
    png: bool,
    dxf: bool,
    diameter_mm: float | None,
    page: str,
    landscape: bool,
    dpi: int,
    board: str | None,
    targets: tuple[str, ...],
    reference: bool,
    tile: bool,
    designs: tuple[Path, ...],
    chosen: tuple[str, ...],
    copies: int,
    mirror: bool,
    invert: bool,
    no_labels: bool,
    measured: tuple[float, float] | None,
    **size: int,
) -> None:
    """Print the patches or a board, true to scale.

    By default, the command writes ./patches-print/patches.pdf, and patches.json with the position of every keypoint.
    Print the PDF at 100 %, then measure the two rulers on the paper.

    \b
    Examples:
      kpbench render-patches --pdf
      kpbench render-patches --svg --dxf --diameter-mm 50 --design my-patch.toml
      kpbench render-patches --board hexagon --patch 0
      kpbench render-patches --board hexagon --diameter-mm 60 --tile
      kpbench render-patches --board grid --target opencv --target kalibr
      kpbench render-patches --board truth --pdf
      kpbench render-patches --board field --rows 11 --columns 8 --diameter-mm 14
      kpbench render-patches --board field --fields 6 --rows 5 --columns 5
      kpbench render-patches --measured 99.8,100.1
    """
    from kpbench.cli.progress import progress_bar
    from kpbench.patches.board_file import DEFAULT_DIAMETER_MM, find_patch, load_boards
    from kpbench.patches.design import load_patches, shipped_patches
    from kpbench.patches.reference_boards import with_reference
    from kpbench.printing.page_format import parse_page_format
    from kpbench.printing.prints import print_boards, print_patches
    from kpbench.printing.sidecar import correct_sidecars
    from kpbench.printing.targets import write_targets

    given = {name for name in ctx.params if ctx.get_parameter_source(name) is not click.core.ParameterSource.DEFAULT}
    _check_usage(given, board)
    if measured is not None:
        for path in correct_sidecars(out, measured):
            echo(path)
        return
    patches = load_patches(designs) if designs else shipped_patches()
    if chosen:
        patches = tuple(dict.fromkeys(find_patch(patches, key) for key in chosen))
    own = patches if designs or chosen else None
    boards = load_boards(board, own, diameter_mm, **size) if board is not None else ()
    if reference:
        boards = tuple(map(with_reference, boards))
    wanted = [name for name, asked in {"pdf": pdf, "svg": svg, "png": png, "dxf": dxf}.items() if asked] or ["pdf"]
    layout: dict[str, Any] = {"page": parse_page_format(page, landscape, not no_labels, mirror, invert), "dpi": dpi}
    with progress_bar(len(boards) or 1, "print", unit="sheet", shown=png) as progress:
        layout |= {"formats": wanted, "progress": progress}
        if board is not None:
            files = [*print_boards(boards, out, tile=tile, **layout), *write_targets(boards, out, targets)]
        else:
            files = print_patches(patches, out, diameter_mm=diameter_mm or DEFAULT_DIAMETER_MM, copies=copies, **layout)
    for path in files:
        echo(path)
    _warn_of_poses(boards)
    echo("Print at 100 % (no scaling), then measure both rulers on the paper.", err=True)


def _warn_of_poses(boards: Sequence[Board]) -> None:
    """Print a warning for each board whose pose is not unique."""
    from kpbench.patches.symmetry import pose_problem

    for board in boards:
        if problem := pose_problem(board):
            print_warning(f"the pose of board {board.name} is not unique: {problem}")


def _check_usage(given: set[str], board: str | None) -> None:
    """Refuse options that do not go together."""
    if "measured" in given and given - {"measured", "out"}:
        raise click.UsageError("--measured corrects the sidecars in --out and takes no other option.")
    if board is None and "targets" in given:
        raise click.UsageError("--target describes a board; give --board.")
    if board is None and "tile" in given:
        raise click.UsageError("--tile spreads a board; give --board.")
    if board is None and "reference" in given:
        raise click.UsageError("--reference adds marks to a board; give --board.")
    if board is not None and "copies" in given:
        raise click.UsageError("--copies is for patches to cut out, not for a --board.")
    if board != "field" and given & {"rows", "columns", "fields"}:
        raise click.UsageError("--rows, --columns and --fields are for --board field.")
    if board not in (None, "hexagon", "grid", "truth", "field") and "chosen" in given:
        raise click.UsageError("--patch does not go with a board file, which names its patches itself.")
