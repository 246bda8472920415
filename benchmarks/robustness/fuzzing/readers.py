"""The table of readers: how kpbench's files are made, changed, read, and held against a plain parser.

To add a reader, add an entry to ``READERS``: a name, a file name, functions that make valid files, change one, and read
one, a plain parser of the container, and a plain parser of the content if there is one (``references.py``).
"""

from __future__ import annotations

import json
import random
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import kpbench
import kpbench.predictions
import kpbench.synth
import kpbench.training
from kpbench.benchmark.rerun import read_scores_json
from kpbench.boards import read_poses
from kpbench.camera import load_camera_preset

from . import binary_references, reading, references, seeds
from .binary import jpeg_segments, mutate_boxes, mutate_jpeg, mutate_png, mutate_riff, mutate_tiff, png_chunks
from .changes import change_film, change_gif, change_header, change_jsonl, change_parquet, of_json, of_toml, toml_of
from .hdf5 import mutate_hdf5
from .networks import mutate_onnx, mutate_safetensors, mutate_state_dict
from .texts import mutate_csv, mutate_yaml
from .trees import damage

FAILURES = (OSError, RuntimeError, ValueError, LookupError, TypeError, ArithmeticError, MemoryError, AttributeError)
"""Errors of a writer that cannot write a changed value down."""


@dataclass(frozen=True)
class Reader:
    """One kind of file.

    Attributes
    ----------
    name : str
    file : str
        Name of the file in its folder.
    seeds : function
        Valid files, or the trees of valid files as JSON.
    mutate : function
        A changed file from a generator of random numbers and a seed.
    read : function
        Read the file at a path as kpbench does, all of it.
    container : function
        A plain parser of the container: raises if nothing is behind the header.
    reference : function or None
        How what was read differs from what a plain parser reads, see :mod:`fuzzing.references`.
    as_seed : function
        The valid file that a seed stands for.
    share : float
        Weight in the total number of inputs.
    imports : tuple of str
        Modules that are loaded before the workers start.
    """

    name: str
    file: str
    seeds: Callable[[], list[bytes]]
    mutate: Callable[[random.Random, bytes], bytes]
    read: Callable[[Path], Any]
    container: Callable[[bytes], object]
    reference: Callable[[bytes, Any], str] | None = None
    as_seed: Callable[[bytes], bytes] = field(default=lambda data: data)
    share: float = 1.0
    imports: tuple[str, ...] = ()

    def make(self, seed: int, index: int, valid: list[bytes]) -> bytes:
        """Make an input: a function of the seed, the reader and the index alone."""
        rng = random.Random(f"{seed}/{self.name}/{index}")
        chosen = rng.choice(valid)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                return self.mutate(rng, chosen)
            except FAILURES:
                return damage(rng, self.as_seed(chosen))  # this change cannot be written down


PILLOW, ARROW = ("PIL.Image",), ("pyarrow.parquet",)
DATA = ("h5py", "kpbench.synth.suite", "kpbench.dataset.generation")
TORCH = ("torch", "safetensors.torch", "kpbench.training.weights", "kpbench.training.loop", "onnx")
ALL_READERS = (
    Reader(
        "predictions-json", "input.json", seeds.predictions_json, of_json("image_id", "ids", "scores", "schema"),
        kpbench.read_predictions, json.loads, references.predictions_json, share=2,
    ),
    Reader(
        "predictions-jsonl", "input.jsonl", lambda: seeds.predictions_files(".jsonl"), change_jsonl,
        kpbench.read_predictions, reading.is_jsonl, references.predictions_jsonl, share=2,
    ),
    Reader(
        "predictions-csv", "input.csv", lambda: seeds.predictions_files(".csv"),
        lambda rng, data: mutate_csv(rng, data.decode()),
        kpbench.read_predictions, reading.is_csv, references.predictions_csv, share=2, imports=("pandas",),
    ),
    Reader(
        "predictions-parquet", "input.parquet", lambda: seeds.predictions_files(".parquet"), change_parquet,
        kpbench.read_predictions, reading.is_parquet, references.predictions_parquet, share=1.5, imports=ARROW,
    ),
    Reader(
        "predictions-h5", "input.h5", lambda: seeds.predictions_files(".h5"), mutate_hdf5,
        kpbench.read_predictions, reading.is_hdf5, references.predictions_h5, share=2, imports=("h5py",),
    ),
    Reader(
        "coco", "input.json", seeds.coco, of_json("keypoints", "radius", "id", "image_id"),
        kpbench.predictions.open_coco, json.loads, references.coco, share=2,
    ),
    Reader(
        "coco-results", "input.json", seeds.coco_results, of_json("image_id", "category_id", "score"),
        kpbench.read_predictions, json.loads, references.predictions_json, share=1.5,
    ),
    Reader(
        "scores", "input.json", seeds.scores, of_json("suite", "name", "fingerprint", "sha256", "config"),
        read_scores_json, json.loads, imports=DATA,
    ),
    Reader(
        "poses-jsonl", "input.jsonl", lambda: seeds.poses(".jsonl"), change_jsonl,
        read_poses, reading.is_jsonl, references.poses,
    ),
    Reader(
        "poses-csv", "input.csv", lambda: seeds.poses(".csv"), lambda rng, data: mutate_csv(rng, data.decode()),
        read_poses, reading.is_poses_csv,
    ),
    Reader(
        "marked-board", "input.json", seeds.marked_boards,
        of_json("references", "corners_mm", "dictionary", "id", "x_mm", "print_scale"),
        lambda path: kpbench.load_board(path).references, json.loads,
    ),
    Reader(
        "manifest", "dataset.json", seeds.manifests,
        of_json("first", "count", "bytes", "images", "seed", "sha256", "file", "fingerprint", "shards"),
        reading.read_manifest, json.loads, references.manifest, imports=DATA,
    ),
    Reader(
        "shard", "shard-00000.h5", seeds.shards, mutate_hdf5,
        reading.read_shard, reading.is_hdf5, references.shard, share=2, imports=DATA,
    ),
    Reader(
        "sidecar", "input.json", seeds.sidecars, of_json("ruler_mm", "x_mm", "side_mm", "tiles"),
        reading.read_sidecar, json.loads, references.sidecar,
    ),
    Reader(
        "patch", "input.toml", seeds.patches, of_toml("id", "radius", "start_deg"),
        reading.read_patch, reading.is_toml, references.toml_patch, toml_of, share=2,
    ),
    Reader(
        "board", "input.toml", seeds.boards, of_toml("patch", "rows", "x_mm", "size_mm"),
        lambda path: kpbench.load_board(path), reading.is_toml, references.toml_board, toml_of, share=2,
    ),
    Reader(
        "suite", "input.toml", seeds.suites, of_toml("name", "patches", "rungs", "pose", "effects"),
        lambda path: kpbench.load_suite(str(path)), reading.is_toml, references.toml_suite, toml_of,
        share=2, imports=DATA,
    ),
    Reader(
        "recipe", "input.toml", seeds.recipes, of_toml("batch", "phases", "samples", "lr", "widths"),
        kpbench.training.load_recipe, reading.is_toml, references.toml_recipe, toml_of, share=2,
    ),
    Reader(
        "camera", "input.toml", seeds.cameras, of_toml("f_number", "tone", "bayer", "jpeg_quality", "detail"),
        lambda path: load_camera_preset(str(path)), reading.is_toml, as_seed=toml_of,
    ),
    Reader(
        "calibration", "input.yaml", seeds.calibrations, lambda rng, data: mutate_yaml(rng, json.loads(data)),
        kpbench.read_camera, reading.is_yaml,
    ),
    Reader(
        "onnx", "input.onnx", seeds.onnx_models, mutate_onnx,
        reading.read_detector, reading.is_onnx, imports=("onnxruntime", "onnx"),
    ),
    Reader(
        "onnx-weights", "input.onnx", seeds.onnx_models, mutate_onnx,
        reading.read_initial_weights, reading.is_onnx, imports=TORCH,
    ),
    Reader(
        "checkpoint", "input.safetensors", seeds.checkpoints, mutate_safetensors,
        reading.read_checkpoint, binary_references.safetensors_header, binary_references.checkpoint, imports=TORCH,
    ),
    Reader(
        "weights", "input.safetensors", seeds.checkpoints, mutate_safetensors,
        reading.read_initial_weights, binary_references.safetensors_header, imports=TORCH,
    ),
    Reader(
        "state-dict", "input.pth", seeds.state_dicts, mutate_state_dict,
        reading.read_initial_weights, reading.is_zip, imports=TORCH,
    ),
    Reader(
        "pipeline-json", "input.json", seeds.pipelines, of_json("__class_fullname__", "p"),
        kpbench.synth.load_augmentation, json.loads, binary_references.pipeline_json, imports=("albumentations",),
    ),
    Reader(
        "pipeline-yaml", "input.yaml", seeds.pipelines, lambda rng, data: mutate_yaml(rng, json.loads(data)),
        kpbench.synth.load_augmentation, reading.is_yaml, binary_references.pipeline_yaml, imports=("albumentations",),
    ),
    Reader(
        "png", "input.png", seeds.pngs, mutate_png,
        reading.read_images, png_chunks, binary_references.png, share=2, imports=PILLOW,
    ),
    Reader(
        "jpeg", "input.jpg", seeds.jpegs, mutate_jpeg,
        reading.read_images, jpeg_segments, binary_references.image, imports=PILLOW,
    ),
    Reader(
        "tiff", "input.tiff", seeds.tiffs, mutate_tiff,
        reading.read_images, reading.is_image, binary_references.image, imports=PILLOW,
    ),
    Reader(
        "gif", "input.gif", seeds.gifs, change_gif,
        reading.read_images, reading.is_image, binary_references.image, imports=PILLOW,
    ),
    Reader(
        "other-images", "input.webp", seeds.other_images, change_header,
        reading.read_images, reading.is_image, binary_references.image, imports=PILLOW,
    ),
    Reader(
        "avi", "input.avi", lambda: seeds.films(".avi", "MJPG"), mutate_riff,
        reading.read_images, reading.is_film, binary_references.avi,
    ),
    Reader(
        "mp4", "input.mp4", lambda: seeds.films(".mp4", "mp4v"), mutate_boxes,
        reading.read_images, reading.is_film, binary_references.mp4,
    ),
    Reader(
        "other-films", "input.mkv", seeds.matroska, change_film,
        reading.read_images, reading.is_ebml,
    ),
)  # fmt: skip
READERS = {reader.name: reader for reader in ALL_READERS}
"""Every reader of kpbench by its name."""
