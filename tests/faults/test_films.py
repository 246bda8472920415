"""Films: what can be read is read, in its true place; frames that cannot be read are named, and the exit code is 1."""

import io
import json
import re

import cv2
import numpy as np
import pytest
from helpers import kpbench
from PIL import Image

from kpbench.errors import KpbenchWarning
from kpbench.films import name_frames
from kpbench.images import open_images

FRAMES = 12
CODECS = [(".avi", "MJPG"), (".mp4", "mp4v"), (".mkv", "FFV1"), (".mov", "MJPG")]


def picture(n):
    """A frame that tells its number by its grey."""
    return np.full((48, 64, 3), 20 * n + 10, np.uint8)


def number_of(frame):
    return None if frame is None else round((float(frame.mean()) - 10) / 20)


def write_film(path, code, frames=FRAMES):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), 10.0, (64, 48))
    for n in range(frames):
        writer.write(picture(n))
    writer.release()
    return path


def numbers(path):
    """The number that each frame shows, None for a frame that cannot be read."""
    return [number_of(frame) for _, frame in open_images(str(path)).images]


def spoil_jpegs(path, bad):
    """Overwrite the JPEG data of some frames of a Motion JPEG film."""
    data = bytearray(path.read_bytes())
    starts = [found.start() for found in re.finditer(rb"\xff\xd8\xff", data)]
    assert len(starts) == FRAMES
    for n in bad:
        stop = starts[n + 1] - 8 if n + 1 < FRAMES else starts[n] + 200
        data[starts[n] : stop] = bytes(stop - starts[n])
    path.write_bytes(data)


@pytest.mark.parametrize(("suffix", "code"), CODECS)
def test_a_sound_film_has_all_its_frames(tmp_path, suffix, code):
    assert numbers(write_film(tmp_path / f"film{suffix}", code)) == list(range(FRAMES))


@pytest.mark.parametrize(
    "bad", [[5], [0], [11], [4, 5, 6], [0, 3, 7, 8, 11], list(range(3, 12)), list(range(9))], ids=str
)
@pytest.mark.parametrize("suffix", [".avi", ".mov"])
def test_reading_goes_on_after_bad_frames(tmp_path, suffix, bad):
    film = write_film(tmp_path / f"film{suffix}", "MJPG")
    spoil_jpegs(film, bad)
    assert numbers(film) == [None if n in bad else n for n in range(FRAMES)]


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_a_film_that_is_cut_off_lacks_the_frames_of_its_end(tmp_path, share):
    film = write_film(tmp_path / "film.avi", "MJPG")
    data = film.read_bytes()
    first = data.find(b"\xff\xd8\xff")
    film.write_bytes(data[: first + int(share * (data.find(b"idx1") - first))])
    found = numbers(film)
    whole = [n for n in found if n is not None]
    assert whole == list(range(len(whole)))
    assert 0 < len(whole) < FRAMES
    assert found == whole + [None] * (FRAMES - len(whole))


def test_detect_writes_what_it_read_and_names_the_rest(here):
    film = write_film(here / "film.avi", "MJPG")
    spoil_jpegs(film, [3, 4, 5, 9])
    done = kpbench("detect", film, "--detector", "orb", "--overlay", "drawn.mp4", code=1)
    assert f"kpbench: {film}: frames 3 to 5 and 9 of 12 cannot be read" in done.stderr.splitlines()
    assert [image["image_id"] for image in json.loads((here / "preds.json").read_text())["predictions"]] == list(
        range(12)
    )
    drawn = numbers(here / "drawn.mp4")  # bad frames are black, so that later frames keep their places
    assert [n for n in range(12) if drawn[n] != n] == [3, 4, 5, 9]
    kpbench("detect", film, "--detector", "orb", "--overlay", "drawn", code=1)
    assert len(list((here / "drawn").iterdir())) == 8


def test_degrade_writes_what_it_read_and_names_the_rest(here):
    film = write_film(here / "film.avi", "MJPG")
    spoil_jpegs(film, [2])
    done = kpbench("degrade", film, "--effect", "blur", "--level", 3, "--out", "out", code=1)
    assert f"{film}: frame 2 of 12 cannot be read" in done.stderr
    assert "00000002.png" not in {path.name for path in (here / "out").iterdir()}
    assert number_of(cv2.imread("out/00000011.png")) == 11


def test_a_number_of_frames_that_the_file_cannot_hold_is_said(tmp_path):
    film = write_film(tmp_path / "film.avi", "MJPG")
    data = bytearray(film.read_bytes())
    for name, offset in ((b"avih", 24), (b"strh", 40)):
        at = data.find(name) + offset
        data[at : at + 4] = (2**30).to_bytes(4, "little")
    film.write_bytes(data)
    with pytest.warns(KpbenchWarning, match=r"film\.avi: states \d+ frames, more than it can hold"):
        assert numbers(film) == list(range(FRAMES))


# --- Animated images -----------------------------------------------------------------------------------------------


def animate(path, **options):
    first, *more = [Image.fromarray(picture(n)) for n in range(5)]
    first.save(path, save_all=True, append_images=more, duration=100, **options)
    return path


@pytest.mark.parametrize("name", ["film.gif", "film.png", "film.webp"])
def test_an_animated_image_is_a_film(here, name):
    path = animate(here / name, **({"lossless": True} if name.endswith("webp") else {}))
    source = open_images(str(path))
    assert (source.length, source.fps, source.film) == (5, 10.0, str(path))
    assert numbers(path) == list(range(5))
    done = kpbench("detect", path, "--detector", "orb", "--overlay", "drawn")
    assert "in 5 images" in done.stdout
    assert len(list((here / "drawn").iterdir())) == 5


@pytest.mark.parametrize("name", ["still.gif", "still.png", "still.webp"])
def test_a_still_image_is_no_film(tmp_path, name):
    Image.fromarray(picture(3)).save(tmp_path / name, lossless=True)
    source = open_images(str(tmp_path / name))
    assert (source.length, source.film, [label for label, _ in source.images]) == (1, "", [name])


@pytest.mark.parametrize("name", ["film.gif", "film.png"])
def test_an_animated_image_that_is_cut_off(here, name):
    noise = [Image.fromarray(np.random.default_rng(n).integers(0, 255, (48, 64, 3), np.uint8)) for n in range(5)]
    noise[0].save(name, save_all=True, append_images=noise[1:], duration=100)
    (here / name).write_bytes((here / name).read_bytes()[: int(0.7 * (here / name).stat().st_size)])
    done = kpbench("detect", name, "--detector", "orb", code=1)
    assert re.search(rf"{name}: frames? .* of [45] cannot be read", done.stderr)
    if name.endswith("gif"):
        assert "film.gif: is cut off after frame" in done.stderr


def test_a_film_in_a_folder_of_images_is_said(here):
    for n in range(2):
        animate(here / f"{n}.gif")
    with pytest.warns(KpbenchWarning, match=r"0\.gif: is a film, of which only the first frame is read") as said:
        assert numbers(here) == [0, 0]
    assert len(said) == 1


def test_frames_in_words():
    assert name_frames([3]) == "frame 3"
    assert name_frames([9, 3, 4], 12) == "frames 3 to 4 and 9 of 12"
    assert name_frames(range(0, 40, 2), 40) == "frames 0, 2, 4, 6, 8, 10, 12 and 13 more of 40"


def test_an_animated_image_keeps_its_transparency_on_white(tmp_path):
    frames = [Image.fromarray(np.dstack([picture(1), np.full((48, 64), a, np.uint8)])) for a in (255, 0)]
    stream = io.BytesIO()
    frames[0].save(stream, "PNG", save_all=True, append_images=frames[1:], blend=0)
    (tmp_path / "film.png").write_bytes(stream.getvalue())
    with pytest.warns(KpbenchWarning, match=r"film\.png: is transparent, and is laid on white"):
        assert [frame[0, 0, 0] for _, frame in open_images(str(tmp_path / "film.png")).images] == [30, 255]
