"""What tests of several rooms make and call."""

import click
import numpy as np
from click.testing import CliRunner

from kpbench.cli import main
from kpbench.dataset.folder import ShardEntry, make_manifest, open_dataset, write_manifest
from kpbench.dataset.shard import Sample, encode_shard
from kpbench.files import sha256_of
from kpbench.types import KEYPOINT_DTYPE, Detections, Predictions
from kpbench.writing import write_file


def kpbench(*arguments, code=0):
    """Run a command in this process and return its result; it must end with this exit code, by no stray exception."""
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    if not isinstance(result.exception, SystemExit | None):
        raise result.exception  # for its traceback
    assert result.exit_code == code, result.output
    return result


def command(name):
    """Import the click command of this name."""
    found = main.get_command(click.Context(main), name)
    assert found, name
    return found


def digests(folder):
    """SHA-256 of each file of a folder, by name."""
    return {path.name: sha256_of(path) for path in sorted(folder.iterdir()) if path.is_file()}


def rotation(deg):
    """Matrix (2, 2) of a rotation from x towards y."""
    c, s = np.cos(np.radians(deg)), np.sin(np.radians(deg))
    return np.array([[c, -s], [s, c]])


def write_dataset(folder, images, condition="", seed=0):
    """A dataset of tiny images; each entry is a list of (x, y, radius, id)."""
    folder.mkdir()
    samples = []
    for n, rows in enumerate(images):
        keypoints = np.zeros(len(rows), KEYPOINT_DTYPE)
        for k, (x, y, radius, patch_id) in enumerate(rows):
            keypoints[k]["x"], keypoints[k]["y"], keypoints[k]["patch_id"] = x, y, patch_id
            keypoints[k]["radius_major"] = keypoints[k]["radius_minor"] = radius
            keypoints[k]["H_patch2image"] = [[radius, 0, x], [0, radius, y], [0, 0, 1]]
        rung = float(n % 2) if condition else float("nan")
        samples.append(Sample(n, np.zeros((8, 8), np.uint8), keypoints, condition=condition, rung=rung))
    config = {"seed": seed}
    path = folder / "shard-00000.h5"
    write_file(path, encode_shard(samples, len(samples), config))
    entry = ShardEntry(path.name, 0, len(samples), path.stat().st_size, sha256_of(path))
    write_manifest(folder, make_manifest(config, [entry], {"versions": {}, "broken_backgrounds": []}))
    return open_dataset(folder)


def perfect_predictions(images, **about):
    """Predictions of every keypoint of such images, with its ID and a score of 1."""
    found = [Detections([r[:2] for r in rows], [1.0] * len(rows), [r[3] for r in rows]) for rows in images]
    return Predictions.from_detections(found, **about)
