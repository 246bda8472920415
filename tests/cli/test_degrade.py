from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import digests, kpbench

from kpbench.degrade.blurs import blur
from kpbench.degrade.ladder import LADDER


def test_the_degrade_command(tmp_path):
    source = tmp_path / "in"
    (source / "deep").mkdir(parents=True)
    rng = np.random.default_rng(0)
    grey = rng.integers(0, 255, (40, 50), dtype=np.uint8)
    colour = rng.integers(0, 255, (40, 50, 3), dtype=np.uint8)
    cv2.imwrite(str(source / "grey.png"), grey)
    cv2.imwrite(str(source / "deep" / "colour.png"), colour)
    (source / "broken.jpg").write_bytes(b"no image")
    done = kpbench("degrade", source, "--effect", "blur", "--level", 7, "--out", tmp_path / "out", code=1)
    assert done.stderr.splitlines() == [
        "kpbench: broken.jpg: cannot be decoded",
        f"kpbench: {tmp_path / 'out'}: lacks 1 images, which cannot be read; the others are done",
    ]
    assert len(done.stdout.splitlines()) == 2
    got = cv2.imread(str(tmp_path / "out" / "grey.png"), cv2.IMREAD_UNCHANGED)
    assert (got == blur(grey, 7)).all()
    got = cv2.imread(str(tmp_path / "out" / "deep" / "colour.png"), cv2.IMREAD_UNCHANGED)
    assert (got == blur(colour, 7)).all()
    stack = ("--effect", "noise", "--level", 20, "--effect", "jpeg", "--level", 40)
    one = kpbench("degrade", source / "grey.png", *stack, "--out", tmp_path / "one")
    kpbench("degrade", source / "grey.png", *stack, "--out", tmp_path / "two")
    assert '[{"effect": "noise", "sigma": 20.0}, {"effect": "jpeg", "quality": 40.0}]' in one.stdout
    assert digests(tmp_path / "one") == digests(tmp_path / "two")
    before = digests(source)
    for path in (source, source / "grey.png"):
        refused = kpbench("degrade", path, "--effect", "blur", "--level", 7, "--out", source, code=1)
        assert "would be overwritten" in refused.stderr
    assert digests(source) == before
    (source / "dataset.json").write_text("{}")
    refused = kpbench("degrade", source, "--effect", "blur", "--level", 7, code=1)
    assert "a dataset, expected images" in refused.stderr


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nowhere.png", "--effect", "blur", "--level", "7"], "nowhere.png: no such dataset, image, folder or video"),
        ([__file__, "--effect", "blur", "--level", "7"], "cannot be decoded as an image"),
        (
            [Path(__file__).parents[2] / "patches", "--effect", "blur", "--level", "7"],
            "neither a dataset nor a folder with images",
        ),
    ],
)
def test_what_cannot_be_degraded_is_one_line(arguments, says, here):
    told = kpbench("degrade", *arguments, code=1)
    assert says in told.stderr
    assert told.stderr.count("\n") == 1


def test_every_effect_needs_its_level():
    kpbench("degrade", "a.png", "--effect", "blur", code=2)
    kpbench("degrade", "a.png", "--effect", "blur", "--level", 3, "--level", 5, code=2)


def test_the_help_names_every_effect():
    told = " ".join(kpbench("degrade", "--help").stdout.split())
    for effect in set(LADDER) - {"dimming-literal"}:
        assert effect in told
