"""Pictures of more than 8 bits, transparent ones and rotated ones are read by one rule, and changes are said."""

import io
import json
import struct
import warnings
import zlib

import cv2
import numpy as np
import pytest
from helpers import kpbench
from PIL import Image

from kpbench.detectors.interface import load_detector
from kpbench.detectors.prediction import predict_images
from kpbench.images import ImageSource, decode_photo, open_images
from kpbench.patches import shipped_patches
from kpbench.pixels import bits_used, decode_pixels
from kpbench.predictions.coco import CocoDataset

RNG = np.random.default_rng(1)
GREY = RNG.integers(0, 256, (24, 32)).astype(np.uint8)
GREY[0, :2] = 0, 255


def read(path):
    """The one picture at a path, and the warnings."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        [(_, image)] = open_images(str(path)).images
    return image, [str(warning.message) for warning in said]


def scaled(bits):
    """GREY as samples of so many bits, in 16-bit words."""
    return GREY.astype(np.uint16) << (bits - 8) | GREY >> (16 - bits)


@pytest.mark.parametrize("bits", [10, 12, 14])
@pytest.mark.parametrize("suffix", [".png", ".tif", ".pgm", ".ppm"])
def test_a_picture_of_fewer_bits_than_16_is_read_as_its_8_bit_version(tmp_path, suffix, bits):
    samples = scaled(bits) if suffix != ".ppm" else np.dstack([scaled(bits)] * 3)
    cv2.imwrite(str(tmp_path / f"deep{suffix}"), samples)
    image, said = read(tmp_path / f"deep{suffix}")
    assert (image == GREY[..., None]).all()
    [line] = said
    assert line == (
        f"{tmp_path / f'deep{suffix}'}: is of 16 bits, of which its largest pixel needs {bits}; these are scaled to 8"
    )


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_picture_of_16_bits_and_one_of_8_are_read_as_before(tmp_path, suffix, channels):
    for samples in (GREY, GREY.astype(np.uint16) << 8 | GREY):
        cv2.imwrite(str(tmp_path / f"a{suffix}"), samples if channels == 1 else np.dstack([samples] * 3))
        image, said = read(tmp_path / f"a{suffix}")
        assert (image == GREY[..., None]).all()
        assert not said


def with_sbit(data, bits):
    """A grey PNG with a chunk that states how many bits its samples use."""
    chunk = b"sBIT" + bytes([bits])
    return data[:33] + struct.pack(">I", 1) + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[33:]


def test_a_png_that_states_its_bits_is_believed_in_silence(tmp_path):
    dark = cv2.imencode(".png", scaled(12) >> 4)[1].tobytes()
    (tmp_path / "a.png").write_bytes(with_sbit(dark, 12))
    image, said = read(tmp_path / "a.png")
    assert (image[..., 0] == GREY >> 4).all()
    assert not said
    (tmp_path / "a.png").write_bytes(with_sbit(cv2.imencode(".png", scaled(16))[1].tobytes(), 12))
    assert (read(tmp_path / "a.png")[0][..., 0] == GREY).all()


def test_a_tiff_that_states_its_largest_sample_is_believed_in_silence(tmp_path):
    Image.fromarray(scaled(12) >> 4).save(tmp_path / "a.tif", tiffinfo={281: 4095})
    image, said = read(tmp_path / "a.tif")
    assert (image[..., 0] == GREY >> 4).all()
    assert not said


def test_the_smallest_depth_that_holds_the_largest_pixel():
    depths = {0: 8, 255: 8, 256: 10, 1023: 10, 1024: 12, 4096: 14, 16384: 16, 65535: 16}
    assert {largest: bits_used(largest) for largest in depths} == depths


@pytest.mark.parametrize(
    ("name", "options"), [("a.png", {}), ("a.webp", {"lossless": True, "exact": True}), ("a.tif", {})]
)
def test_a_transparent_picture_is_laid_on_white(tmp_path, name, options):
    opacity = np.repeat([[255], [0], [51]], 8, 0).repeat(32, 1).astype(np.uint8)
    Image.fromarray(np.dstack([GREY, GREY, GREY, opacity])).save(tmp_path / name, **options)
    image, said = read(tmp_path / name)
    expected = np.rint(255 - (255.0 - GREY) * opacity / 255)
    assert np.abs(image[..., 0] - expected).max() <= 1
    assert said == [f"{tmp_path / name}: is transparent, and is laid on white"]


def test_transparency_of_every_kind_of_png(tmp_path):
    grey_alpha = Image.merge(
        "LA", [Image.fromarray(GREY), Image.fromarray(np.where(GREY > 99, 255, 0).astype(np.uint8))]
    )
    grey_alpha.save(tmp_path / "la.png")
    assert (read(tmp_path / "la.png")[0][..., 0] == np.where(GREY > 99, GREY, 255)).all()
    palette = Image.fromarray(GREY // 64 * 64).convert("P", palette=Image.Palette.ADAPTIVE, colors=4)
    palette.save(tmp_path / "p.png", transparency=palette.getpixel((0, 0)))
    assert (read(tmp_path / "p.png")[0][GREY < 64] == 255).all()
    deep = np.dstack([scaled(16)] * 3 + [np.where(GREY > 99, 65535, 0).astype(np.uint16)])
    cv2.imwrite(str(tmp_path / "deep.png"), deep)
    assert (read(tmp_path / "deep.png")[0][..., 0] == np.where(GREY > 99, GREY, 255)).all()


@pytest.mark.parametrize("name", ["a.png", "a.webp", "a.bmp"])
def test_an_opaque_picture_with_a_fourth_channel_is_read_as_before(tmp_path, name):
    opacity = 0 if name.endswith("bmp") else 255  # 32-bit BMP files hold 0 there, and are not transparent
    data = cv2.imencode(f".{name[2:]}", np.dstack([GREY] * 3 + [np.full_like(GREY, opacity)]))[1]
    (tmp_path / name).write_bytes(data.tobytes())
    image, said = read(tmp_path / name)
    assert (image == cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1]).all()
    assert image.min() < 5
    assert not said


def test_a_folder_says_each_kind_once(here):
    for n in range(3):
        cv2.imwrite(f"deep-{n}.png", scaled(10))
        cv2.imwrite(f"clear-{n}.png", np.dstack([GREY] * 3 + [GREY]))
    lines = kpbench("detect", here, "--detector", "orb").stderr.splitlines()
    assert [line.split(": ")[1] for line in lines if ".png" in line] == [f"{here}/clear-0.png", f"{here}/deep-0.png"]


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", ["JPEG", "PNG", "clear PNG"])
def test_exif_rotates_what_is_detected_on_and_no_background(tmp_path, orientation, kind):
    exif = Image.Exif()
    exif[0x0112] = orientation
    smooth = cv2.resize(GREY[:3, :4], (40, 30), interpolation=cv2.INTER_LINEAR)
    opaque = Image.fromarray(np.dstack([smooth] * 3))
    stream = io.BytesIO()
    opaque.save(stream, "PNG", exif=exif)
    expected = cv2.imdecode(np.frombuffer(stream.getvalue(), np.uint8), cv2.IMREAD_COLOR)
    if kind == "clear PNG":
        opaque.putalpha(Image.fromarray(np.where(smooth > 0, 255, 254).astype(np.uint8)))
    opaque.save(tmp_path / "a", kind.split()[-1], exif=exif)
    path = (tmp_path / "a").rename(tmp_path / f"a.{kind[-4:].lower().strip()}")
    image, _ = read(path)
    assert image.shape == expected.shape == ((40, 30, 3) if orientation > 4 else (30, 40, 3))
    assert np.abs(image.astype(int) - expected).max() <= (0 if kind == "PNG" else 40)
    assert CocoDataset(tmp_path / "t.json", None, (path.name,)).image(0).shape == expected.shape
    assert decode_photo(path, 1).shape == (30, 40)


def test_backgrounds_follow_the_same_rule_in_silence(tmp_path):
    cv2.imwrite(str(tmp_path / "deep.png"), scaled(10))
    assert (decode_photo(tmp_path / "deep.png", 1) == GREY).all()
    cv2.imwrite(str(tmp_path / "clear.png"), np.dstack([GREY] * 3 + [np.zeros_like(GREY)]))
    assert (decode_photo(tmp_path / "clear.png", 3) == 255).all()


@pytest.mark.parametrize(
    "data", [b"", b"\x89PNG\r\n\x1a\n", b"II*\0", b"MM\0*\0\0", b"GIF89a", b"RIFF....WEBPVP8X", b"P5\n"]
)
def test_no_picture_is_none(data):
    assert decode_pixels(np.frombuffer(data, np.uint8), 3, True) is None


# --- Inverted prints -----------------------------------------------------------------------------------------------


def printed(here, *options):
    """The printed page and the sidecar of the four shipped designs."""
    kpbench("render-patches", "--png", "--dpi", "150", "--no-labels", "--out", "print", *options)
    return cv2.imread("print/patches.png", cv2.IMREAD_GRAYSCALE), json.loads((here / "print/patches.json").read_text())


@pytest.mark.parametrize(
    "more", [[], ["--mirror"], ["--board", "grid"], ["--board", "hexagon", "--patch", "wheel"]], ids=str
)
def test_invert_swaps_black_and_white_within_the_patches_alone(here, more):
    pages = {}
    for options in ([], ["--invert"]):
        kpbench("render-patches", "--png", "--dpi", "100", "--out", "print", *more, *options)
        [name] = (here / "print").glob("*.json")
        pages[bool(options)] = cv2.imread(str(name.with_suffix(".png")), 0).astype(int), json.loads(name.read_text())
    (plain, sidecar), (inverted, other) = pages[False], pages[True]
    assert (sidecar.pop("inverted"), other.pop("inverted")) == (False, True)
    assert sidecar == other
    y, x = np.mgrid[: plain.shape[0], : plain.shape[1]]
    per_mm = sidecar["png"]["px_per_mm"]
    inside, outside = np.zeros(plain.shape, bool), np.ones(plain.shape, bool)
    for k in sidecar["keypoints"]:
        distance = np.hypot(x + 0.5 - k["page_x_mm"] * per_mm, y + 0.5 - k["page_y_mm"] * per_mm)
        inside |= distance < k["diameter_mm"] / 2 * per_mm - 2
        outside &= distance > k["diameter_mm"] / 2 * per_mm + 2
    assert inside.sum() > 1000
    assert np.abs(plain + inverted - 255)[inside].max() <= 3
    assert (plain == inverted)[outside].all()


def test_an_inverted_print_of_the_four_designs_is_another_valid_print(here):
    """So no detector can tell: checker and trefoil are their own inverses, turned; wheel and mushroom each other's."""
    names = {}
    for options in ([], ["--invert"]):
        page, sidecar = printed(here, *options)
        found = load_detector("template")(cv2.resize(page, None, fx=0.3, fy=0.3, interpolation=cv2.INTER_AREA))
        per_mm = 0.3 * sidecar["png"]["px_per_mm"]
        for k in sidecar["keypoints"]:
            nearest = np.hypot(*(found.xy + 0.5 - np.array([k["page_x_mm"], k["page_y_mm"]]) * per_mm).T).argmin()
            names.setdefault(k["patch_id"], []).append(int(found.patch_id[nearest]))
            assert found.score[nearest] > 0.9
    assert names == {0: [0, 0], 1: [1, 1], 2: [2, 3], 3: [3, 2]}


@pytest.mark.parametrize(
    ("names", "told"),
    [(["checker", "trefoil", "wheel"], "wheel"), (["mushroom"], "mushroom"), (["wheel", "mushroom"], "")],
)
def test_an_inverted_print_is_told_where_its_inverse_is_no_design(here, names, told):
    designs = tuple(patch for patch in shipped_patches() if patch.name in names)
    detector = load_detector("template", patches=designs)
    said = {}
    for options in ((), ("--invert",)):
        page, _ = printed(here, *(word for name in names for word in ("--patch", name)), *options)
        small = cv2.resize(page, None, fx=0.3, fy=0.3, interpolation=cv2.INTER_AREA)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            predict_images(ImageSource(iter([("page.png", small), ("again.png", small)]), 2), detector)
        said[bool(options)] = [str(warning.message) for warning in caught]
    told_of = f"page.png: the print is inverted: {told} shows black and white swapped"
    assert said[False] == []
    assert [line.partition(";")[0] for line in said[True]] == ([told_of] if told else [])
