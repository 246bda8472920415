"""Board files for other programs: OpenCV, Kalibr and mrcal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from kpbench.errors import DesignError
from kpbench.files import make_folder
from kpbench.patches.board import Board
from kpbench.printing.prints import file_stem
from kpbench.types import Float
from kpbench.writing import require_writable, write_file

TARGET_FOLDER = "targets"
"""Subfolder of the prints that holds the files for other programs."""
MOST_UNEVEN_MM = 1e-6
"""Two coordinates of a grid that differ by less are the same."""


def _to_opencv(board: Board) -> str:
    """Return a file for ``cv2.FileStorage``: the points, mm, as ``cv2.solvePnP`` takes them, and the IDs."""
    points = ", ".join(f"{v:.9g}" for v in board.points_mm.ravel().tolist())
    ids = ", ".join(str(k.patch_id) for k in board.keypoints)
    count = len(board.keypoints)
    return (
        "%YAML:1.0\n---\n# kpbench.target/1\n"
        f"object_points: !!opencv-matrix\n   rows: {count}\n   cols: 3\n   dt: d\n   data: [ {points} ]\n"
        f"patch_id: !!opencv-matrix\n   rows: {count}\n   cols: 1\n   dt: i\n   data: [ {ids} ]\n"
    )


def _to_kalibr(board: Board) -> str:
    """Return a target of the type ``circlegrid``, m. The centres of the patches are those of the circles."""
    x, y = (_grid_lines(board, axis) for axis in (0, 1))
    pitches = np.concatenate([np.diff(x), np.diff(y)])
    is_grid = len(x) > 1 and len(y) > 1 and len(x) * len(y) == len(board.keypoints)
    if not is_grid or np.ptp(pitches) > MOST_UNEVEN_MM:
        raise DesignError(f"board {board.name!r}: is no grid of one pitch, the only board that Kalibr can describe")
    return (
        "# kpbench.target/1\n"
        f"target_type: 'circlegrid'\ntargetCols: {len(x)}\ntargetRows: {len(y)}\n"
        f"spacingMeters: {pitches[0] / 1000:.9g}\nasymmetricGrid: False\n"
    )


def _to_mrcal(board: Board) -> str:
    """Return a table in vnlog: the index, the ID and the place, m, of each point."""
    rows = [f"{n} {k.patch_id} {k.x_mm / 1000:.9g} {k.y_mm / 1000:.9g} 0" for n, k in enumerate(board.keypoints)]
    return "\n".join(["## kpbench.target/1", "# point patch_id x y z", *rows, ""])


def _grid_lines(board: Board, axis: int) -> Float:
    return np.unique(np.round(board.points_mm[:, axis], 6))


TARGET_WRITERS: dict[str, tuple[str, Callable[[Board], str]]] = {
    "opencv": (".opencv.yaml", _to_opencv),
    "kalibr": (".kalibr.yaml", _to_kalibr),
    "mrcal": (".mrcal.vnl", _to_mrcal),
}
"""Suffix and function of the file for each program."""


def write_targets(boards: Sequence[Board], folder: str | Path, programs: Sequence[str]) -> list[Path]:
    """Write boards for other programs, into the subfolder ``targets``.

    Parameters
    ----------
    boards : sequence of Board
    folder : str or Path
        Folder of the prints.
    programs : sequence of str
        Some of "opencv", "kalibr" and "mrcal". Kalibr knows grids of one pitch alone.

    Returns
    -------
    list of Path
        The files that were written.

    Raises
    ------
    DesignError
        If Kalibr cannot describe a board. Nothing is written then.
    DataError
        If a file cannot be written.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.printing import write_targets
    >>> board = kpbench.grid_board(kpbench.shipped_patches(), rows=2, columns=3, diameter_mm=20.0, pitch_mm=40.0)
    >>> [path.name for path in write_targets([board], "print", ["kalibr"])]
    ['grid.kalibr.yaml']
    """
    files = {
        Path(folder) / TARGET_FOLDER / f"{file_stem(board.name)}{suffix}": write(board)
        for board in boards
        for suffix, write in (TARGET_WRITERS[program] for program in programs)
    }
    for path in files:
        make_folder(path.parent)
        require_writable(path, "target")
    for path, content in files.items():
        write_file(path, content.encode())
    return [*files]
