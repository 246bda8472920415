"""Plain parsers, by other libraries than kpbench uses where there are any, and how what kpbench read differs.

Each function takes the bytes of a file and what kpbench read from it. It returns "" if both are the same or if the
plain parser has no opinion, else in few words how they differ; the text before a colon is the kind of difference. A
parser that raises did not read the file at all.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
import tomllib
from decimal import Decimal, InvalidOperation
from numbers import Real
from typing import Any

import numpy as np

MEASURED_MM = (99.0, 101.0)
"""Lengths of the rulers with which sidecars are corrected."""
OF_IMAGE = ("image_id", "file", "width", "height", "frame_index", "time_s", "ms")
"""Columns of predictions that say nothing of a detection."""
Rows = dict[int, list[tuple[float, float, float, int | None]]]
"""Detections of each image: x, y, score, id."""


class Refusal(ValueError):
    """A plain parser finds a value that no sound file has."""


def loads(data: bytes | str) -> Any:
    """JSON as Python's own parser reads it, but for its limit on the digits of a number."""
    return json.loads(data, parse_int=lambda text: int(text) if len(text) < 4300 else float(text))


def number(value: Any) -> float:
    """A finite number; a truth value or text is none."""
    if isinstance(value, bool) or not isinstance(value, Real | Decimal) or not math.isfinite(value):
        raise Refusal("a value that is no finite number")
    return float(value)


def whole(value: Any, most: int = 2**63 - 1) -> int:
    number(value)
    if value != int(value) or not 0 <= value <= most:
        raise Refusal("a value that is no whole number of 0 to 2**63 - 1")
    return int(value)


# --- Predictions ---------------------------------------------------------------------------------------------------


def same_predictions(found: Any, rows: Rows, header: dict[str, Any]) -> str:
    """How predictions that kpbench read differ from plain rows."""
    ids = found.patch_id
    got: Rows = {}
    for n, image_id in enumerate(found.image_id.tolist()):
        low, high = found.offsets[n : n + 2].tolist()
        named = [None] * (high - low) if ids is None else ids[low:high].tolist()
        got[image_id] = [
            (*xy, s, k)
            for xy, s, k in zip(found.xy[low:high].tolist(), found.score[low:high].tolist(), named, strict=True)
        ]
    if sorted(got) != sorted(rows):
        return f"image ids differ: {sorted(got)[:5]} of {sorted(rows)[:5]}"
    for image_id, expected in rows.items():
        if len(got[image_id]) != len(expected):
            return f"number of detections differs: image {image_id}, {len(got[image_id])} of {len(expected)}"
        for one, other in zip(got[image_id], expected, strict=True):
            for name, a, b in zip(("x", "y", "score", "id"), one, other, strict=True):
                if a != b:
                    return f"{name} differs: image {image_id}, {a!r} of {b!r}"
    for name in ("dataset", "fingerprint"):
        if getattr(found, name) != header.get(name):
            return f"{name} differs: {getattr(found, name)!r} of {header.get(name)!r}"
    told = header.get("detector", {})
    return "" if repr(found.detector) == repr(told) else f"detector differs: {found.detector!r} of {told!r}"[:300]


def _add_record(rows: Rows, record: dict[str, Any]) -> None:
    image_id = whole(record["image_id"])
    points = record["keypoints"]
    scores, ids = record.get("scores"), record.get("ids")
    if image_id in rows:
        raise Refusal("an image twice")
    if not isinstance(points, list):
        raise Refusal("keypoints that are no list")
    for name, column in (("scores", scores), ("ids", ids)):
        if column is not None and (not isinstance(column, list) or len(column) != len(points)):
            raise Refusal(f"{name} that are no list of the length of keypoints")
    rows[image_id] = []
    for n, (x, y) in enumerate(points):
        score = 1.0 if scores is None else number(scores[n])
        rows[image_id].append((number(x), number(y), score, None if ids is None else whole(ids[n])))


def predictions_json(data: bytes, found: Any) -> str:
    content = loads(data)
    if isinstance(content, list):
        return coco_results(data, found)
    rows: Rows = {}
    for record in content["predictions"]:
        _add_record(rows, record)
    return same_predictions(found, rows, content)


def predictions_jsonl(data: bytes, found: Any) -> str:
    first, *lines = data.removesuffix(b"\n").split(b"\n")
    rows: Rows = {}
    for line in lines:
        _add_record(rows, loads(line))
    return same_predictions(found, rows, loads(first))


def coco_results(data: bytes, found: Any) -> str:
    rows: Rows = {}
    for entry in loads(data):
        x, y, _ = entry["keypoints"]
        row = (number(x), number(y), number(entry["score"]), whole(entry["category_id"], 2**15) - 1)
        rows.setdefault(whole(entry["image_id"]), []).append(row)
    return same_predictions(found, rows, {})


def predictions_csv(data: bytes, found: Any) -> str:
    text = data.decode("utf-8-sig")
    header = {}
    if text.startswith("#"):
        first, _, text = re.split("(\r\n|\r|\n)", text, maxsplit=1)
        header = loads(first[1:])
    table = list(csv.reader(io.StringIO(text, newline=""), strict=True))
    while table and not "".join(table[-1]).strip():
        table.pop()
    names, rows = [name.strip() for name in table[0]], Rows()
    for cells in table[1:]:
        if len(cells) != len(names):
            raise Refusal("a row of another length than the header")
        row = dict(zip(names, cells, strict=True))
        image = rows.setdefault(_exact(row["image_id"], 2**63 - 1), [])
        values = [row.get(name) for name in ("x", "y", "score", "id") if name in row]
        if any(value.strip() for value in values):
            score = number(float(row["score"])) if "score" in row else 1.0
            image.append(
                (number(float(row["x"])), number(float(row["y"])), score, _exact(row["id"]) if "id" in row else None)
            )
    return same_predictions(found, rows, header)


def _exact(cell: str, most: int = 2**53) -> int:
    """A whole number in a cell, however it is written, without rounding."""
    try:
        exact = Decimal(cell.strip())
        if not exact.is_finite() or abs(exact.adjusted()) > 400 or exact != exact.to_integral_value():
            raise Refusal("an id that is no whole number")
    except InvalidOperation:
        raise Refusal("an id that is no whole number") from None
    return whole(int(exact), most)


def predictions_parquet(data: bytes, found: Any) -> str:
    import pyarrow.parquet as pq

    table = pq.read_table(io.BytesIO(data))
    rows: Rows = {}
    for row in table.to_pylist():
        image = rows.setdefault(whole(row["image_id"]), [])
        values = [None if isinstance(v, float) and math.isnan(v) else v for k, v in row.items() if k not in OF_IMAGE]
        if any(value is not None for value in values):
            score = number(row["score"]) if "score" in row else 1.0
            image.append((number(row["x"]), number(row["y"]), score, whole(row["id"]) if "id" in row else None))
    header = loads((table.schema.metadata or {}).get(b"kpbench", b"{}"))
    return same_predictions(found, rows, header)


def predictions_h5(data: bytes, found: Any) -> str:
    import h5py

    with h5py.File.in_memory(data) as file:
        columns = {name: file[name][()].tolist() for name in file}
        header = loads(file.attrs.get("header", "{}"))
    offsets, rows = [whole(v) for v in columns["offsets"]], Rows()
    for n, image_id in enumerate(columns["image_id"]):
        if image_id in rows:
            raise Refusal("an image twice")
        rows[whole(image_id)] = [
            (
                *map(number, columns["xy"][k]),
                number(columns["score"][k]) if "score" in columns else 1.0,
                whole(columns["id"][k]) if "id" in columns else None,
            )
            for k in range(offsets[n], offsets[n + 1])
        ]
    return same_predictions(found, rows, header)


# --- Truth ---------------------------------------------------------------------------------------------------------


def coco(data: bytes, found: Any) -> str:
    content, truth = loads(data), found.truth
    ids = [whole(image["id"]) for image in content["images"]]
    if len(set(ids)) < len(ids):
        raise Refusal("two images of one id")
    if truth.image_id.tolist() != ids:
        return "image ids differ"
    expected: dict[int, list[tuple[float, ...]]] = {image_id: [] for image_id in ids}
    crowds: dict[int, list[tuple[float, ...]]] = {image_id: [] for image_id in ids}
    for entry in content["annotations"]:
        x, y, v = map(number, entry["keypoints"])
        is_crowd = entry.get("iscrowd") == 1
        if v > 0 or (is_crowd and not (entry.get("radius_major") is None and entry.get("radius") is None)):
            major = entry.get("radius_major")
            major = number(entry["radius"] if major is None else major)
            minor = entry.get("radius_minor")
            minor = major if minor is None else number(minor)
            if major <= 0 or minor <= 0:
                raise Refusal("a radius of 0 or less")
            angle, visible = number(entry.get("axis_angle", 0.0)), number(entry.get("visible", 1.0))
            sizes = np.array([major, minor, angle, visible], np.float32).astype(float).tolist()
            rows = crowds if is_crowd else expected
            rows[whole(entry["image_id"])].append((x, y, whole(entry["category_id"], 2**15) - 1, *sizes))
    names = ("x", "y", "patch_id", "radius_major", "radius_minor", "axis_angle", "visible")
    for n, image_id in enumerate(ids):
        got = truth.keypoints[truth.offsets[n] : truth.offsets[n + 1]][list(names)].tolist()
        if got != expected[image_id]:
            return f"keypoints differ: image {image_id}, {got} of {expected[image_id]}"[:300]
        if found.ignored(n)[list(names)].tolist() != crowds[image_id]:
            return f"ignored patches differ: image {image_id}"
    for n, image in enumerate(content["images"]):
        if str(truth.condition[n]) != image.get("condition", ""):
            return f"condition differs: {str(truth.condition[n])!r} of {image.get('condition', '')!r}"[:200]
        rung = image.get("rung")
        if rung is not None and truth.rung[n] != number(rung):
            return f"rung differs: {truth.rung[n]} of {rung}"
    return ""


def poses(data: bytes, found: Any) -> str:
    """Whether the poses of a file of JSON lines are those that its lines tell."""
    lines = [loads(line) for line in data.decode("utf-8-sig").splitlines()[1:] if line.strip()]
    if [line["image_id"] for line in lines] != [pose["image_id"] for pose in found]:
        return "image ids differ"
    for line, pose in zip(lines, found, strict=True):
        for one, other in ((line, pose), (line["filtered"] or {}, pose["filtered"] or {})):
            for name in ("rotation", "translation_mm") if one.get("rotation") is not None else ():
                if not np.array_equal(np.array(one[name], float), np.array(other[name])):
                    return f"{name} differs: image {line['image_id']}"
    return ""


def manifest(data: bytes, found: Any) -> str:
    """Whether every number of the manifest is true of the shard beside it."""
    import h5py

    content, dataset = loads(data), found
    shards = content["shards"]
    if [vars(entry) for entry in dataset.shards] != shards or dataset.config != content["config"]:
        return "shards or config differ"
    if len({shard["file"] for shard in shards}) < len(shards):
        return "verified, but untrue shards of the manifest, one twice"
    first = 0
    for shard in shards:
        with h5py.File(dataset.path / shard["file"]) as file:
            true = len(file["images"])
        for name, value in (("first", first), ("count", true)):
            if shard[name] != value or isinstance(shard[name], bool):
                return f"verified, but untrue {name} of a shard: {shard[name]!r}"[:200]
        first += true
    for name, value in (("images", first), ("seed", content["config"].get("seed")), ("version", 1)):
        if content.get(name) != value or isinstance(content.get(name), bool):
            return f"verified, but untrue {name} of the manifest: {content.get(name)!r}"[:200]
    return ""


def shard(data: bytes, found: Any) -> str:
    import h5py

    truth = found.truth
    with h5py.File.in_memory(data) as file:
        for name in ("image_id", "scene_id", "rung"):
            raw, got = file[name][()], getattr(truth, name)
            if raw.dtype.kind not in ("f" if name == "rung" else "iu"):
                return f"{name} of another type: {raw.dtype}"
            if not np.array_equal(raw, got, equal_nan=True) or (raw.tolist() != got.tolist() and name != "rung"):
                return f"{name} differs"
        if [v.decode() for v in np.asarray(file["condition"][()], object)] != truth.condition.tolist():
            return "condition differs"
        rows = file["keypoints"][()]
        judged = rows["sigma_x"] != np.inf if "sigma_x" in rows.dtype.names else np.ones(len(rows), bool)
        if rows[judged].tobytes() != truth.keypoints.tobytes():
            return "keypoints differ"
        offsets = np.append(0, np.cumsum(judged))[file["offsets"][()]].tolist()
        if truth.offsets.tolist() != offsets:
            return f"offsets differ: {truth.offsets.tolist()} of {offsets}"[:200]
        if len(set(truth.image_id.tolist())) < len(truth.image_id):
            return "verified, but two images of one id"
        for name in ("x", "y", "radius_major", "radius_minor"):
            if not np.isfinite(truth.keypoints[name]).all():
                return f"verified, but {name} of a keypoint is not finite"
        if len(found) != len(truth.image_id):
            return f"verified, but untrue count of a shard: {len(found)} of {len(truth.image_id)}"
        if not np.array_equal(file["images"][0], found.image(0)):
            return "pixels differ"
    return ""


def sidecar(data: bytes, found: Any) -> str:
    content, measured = loads(data), loads(found)
    scale = [m / number(r) for m, r in zip(MEASURED_MM, content["ruler_mm"], strict=True)]
    for before, after in zip(content["keypoints"], measured["keypoints"], strict=True):
        for key, s in (("x_mm", scale[0]), ("y_mm", scale[1])):
            if key in before and abs(after[key] - number(before[key]) * s) > 1e-6 + 1e-9 * abs(after[key]):
                return f"{key} differs: {after[key]!r} of {before[key]!r}"[:200]
    kept = content.keys() - {"keypoints", "side_mm", "tiles", "print_scale"}
    odd = [key for key in kept if repr(measured.get(key)) != repr(content[key])]
    return f"{odd[0]!r} differs"[:80] if odd else ""


# --- TOML ----------------------------------------------------------------------------------------------------------


def toml_patch(data: bytes, found: Any) -> str:
    content = tomllib.loads(data.decode("utf-8"))
    defaults = {"schema": "kpbench.patch/1", "disc": "white", "rim": {"width": 0.0, "ink": "white"}, "quiet_zone": 0.0}
    given = defaults | content
    given["rim"] = defaults["rim"] | given["rim"]  # type: ignore[operator]
    given["semicircles"] = [{"radius": 1.0} | entry for entry in given["semicircles"]]
    got = {"rim": defaults["rim"], "quiet_zone": 0.0} | found[0].to_dict()
    if not given["rim"]["width"]:
        given["rim"], got["rim"] = {}, {}
    return _first_difference(got, given)


def _first_difference(got: Any, given: Any, place: str = "") -> str:
    """The first key of a given table that was read as another value; keys that were not given do not count."""
    if isinstance(given, dict):
        got = got if isinstance(got, dict) else vars(got)
        parts = [_first_difference(got[key], value, key) for key, value in given.items() if key in got]
        missing = [f"{key} was passed over" for key in given if key not in got]
        return next(filter(None, [*missing, *parts]), "")
    if isinstance(given, list):
        if len(given) != len(got):
            return f"{place} differs in length"
        return next(filter(None, (_first_difference(a, b, place) for a, b in zip(got, given, strict=True))), "")
    same = got == (float(given) if isinstance(got, float) and isinstance(given, int) else given)
    same = same and isinstance(got, bool) == isinstance(given, bool)
    return "" if same else f"{place} differs: {got!r} of {given!r}"[:200]


def toml_board(data: bytes, found: Any) -> str:
    content = tomllib.loads(data.decode("utf-8"))
    if "name" in content and content["name"] != found.name:
        return "name differs"
    if "size_mm" in content and [found.side_x_mm, found.side_y_mm] != content["size_mm"]:
        return f"size_mm differs: {found.side_x_mm} {found.side_y_mm} of {content['size_mm']}"
    if "grid" in content:
        grid = content["grid"]
        return "" if len(found.keypoints) == grid["rows"] * grid["columns"] else "number of keypoints differs"
    if len(found.keypoints) != len(content["keypoint"]):
        return "number of keypoints differs"
    for got, given in zip(found.keypoints, content["keypoint"], strict=True):
        if given["patch"] not in (got.patch.name, got.patch.patch_id, str(got.patch.patch_id)):
            return "patch differs"
        rest = {key: value for key, value in given.items() if key != "patch"}
        if difference := _first_difference(got, rest):
            return difference
    return ""


def toml_suite(data: bytes, found: Any) -> str:
    content = tomllib.loads(data.decode("utf-8"))
    plain = {key: content[key] for key in ("name", "images")}
    plain["size_px"] = content["camera"]["size_px"]
    plain["lens_mm"], plain["pixel_um"] = content["camera"]["lens_mm"], content["camera"]["pixel_um"]
    if difference := _first_difference(found, plain):
        return difference
    for (key, span), given in ((pair, content["scene"][pair[0]]) for pair in found.scene):
        if list(span) != (given if isinstance(given, list) else [given, given]):
            return f"{key} differs: {span} of {given}"
    for got, given in zip(found.conditions, content["condition"], strict=True):
        table = {
            "name": got.name,
            "unit": got.unit,
            "rungs": got.rungs,
            "pose": dict(got.pose),
            "effects": dict(got.effects),
            "camera": dict(got.camera),
            "board": got.board,
            "film": dict(got.film),
            "clutter": got.clutter,
            "paper_px2": got.paper_px2,
        }
        if difference := _first_difference(table, given):
            return difference
    return ""


def toml_recipe(data: bytes, found: Any) -> str:
    return _first_difference(found, tomllib.loads(data.decode("utf-8")))
