"""Croissant metadata: ``croissant.json``, which tells other programs what files and columns an export has.

https://docs.mlcommons.org/croissant/docs/croissant-spec-1.0.html
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from kpbench.dataset.folder import Dataset
from kpbench.dataset.parquet import HUB_SPLITS
from kpbench.predictions.coco import CocoDataset
from kpbench.provenance import describe_images, image_source
from kpbench.types import KEYPOINT_DTYPE
from kpbench.writing import write_file

CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileObject": "cr:fileObject",
    "fileProperty": "cr:fileProperty",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
"""The JSON-LD context that the specification asks for."""
COLUMNS = (
    ("image", "sc:ImageObject", "Grey or RGB."),
    ("image_id", "sc:Integer", "Unique in the dataset."),
    ("scene_id", "sc:Integer", "Images of one base scene share it."),
    ("condition", "sc:Text", "Condition of a benchmark suite; empty for none."),
    ("rung", "sc:Float", "Severity within the condition; null for none."),
    ("degradations", "sc:Text", "JSON: the effects applied, in order, with their parameters."),
)
"""Name, type and meaning of each column besides ``keypoints``."""
KEYPOINT_MEANINGS = {
    "x": "px; the centre of the top-left pixel is 0",
    "y": "px, downwards; the centre of the top-left pixel is 0",
    "patch_id": "ID of the design, from 0",
    "radius_major": "px, major semi-axis of the ellipse that the disc projects to",
    "radius_minor": "px, minor semi-axis of the ellipse that the disc projects to",
    "axis_angle": "degrees from +x towards +y, of the major axis, in [0, 180)",
    "H_patch2image": "homography from the patch frame (unit disc) to px",
    "visible": "fraction of the disc that is inside the image and not occluded",
    "contrast": "grey levels, white minus black; null if unknown",
}


def write_croissant(dataset: Dataset | CocoDataset, folder: Path, splits: list[str]) -> Path:
    """Write ``croissant.json`` beside an export to Parquet, and return it.

    Each split is a record set with a record per image.
    """
    present = {split: name for split, name in HUB_SPLITS.items() if split in splits}
    images = describe_images(len(dataset), image_source(dataset.config))
    content = {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": f"keypoint-patches-{dataset.fingerprint[:12]}",
        "description": f"Keypoint patches: {images} with their true keypoints. Fingerprint {dataset.fingerprint}.",
        "version": "1.0.0",
        "distribution": [
            {
                "@type": "cr:FileSet",
                "@id": f"{name}-files",
                "encodingFormat": "application/x-parquet",
                "includes": f"data/{name}-*.parquet",
            }
            for name in present.values()
        ],
        "recordSet": [
            {
                "@type": "cr:RecordSet",
                "@id": name,
                "field": [
                    *(_field(name, column, kind, meaning) for column, kind, meaning in COLUMNS),
                    *(_keypoint_field(name, column) for column in KEYPOINT_DTYPE.names or ()),
                ],
            }
            for name in present.values()
        ],
    }
    write_file(folder / "croissant.json", json.dumps(content, indent=1).encode() + b"\n")
    return folder / "croissant.json"


def _field(split: str, column: str, kind: str, meaning: str) -> dict[str, Any]:
    source: dict[str, Any] = {"fileSet": {"@id": f"{split}-files"}, "extract": {"column": column}}
    if column == "image":
        source["transform"] = {"jsonPath": "bytes"}
    return {
        "@type": "cr:Field",
        "@id": f"{split}/{column}",
        "description": meaning,
        "dataType": kind,
        "source": source,
    }


def _keypoint_field(split: str, column: str) -> dict[str, Any]:
    """Return the field of a column of the keypoints: a list with a value per keypoint of the image."""
    kind = "sc:Integer" if KEYPOINT_DTYPE[column].base.kind == "i" else "sc:Float"
    field = _field(split, "keypoints", kind, KEYPOINT_MEANINGS[column])
    field["source"]["transform"] = {"jsonPath": f"$[*].{column}"}
    return {**field, "@id": f"{split}/keypoints_{column}", "repeated": True}
