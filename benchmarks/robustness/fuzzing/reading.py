"""How kpbench reads each kind of file, all of it; and plain parsers that tell whether a container is sound."""

from __future__ import annotations

import hashlib
import io
import json
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import kpbench
import kpbench.printing

from . import references, seeds

# --- How files are read --------------------------------------------------------------------------------------------


def read_dataset(folder: Path) -> Any:
    """Read all of a dataset as commands do: verify it, then read its truth, its images and their effects."""
    dataset = kpbench.open_dataset(folder)
    list(dataset.verify())
    for n in range(min(len(dataset), 3)):
        dataset.image(n), dataset.keypoints(n), dataset.ignored(n), dataset.effects(n)
    assert dataset.truth is not None
    return dataset


@cache
def datasets() -> list[tuple[bytes, bytes]]:
    """Return manifests and shards of valid datasets, made once a process."""
    return seeds.datasets()


def read_manifest(path: Path) -> Any:
    """Read a manifest beside the shard whose digest it tells, or beside the last shard if it tells none."""
    text = path.read_bytes()
    entries = [(json.loads(manifest)["shards"][0], shard) for manifest, shard in datasets()]
    entry, shard = next((pair for pair in entries if pair[0]["sha256"].encode() in text), entries[-1])
    (path.parent / entry["file"]).write_bytes(shard)
    return read_dataset(path.parent)


def read_shard(path: Path) -> Any:
    """Read a shard with a manifest that lists this very file, as somebody who made both would write it."""
    data = path.read_bytes()
    entry = {"file": path.name, "first": 0, "count": 2, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    configs = [json.loads(manifest)["config"] for manifest, _ in datasets()]
    texts = [json.dumps(config, sort_keys=True, separators=(",", ":"), ensure_ascii=False) for config in configs]
    config, text = next((pair for pair in zip(configs, texts, strict=True) if pair[1].encode() in data), ({}, "{}"))
    mark = hashlib.sha256("\n".join([text, entry["sha256"]]).encode()).hexdigest()
    content = {"schema": "kpbench.dataset/1", "version": 1, "fingerprint": mark, "config": config, "shards": [entry]}
    content["provenance"] = {"versions": {}, "broken_backgrounds": []}
    content |= {"images": 2, "seed": config.get("seed")}
    (path.parent / "dataset.json").write_text(json.dumps(content))
    return read_dataset(path.parent)


def read_sidecar(path: Path) -> bytes:
    [written] = kpbench.printing.correct_sidecars(path.parent, references.MEASURED_MM)
    return written.read_bytes()


def read_patch(path: Path) -> Any:
    patches = kpbench.load_patches([path])
    assert patches[0].digest  # it needs the ink itself
    return patches


def read_detector(path: Path) -> Any:
    detector = kpbench.load_detector(str(path))
    detector.detect(seeds.pixels(48, 64))
    return detector


def read_checkpoint(path: Path) -> Any:
    from kpbench.training.checkpoint import load_mean_network, read_checkpoint

    content, tensors = read_checkpoint(path)
    load_mean_network(content, tensors)
    return content, tensors


def read_initial_weights(path: Path) -> Any:
    from kpbench.training import weights

    return weights.read_initial_weights(path, kpbench.shipped_patches())


def read_images(path: Path) -> Any:
    from kpbench.images import UNDECODABLE, open_images

    source = open_images(str(path))
    pixels = dict(source.images)
    # `kpbench detect` reads on, names what cannot be read, and ends with exit code 1: that is a refusal
    failures = [(name, source.problems.get(name, UNDECODABLE)) for name, image in pixels.items() if image is None]
    if failures:
        raise kpbench.KpbenchError("; ".join(source.describe_failures(failures)))
    return list(pixels.values())


# --- Plain parsers of containers -----------------------------------------------------------------------------------


def is_ebml(data: bytes) -> None:
    """Matroska and WebM."""
    assert data.startswith(b"\x1aE\xdf\xa3")


def is_hdf5(data: bytes) -> None:
    import h5py

    with h5py.File.in_memory(data) as file:
        assert len(file) >= 0


def is_csv(data: bytes) -> None:
    first, *lines = data.decode("utf-8-sig").splitlines()
    assert {"image_id", "x", "y"} <= {name.strip() for name in (lines[0] if first[:1] == "#" else first).split(",")}


def is_poses_csv(data: bytes) -> None:
    lines = data.decode("utf-8-sig").splitlines()
    assert "image_id" in lines[1]


def is_parquet(data: bytes) -> None:
    import pyarrow.parquet as pq

    pq.read_metadata(io.BytesIO(data))


def is_onnx(data: bytes) -> None:
    import onnx

    onnx.load_from_string(data)


def is_yaml(data: bytes) -> None:
    import yaml

    for _ in yaml.parse(data.decode("utf-8")):  # events, so that no alias is followed
        pass


def is_zip(data: bytes) -> None:
    import zipfile

    zipfile.ZipFile(io.BytesIO(data)).close()


def is_image(data: bytes) -> None:
    from PIL import Image

    Image.open(io.BytesIO(data)).close()


def is_film(data: bytes) -> None:
    assert (data[:4] == b"RIFF" and b"movi" in data) or (data[4:8] == b"ftyp" and b"moov" in data)


def is_toml(data: bytes) -> None:
    tomllib.loads(data.decode("utf-8"))


def is_jsonl(data: bytes) -> None:
    json.loads(data.splitlines()[0])
