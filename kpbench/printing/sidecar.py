"""Sidecars: where the keypoints of a printed sheet or board are, as JSON beside the print.

``kpbench.board/1`` has positions in the board frame (for ``cv2.solvePnP``) and on the page;
``kpbench.sheet/1``, of patches to be cut out, on the page only. ``docs/howto/print.md`` lists the fields.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from kpbench.errors import DesignError
from kpbench.files import write_atomic

BOARD_SCHEMA = "kpbench.board/1"
SHEET_SCHEMA = "kpbench.sheet/1"


def nm(value: float) -> float:
    """Millimetres to 1 nm, so that a sidecar holds no float noise."""
    return round(value, 6) + 0.0


def correct_sidecars(folder: str | Path, measured_mm: tuple[float, float]) -> list[Path]:
    """Write ``NAME.measured.json`` beside each sidecar of a folder: positions as the printer made them.

    Parameters
    ----------
    folder : path
    measured_mm : (x, y)
        Lengths in mm of the two rulers as measured on the paper.

    Raises
    ------
    DesignError
        If the folder holds no sidecar, or a length is more than a tenth off.
    """
    written = []
    for path in sorted(Path(folder).glob("*.json")):
        if path.name.endswith(".measured.json"):
            continue
        try:
            sidecar = json.loads(path.read_bytes())
            if not isinstance(sidecar, dict) or sidecar.get("schema") not in (BOARD_SCHEMA, SHEET_SCHEMA):
                continue
            content = json.dumps(corrected(sidecar, measured_mm, str(path)), indent=1) + "\n"
            written.append(path.with_suffix(".measured.json"))
            write_atomic(written[-1], content.encode())
        except (KeyError, TypeError, ValueError) as error:
            raise DesignError(f"{path}: no complete sidecar ({type(error).__name__}: {error})") from None
        except OSError as error:
            raise DesignError(f"{error.filename}: {error.strerror}") from None
    if not written:
        raise DesignError(f"{folder}: no sidecar of a board or sheet in it; print first, then measure")
    return written


def corrected(sidecar: Mapping[str, Any], measured_mm: tuple[float, float], source: str = "sidecar") -> dict[str, Any]:
    """The sidecar with its lengths in mm as measured; page positions stay those of the file.

    A disc whose x and y scales differ is an ellipse: its diameter becomes the geometric mean.
    """
    scale = [measured / nominal for measured, nominal in zip(measured_mm, sidecar["ruler_mm"], strict=True)]
    for axis, s, measured, nominal in zip("xy", scale, measured_mm, sidecar["ruler_mm"], strict=True):
        if not 0.9 <= s <= 1.1:
            raise DesignError(
                f"{source}: the {axis} ruler is {nominal:g} mm, but {measured:g} mm was measured; "
                f"expected {0.9 * nominal:g} to {1.1 * nominal:g}"
            )
    x, y = scale

    def scaled(entry: Mapping[str, Any]) -> dict[str, Any]:
        factor = {"x_mm": x, "y_mm": y, "diameter_mm": math.sqrt(x * y)}
        return {key: nm(value * factor[key]) if key in factor else value for key, value in entry.items()}

    result = dict(sidecar) | {"print_scale": scale, "keypoints": [scaled(k) for k in sidecar["keypoints"]]}
    if "side_mm" in sidecar:
        result["side_mm"] = [nm(side * s) for side, s in zip(sidecar["side_mm"], scale, strict=True)]
        result["tiles"] = [t | {"corners": [scaled(c) for c in t["corners"]]} for t in sidecar["tiles"]]
    return result
