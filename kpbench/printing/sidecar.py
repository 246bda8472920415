"""Sidecars: JSON files beside a print that list the position of every keypoint.

The schema ``kpbench.board/1`` is for boards. Such a sidecar lists positions in the board frame (for ``cv2.solvePnP``)
and on the page. The schema ``kpbench.sheet/1`` is for patches to be cut out. Such a sidecar lists positions on the page
only. The documentation of printing lists the fields.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from kpbench import __version__
from kpbench.errors import DesignError, system_reason
from kpbench.files import load_json, read_bytes
from kpbench.patches.board_sidecar import BOARD_SCHEMA
from kpbench.patches.design import Patch
from kpbench.printing.page import round_to_nm
from kpbench.printing.page_format import PageFormat
from kpbench.toml import LARGEST, TomlTable, name_source
from kpbench.writing import write_file

SHEET_SCHEMA = "kpbench.sheet/1"
LARGEST_ERROR = 0.1  # largest accepted deviation of a measured ruler, as a fraction of the ruler's nominal length


def sidecar_head(
    schema: str, name: str, digest: str, page_format: PageFormat, patches: Iterable[Patch]
) -> dict[str, Any]:
    """Return the fields that the sidecars of boards and of sheets share."""
    return {
        "schema": schema,
        "kpbench": __version__,
        "name": name,
        "digest": digest,
        "page_mm": [page_format.width_mm, page_format.height_mm],
        "mirrored": page_format.mirrored,
        "inverted": page_format.inverted,
        "ruler_mm": list(page_format.rulers_mm),
        "print_scale": [1.0, 1.0],
        "patches": [{"id": p.patch_id, "name": p.name, "digest": p.digest} for p in patches],
    }


def sidecar_entry(
    index: int, patch: Patch, rotate_deg: float, diameter_mm: float, page: int, on_paper: tuple[float, float]
) -> dict[str, Any]:
    """Return the entry of one keypoint. Pages count from 1."""
    return {
        "index": index,
        "patch_id": patch.patch_id,
        "rotate_deg": rotate_deg,
        "diameter_mm": round_to_nm(diameter_mm),
        "page": page,
        "page_x_mm": on_paper[0],
        "page_y_mm": on_paper[1],
    }


def correct_sidecars(folder: str | Path, measured_mm: tuple[float, float]) -> list[Path]:
    """Write ``NAME.measured.json`` beside each sidecar of a folder, with lengths corrected to the real print.

    Parameters
    ----------
    folder : str or Path
        Folder with sidecars, such as :func:`print_patches` writes.
    measured_mm : (float, float)
        Lengths of the x ruler and of the y ruler, measured on the paper.

    Returns
    -------
    list of Path
        The files that were written.

    Raises
    ------
    DesignError
        If the folder holds no sidecar, a sidecar is incomplete, a file cannot be read, or a measured length differs
        from the ruler's nominal length by more than 10 %.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.printing import correct_sidecars
    >>> _ = kpbench.print_patches(out="print")
    >>> [path.name for path in correct_sidecars("print", (99.8, 100.1))]
    ['patches.measured.json']
    """
    written = []
    try:
        paths = sorted(Path(folder).glob("*.json"))
    except OSError as error:
        raise DesignError(f"{folder}: cannot be read, {system_reason(error) or error}") from None
    for path in paths:
        if path.name.endswith(".measured.json"):
            continue
        try:
            sidecar = load_json(read_bytes(path))
            if not isinstance(sidecar, dict) or sidecar.get("schema") not in (BOARD_SCHEMA, SHEET_SCHEMA):
                continue
            with name_source(path, DesignError):
                corrected = correct_sidecar(sidecar, measured_mm)
            content = json.dumps(corrected, indent=1, allow_nan=False) + "\n"
            written.append(path.with_suffix(".measured.json"))
            write_file(written[-1], content.encode())
        except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError) as error:
            raise DesignError(f"{path}: no complete sidecar ({type(error).__name__}: {error})") from None
        except OSError as error:
            raise DesignError(f"{path}: cannot be read, {system_reason(error) or error}") from None
    if not written:
        raise DesignError(f"{folder}: no sidecar of a board or sheet in it; print first, then measure")
    return written


def correct_sidecar(sidecar: Mapping[str, Any], measured_mm: tuple[float, float]) -> dict[str, Any]:
    """Return the sidecar with lengths corrected to the real print. Positions on the page are not corrected.

    If the scales in x and y differ, a printed disc is an ellipse. The diameter in the sidecar is then the geometric
    mean of the two axes of the ellipse.
    """
    require_uncorrected(sidecar)
    TomlTable(sidecar, sidecar.keys(), DesignError).numbers("ruler_mm", 0, count=2)
    scale = [measured / nominal for measured, nominal in zip(measured_mm, sidecar["ruler_mm"], strict=True)]
    for axis, s, measured, nominal in zip("xy", scale, measured_mm, sidecar["ruler_mm"], strict=True):
        if not 1 - LARGEST_ERROR <= s <= 1 + LARGEST_ERROR:
            raise DesignError(
                f"the {axis} ruler is {nominal:g} mm, but {measured:g} mm was measured; "
                f"expected {0.9 * nominal:g} to {1.1 * nominal:g}"
            )
    x, y = scale

    def correct(entry: Mapping[str, Any]) -> dict[str, Any]:
        factor = {"x_mm": x, "y_mm": y, "diameter_mm": math.sqrt(x * y)}
        table = TomlTable(entry, entry.keys(), DesignError)
        lengths = {key: round_to_nm(table.number(key, -LARGEST) * factor[key]) for key in factor if key in entry}
        return dict(entry) | lengths

    result = dict(sidecar) | {"print_scale": scale, "keypoints": [correct(k) for k in sidecar["keypoints"]]}
    if "side_mm" in sidecar:
        result["side_mm"] = [round_to_nm(side * s) for side, s in zip(sidecar["side_mm"], scale, strict=True)]
        if "references" in sidecar:
            result["references"] = [_correct_mark(mark, scale) for mark in sidecar["references"]]
        result["tiles"] = [t | {"corners": [correct(c) for c in t["corners"]]} for t in sidecar["tiles"]]
    return result


def require_uncorrected(sidecar: Mapping[str, Any]) -> None:
    """Refuse a sidecar whose lengths are those of a measured print: its rulers are still those of the design."""
    scale = sidecar.get("print_scale")
    if scale not in (None, [1.0, 1.0]):
        raise DesignError(f"is corrected already, print_scale is {scale}; expected the sidecar that was printed")


def _correct_mark(mark: Mapping[str, Any], scale: list[float]) -> dict[str, Any]:
    corners = [[round_to_nm(float(v) * s) for v, s in zip(corner, scale, strict=True)] for corner in mark["corners_mm"]]
    return dict(mark) | {"corners_mm": corners}
