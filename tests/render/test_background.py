import itertools

import cv2
import numpy as np
import pytest
from PIL import Image

from kpbench.errors import DataError
from kpbench.files import image_files
from kpbench.render.background import PhotoFolder, procedural_background


def photo(width=120, height=90, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "deep" / "er").mkdir(parents=True)
    Image.fromarray(photo()).save(tmp_path / "rgb.jpg")
    Image.fromarray(photo(300, 40)).convert("CMYK").save(tmp_path / "deep" / "cmyk.jpg")
    Image.fromarray(photo()).convert("P").save(tmp_path / "deep" / "er" / "palette.PNG")
    Image.fromarray(photo()).convert("RGBA").save(tmp_path / "alpha.png")
    cv2.imwrite(str(tmp_path / "sixteen.png"), photo().astype(np.uint16) * 257)
    Image.fromarray(photo()[..., 0]).save(tmp_path / "grey.bmp")
    (tmp_path / "empty.jpg").write_bytes(b"")
    (tmp_path / "text.png").write_text("no image")
    (tmp_path / "readme.txt").write_text("not listed")
    return tmp_path


def test_every_mode_gives_the_size_asked_for(folder):
    photos = PhotoFolder.open(folder)
    assert len(photos.files) == 8
    files, broken = set(), set()
    for seed in range(60):
        for channels, shape in ((1, (48, 64)), (3, (48, 64, 3))):
            got = photos.sample(np.random.default_rng(seed), 64, 48, channels)
            assert got.image.shape == shape
            assert got.image.dtype == np.uint8
            files.add(got.file)
            broken.update(got.broken_files)
    assert len(files) == 6
    assert broken == {"empty.jpg", "text.png"}


def test_a_sample_does_not_depend_on_what_was_decoded_before(folder):
    fresh = PhotoFolder.open(folder).sample(np.random.default_rng(5), 64, 48, 1)
    used = PhotoFolder.open(folder)
    for seed in range(20):
        used.sample(np.random.default_rng(seed), 64, 48, 3)
    again = used.sample(np.random.default_rng(5), 64, 48, 1)
    assert (fresh.image == again.image).all()
    assert fresh.file == again.file


def test_the_cache_is_bounded_and_changes_nothing(folder, monkeypatch):
    monkeypatch.setattr("kpbench.render.background.CACHE_BYTES", 20_000)
    photos = PhotoFolder.open(folder)
    for seed in range(30):
        photos.sample(np.random.default_rng(seed), 64, 48, 3)
        held = sum(image.nbytes for image in photos._cache.values() if image is not None)
        assert held == photos._cached_bytes
        assert held <= 20_000 or len(photos._cache) == 1


def test_colour_is_rgb(tmp_path):
    red = np.zeros((64, 64, 3), np.uint8)
    red[..., 0] = 255
    Image.fromarray(red).save(tmp_path / "red.png")
    got = PhotoFolder.open(tmp_path).sample(np.random.default_rng(0), 64, 64, 3)
    assert got.image[10, 10].tolist() == [255, 0, 0]


@pytest.mark.parametrize("what", ["missing", "empty", "broken"])
def test_a_folder_without_photographs_is_one_line(tmp_path, what):
    folder = tmp_path / "photos"
    if what != "missing":
        folder.mkdir()
    if what == "broken":
        for n in range(3):
            (folder / f"{n}.jpg").write_bytes(b"\xff\xd8 not a jpeg")
    with pytest.raises(DataError) as caught:
        PhotoFolder.open(folder)
    expected = {"missing": "no such folder", "empty": "no background images", "broken": "none of its 3 image files"}
    assert str(caught.value).startswith(f"{folder}: {expected[what]}")


def test_a_changed_folder_has_another_digest(folder):
    before = PhotoFolder.open(folder).digest
    Image.fromarray(photo(50, 50)).save(folder / "more.png")
    assert PhotoFolder.open(folder).digest != before


def test_procedural_backgrounds_have_a_natural_spectrum():
    """Amplitude falls about as 1/f, as that of photographs does, not flat as that of plain noise."""
    slopes = []
    for seed in range(4):
        image = procedural_background(np.random.default_rng(seed), 256, 256).astype(float)
        window = np.hanning(256)[:, None] * np.hanning(256)
        power = np.abs(np.fft.fft2((image - image.mean()) * window)) ** 2
        frequency = np.hypot(np.fft.fftfreq(256)[:, None], np.fft.fftfreq(256))
        bands = np.geomspace(4 / 256, 0.25, 8)
        mean = [power[(frequency >= a) & (frequency < b)].mean() for a, b in itertools.pairwise(bands)]
        slopes.append(np.polyfit(np.log(bands[:-1]), np.log(mean), 1)[0] / 2)
    assert -1.6 < np.mean(slopes) < -0.7


def test_procedural_backgrounds_differ_and_repeat():
    one, same, other = (procedural_background(np.random.default_rng(seed), 96, 64, 3) for seed in (1, 1, 2))
    assert one.shape == (64, 96, 3)
    assert (one == same).all()
    assert (one != other).mean() > 0.5


def test_a_folder_or_a_dead_link_named_like_an_image_is_none(folder):
    (folder / "dir.png").mkdir()
    (folder / "dead.jpg").symlink_to(folder / "gone.jpg")
    assert not {"dir.png", "dead.jpg"} & set(image_files(folder))
