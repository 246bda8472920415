"""Valid files of every kind that kpbench reads, small, and the same on every run."""

from __future__ import annotations

import io
import json
import re
import tempfile
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import kpbench

ROOT = Path(__file__).resolve().parents[3]


@contextmanager
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def as_json(tree: Any) -> bytes:
    return json.dumps(tree).encode()


# --- Predictions ---------------------------------------------------------------------------------------------------


def predictions(ids: bool = True, images: int = 5) -> kpbench.Predictions:
    rng = np.random.default_rng(1)
    counts = [2, 0, 3, 1, 1, *[4] * (images - 5)]
    found = [
        kpbench.Detections(rng.uniform(0, 640, (n, 2)), rng.uniform(0, 1, n), rng.integers(0, 4, n) if ids else None)
        for n in counts
    ]
    about = {"name": "a detector", "version": "1.0", "more": {"k": [1, 2.5, None, True]}}
    image_id = np.arange(images) * 3 + 1
    return kpbench.Predictions.from_detections(found, image_id, about, "kpbench-data", "0" * 64)


def full_predictions() -> kpbench.Predictions:
    """Predictions with every optional column."""
    rows, images = 7, 5
    return replace(
        predictions(),
        A_patch2image=np.tile([[10.0, 1.5], [-1.5, 9.0]], (rows, 1, 1)),
        covariance=np.tile([[0.01, 0.002], [0.002, 0.02]], (rows, 1, 1)),
        blur_px=np.linspace(0, 2, rows),
        file=tuple(f"folder/{n}.png" for n in range(images)),
        size=np.tile([640, 480], (images, 1)),
        frame_index=np.arange(images),
        time_s=np.arange(images) / 25,
        ms=np.linspace(1, 9, images),
    )


def predictions_files(suffix: str) -> list[bytes]:
    with folder() as where:
        path = where / f"p{suffix}"
        files = []
        for content in (predictions(), predictions(ids=False), predictions(images=12), full_predictions()):
            kpbench.write_predictions(path, content)
            files.append(path.read_bytes())
    return files


def predictions_json() -> list[bytes]:
    record = [{"image_id": n, "keypoints": [[n, 2.5]] * n} for n in range(3)]
    head = {"schema": "kpbench.predictions/1"}
    return [
        *predictions_files(".json"),
        as_json(head | {"predictions": record}),
        as_json({"predictions": record} | head),
    ]


def coco_results() -> list[bytes]:
    p = predictions()
    image = np.repeat(p.image_id, np.diff(p.offsets)).tolist()
    found = zip(image, p.xy.tolist(), p.score.tolist(), p.patch_id.tolist(), strict=True)  # type: ignore[union-attr]
    entries = [{"image_id": i, "category_id": k + 1, "keypoints": [*xy, 2], "score": s} for i, xy, s, k in found]
    return [as_json(entries), as_json([entry | {"bbox": [0, 0, 1, 1], "id": 5} for entry in entries])]


def coco() -> list[bytes]:
    images = [{"id": n, "file_name": f"{n}.png", "width": 64, "height": 48} for n in range(4)]
    told = [image | {"condition": "blur", "rung": 3 * (n % 2), "scene_id": n // 2} for n, image in enumerate(images)]
    points = [
        {"id": n, "image_id": n % 4, "category_id": n % 4 + 1, "keypoints": [5.5 + n, 7.25, 2], "num_keypoints": 1}
        for n in range(7)
    ]
    plain = [point | {"radius": 6.5 + n} for n, point in enumerate(points)]
    extra = {"radius_major": 8.0, "radius_minor": 6.5, "axis_angle": 30.0, "visible": 0.5, "bbox": [0, 0, 9, 9]}
    info = {"description": "kpbench dataset", "fingerprint": "1" * 64}
    return [
        as_json({"images": images, "annotations": plain}),
        as_json({"info": info, "images": told, "annotations": [point | extra for point in points], "categories": []}),
    ]


# --- Datasets ------------------------------------------------------------------------------------------------------


class Photographs:
    """Two labelled photographs, each with a keypoint and an ignored patch."""

    n, shard_size, image_bytes, most_keypoints = 2, 2, 4000, 2

    def to_dict(self) -> dict[str, Any]:
        """Return the configuration."""
        patches = [patch.to_dict() for patch in kpbench.shipped_patches()]
        return {"kind": "photographs", "source": "photographs", "n": 2, "shard_size": 2, "patches": patches}

    def scene_id(self, index: int) -> int:
        """Return the scene of an image."""
        return index

    def make(self, index: int) -> tuple[Any, tuple[str, ...]]:
        """Make an image."""
        keypoints = np.zeros(2, kpbench.LABELLED_KEYPOINT_DTYPE)
        keypoints["x"], keypoints["y"], keypoints["sigma_x"] = (20, 50), (30, 10), (0.01, np.inf)
        keypoints["sigma_y"], keypoints["radius_major"], keypoints["radius_minor"] = keypoints["sigma_x"], 9, 8
        keypoints["H_patch2image"] = np.eye(3)
        return kpbench.dataset.Sample(index, pixels(64, 64)[..., 0], keypoints, condition="free"), ()


def poses(suffix: str) -> list[bytes]:
    """Files of poses: none, one, and one with a second solution and a filtered pose."""
    from kpbench.boards import BoardPose, PoseRecord, write_poses

    turned = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    pose = BoardPose(turned, np.array([1.5, -2, 300]), 0.01 * np.eye(6), 0.2, 6)
    unsure = replace(pose, second=replace(pose, rotation=np.eye(3)), ambiguous=True)
    records = [
        PoseRecord(0, "a.png", None, None, "grid", None, "the board was not found"),
        PoseRecord(1, "b.png", 3, 0.12, "grid", pose, ""),
        PoseRecord(2, "c.png", 4, 0.16, "grid", unsure, "", "tracked", pose),
    ]
    files = []
    with folder() as where:
        for some in (records, records[1:]):
            write_poses(where / f"p{suffix}", some)
            files.append((where / f"p{suffix}").read_bytes())
    return files


def marked_boards() -> list[bytes]:
    """Sidecars of boards with reference marks, and of a field."""
    files = []
    with folder() as where:
        for board in (
            kpbench.truth_board(kpbench.shipped_patches()),
            kpbench.with_reference(kpbench.hexagon_board(kpbench.shipped_patches()[1], 100.0)),
        ):
            kpbench.print_boards([board], where, formats=["svg"])
            files.append((where / f"{board.name}.json").read_bytes())
    return files


def datasets() -> list[tuple[bytes, bytes]]:
    """Manifest and shard of datasets with one shard."""
    made = []
    suite = kpbench.load_suite("paper-v1")
    blur = replace(suite.conditions[2], rungs=(3.0, 7.0), effects=(("blur", (3.0, 7.0)),))
    suite = replace(suite, size_px=(96, 64), patches=suite.patches[:1], conditions=(blur,))
    configs = (
        kpbench.SynthConfig(2, size_px=(64, 64)),
        kpbench.SynthConfig(2, size_px=(64, 64), channels=3),
        kpbench.SuiteConfig(suite, images=1),
        Photographs(),
    )
    for config in configs:
        with folder() as where:
            kpbench.generate(config, where / "set", workers=1)
            made.append(
                ((where / "set" / "dataset.json").read_bytes(), (where / "set" / "shard-00000.h5").read_bytes())
            )
    return made


def shards() -> list[bytes]:
    return [shard for _, shard in datasets()]


def manifests() -> list[bytes]:
    return [manifest for manifest, _ in datasets()]


def sidecars() -> list[bytes]:
    import click.testing

    from kpbench.cli import main

    files = []
    with folder() as where:
        for n, words in enumerate((["--board", "hexagon"], ["--board", "grid", "--tile", "--page", "100x150mm"], [])):
            out = where / str(n)
            done = click.testing.CliRunner().invoke(main, ["render-patches", "--svg", "--out", str(out), *words])
            assert done.exit_code == 0, done.output
            files += [path.read_bytes() for path in sorted(out.glob("*.json"))]
    return [file for file in files if json.loads(file)["ruler_mm"] == [100.0, 100.0]]


# --- TOML ----------------------------------------------------------------------------------------------------------


def toml_files(pattern: str, shorten: Callable[[dict[str, Any]], Any] = lambda tree: None) -> list[bytes]:
    """TOML files of this repository, as trees in JSON."""
    trees = [tomllib.loads(path.read_text()) for path in sorted(ROOT.glob(pattern))]
    for tree in trees:
        shorten(tree)
    return [as_json(tree) for tree in trees]


def patches() -> list[bytes]:
    with_rim = {"rim": {"width": 0.2, "ink": "black"}, "quiet_zone": 0.1, "schema": "kpbench.patch/1"}
    trees = [json.loads(tree) for tree in toml_files("patches/*.toml")]
    return [as_json(tree) for tree in (*trees, trees[0] | with_rim)]


def scores() -> list[bytes]:
    """Scores files of a suite, with the parts that the verification of a submission reads."""
    config = {"suite": "paper-v1", "images": 1, "seed": 0, "size_px": [203, 155], "conditions": [], "backgrounds": {}}
    provenance = {"config": config, "predictions": [{"file": "a.json", "sha256": "0" * 64}]}
    about = {"detector": {"name": "orb", "version": "1"}, "dataset": {"fingerprint": "0" * 64, "images": 1}}
    return [as_json({"schema": "kpbench.scores/1", **about, "metrics": {}, "by": [], "provenance": provenance})]


def boards() -> list[bytes]:
    grid = {
        "name": "grid",
        "diameter_mm": 20,
        "grid": {"rows": 2, "columns": 3, "pitch_mm": 40.0, "patches": [0, 1, 2]},
    }
    points = [{"patch": k, "x_mm": 40.0 * k, "y_mm": -10.5} for k in range(3)]
    points.append({"patch": "wheel", "x_mm": 0, "y_mm": 60, "rotate_deg": 45.0, "diameter_mm": 25})
    return [
        as_json(grid),
        as_json({"schema": "kpbench.boardfile/1", "keypoint": points, "size_mm": [300, 250]} | _schema()),
    ]


def _schema() -> dict[str, str]:
    """The name of the schema of boards, as an error message tells it."""
    with folder() as where:
        path = where / "board.toml"
        path.write_text('schema = "?"\n')
        try:
            kpbench.load_board(path)
        except kpbench.KpbenchError as error:
            return {"schema": str(error).rsplit("'", 2)[1]}
    raise AssertionError("a board of an unknown schema was read")


def suites() -> list[bytes]:
    def shorten(tree: dict[str, Any]) -> None:
        tree["condition"] = tree["condition"][:4]

    return toml_files("benchmarks/suites/*.toml", shorten)


def recipes() -> list[bytes]:
    return toml_files("configs/*.toml")


def cameras() -> list[bytes]:
    return toml_files("cameras/*.toml")


def calibrations() -> list[bytes]:
    """Calibration files in the three formats, as trees in JSON."""
    import yaml

    from kpbench.geometry import Camera, write_camera

    plain = Camera(640, 480, 500.0, (-0.2, 0.05, 0.001, 0.0), focal_y_px=501.0, principal_px=(320.5, 239.0))
    fisheye = Camera(640, 480, 300.0, (0.1, 0.0, 0.0, 0.0), model="fisheye")
    trees = []
    with folder() as where:
        for camera in (plain, fisheye):
            write_camera(where / "camera.json", camera)
            trees.append((where / "camera.json").read_bytes())
            for form in ("ros", "kalibr"):
                write_camera(where / f"{form}.yaml", camera, form)  # type: ignore[arg-type]
                trees.append(as_json(yaml.safe_load((where / f"{form}.yaml").read_text())))
    return trees


# --- Networks ------------------------------------------------------------------------------------------------------

TINY = """
name = "tiny"
batch = 2
[network]
widths = [2, 2, 2, 2]
depths = [1, 1, 1, 1]
head_width = 2
descriptor_width = 2
[samples]
kind = "crops"
size = [32, 32]
[[phases]]
samples = 2
"""


def checkpoints() -> list[bytes]:
    import torch

    from kpbench.training import load_recipe, start_state
    from kpbench.training.checkpoint import save_checkpoint

    with folder() as where:
        (where / "tiny.toml").write_text(TINY)
        state = start_state(load_recipe(where / "tiny.toml"), torch.device("cpu"))
        save_checkpoint(state, where / "c", kpbench.shipped_patches())
        return [(where / "c").read_bytes()]


def state_dicts() -> list[bytes]:
    """The published form of weights: a zip archive with a pickle and the tensors."""
    import torch
    from safetensors.torch import load

    given = load(checkpoints()[0])
    tensors = {key.removeprefix("mean."): given[key] for key in sorted(given) if key.startswith("mean.")}
    stream = io.BytesIO()
    torch.save(tensors, stream)
    return [stream.getvalue()]


def onnx_models() -> list[bytes]:
    import click.testing

    from kpbench.cli import main

    with folder() as where:
        (where / "c.safetensors").write_bytes(checkpoints()[0])
        words = ["export-model", str(where / "c.safetensors"), "--out", str(where / "tiny.onnx")]
        done = click.testing.CliRunner().invoke(main, words)
        assert done.exit_code == 0, done.output
        return [(where / "tiny.onnx").read_bytes()]


def pipelines() -> list[bytes]:
    import albumentations as A

    chosen = (
        [A.GaussianBlur(p=0.5), A.RandomBrightnessContrast(p=1.0)],
        [A.OneOf([A.MotionBlur(blur_limit=7, p=1.0), A.GaussNoise(p=1.0)], p=0.7), A.Affine(scale=(0.9, 1.1), p=0.5)],
        [A.ImageCompression(quality_range=(40, 90), p=1.0), A.RandomShadow(p=0.3), A.Perspective(p=0.2)],
    )
    return [as_json(A.to_dict(A.Compose(transforms))) for transforms in chosen]


# --- Images and films ----------------------------------------------------------------------------------------------


def pixels(height: int = 24, width: int = 32) -> Any:
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 255 // width, y * 255 // height, (x * y) % 256], axis=-1).astype(np.uint8)


def images(kind: str, modes: tuple[str, ...], **options: Any) -> list[bytes]:
    """Images that Pillow writes in each of the modes."""
    from PIL import Image

    files = []
    for mode in modes:
        image = Image.fromarray(pixels()).convert("L" if mode == "I;16" else mode)
        if mode == "I;16":
            image = Image.fromarray(pixels()[..., 0].astype(np.uint16) * 257)
        stream = io.BytesIO()
        image.save(stream, kind, **options)
        files.append(stream.getvalue())
    return files


def pngs() -> list[bytes]:
    animated = images("PNG", ("RGB",), save_all=True, append_images=_more())
    return images("PNG", ("L", "RGB", "RGBA", "P", "1", "LA", "I;16")) + animated


def jpegs() -> list[bytes]:
    return [*images("JPEG", ("L", "RGB", "CMYK")), *images("JPEG", ("RGB",), progressive=True, quality=90)]


def tiffs() -> list[bytes]:
    packed = [
        file
        for how in ("tiff_lzw", "tiff_adobe_deflate", "packbits")
        for file in images("TIFF", ("RGB",), compression=how)
    ]
    return (
        images("TIFF", ("L", "RGB", "RGBA", "1", "P", "I;16"))
        + packed
        + images("TIFF", ("L",), save_all=True, append_images=_more())
    )


def gifs() -> list[bytes]:
    return images("GIF", ("P", "L")) + images("GIF", ("P",), save_all=True, append_images=_more())


def _more() -> list[Any]:
    from PIL import Image

    return [Image.fromarray(pixels()[::-1].copy())]


def other_images() -> list[bytes]:
    import cv2

    kept = [image for kind in ("BMP", "WEBP", "PPM") for image in images(kind, ("RGB", "L"))]
    return [*kept, *(cv2.imencode(suffix, pixels(64, 64))[1].tobytes() for suffix in (".jp2", ".webp", ".bmp"))]


def films(suffix: str, code: str) -> list[bytes]:
    """Films of five frames."""
    import cv2

    files = []
    for size in ((32, 24), (64, 48)):
        with folder() as where:
            path = where / f"film{suffix}"
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), 25.0, size)
            for n in range(5):
                writer.write(np.roll(pixels(size[1], size[0]), 3 * n, axis=1))
            writer.release()
            files.append(path.read_bytes())
    return files


def matroska() -> list[bytes]:
    """Films whose random numbers (of the file and the track) are 1 and whose checksums over them are left out."""
    files = films(".mkv", "FFV1") + films(".mkv", "VP80")
    for name, length in ((b"\x73\xa4", 16), (b"\x73\xc5", 8), (b"\x63\xc5", 8)):
        head = name + bytes([0x80 | length])
        files = [
            re.sub(re.escape(head) + b".{%d}" % length, head + b"1" * length, file, flags=re.DOTALL) for file in files
        ]
    return [re.sub(rb"\xbf\x84.{4}", b"\xec\x84" + bytes(4), file, flags=re.DOTALL) for file in files]
