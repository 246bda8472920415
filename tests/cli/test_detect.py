import json
import os
import re
import sys
import types
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import kpbench

from kpbench.dataset.drawing import draw_detections
from kpbench.dataset.generation import generate
from kpbench.detectors.interface import DEFAULT_DETECTOR, DETECTORS, LoadedDetector, load_detector
from kpbench.detectors.prediction import predict_images
from kpbench.errors import DataError
from kpbench.geometry.camera import Camera
from kpbench.geometry.camera_file import write_camera
from kpbench.images import ImageSource, image_writer
from kpbench.patches.design import load_patches
from kpbench.predictions.files import read_predictions
from kpbench.render.placement import Limits
from kpbench.synth.synthetic import SynthConfig
from kpbench.types import Detections

MODULE = """
import numpy as np
from kpbench import Detections

def brightest(image):
    grey = image if image.ndim == 2 else image.mean(axis=2)
    y, x = np.unravel_index(int(grey.argmax()), grey.shape)
    return Detections([[x, y], [0, 0]], [1.0, 0.2], [1, 0])

def moody(image):
    if int(image.sum()) % 2:
        raise RuntimeError("not today")
    return brightest(image)

class Unsure:
    threshold = 0.5

    def detect(self, image):
        found = brightest(image)
        return found[found.score >= self.threshold]
"""


@pytest.fixture
def folder(here, monkeypatch):
    monkeypatch.syspath_prepend(str(here))
    (here / f"plug_{abs(hash(str(here)))}.py").write_text(MODULE)
    return here


@pytest.fixture
def plug(folder):
    return next(folder.glob("plug_*.py")).stem


def photos(folder, count=3):
    (folder / "photos" / "sub").mkdir(parents=True)
    for n in range(count):
        image = np.zeros((60, 80, 3), np.uint8)
        image[10 + n, 20] = 255
        cv2.imwrite(str(folder / "photos" / ("sub" if n else "") / f"{n}.png"), image)


def test_a_dataset_gets_predictions_that_name_it(folder, plug):
    data = generate(SynthConfig(4, size_px=(160, 120)), "set", workers=1).dataset
    result = kpbench("detect", "set", "--detector", f"{plug}:brightest", "--workers", 1, "--overlay", "drawn")
    assert "preds.json: 8 detections in 4 images" in result.stdout
    found = read_predictions("preds.json")
    assert found.dataset == "set"
    assert found.image_id.tolist() == data.truth.image_id.tolist()
    assert found.detector["name"] == f"{plug}:brightest"
    assert len(list((folder / "drawn").iterdir())) == 4


def test_workers_change_nothing(folder, plug):
    generate(SynthConfig(40, size_px=(96, 96)), "set", workers=1)
    for n in (1, 2):
        kpbench("detect", "set", "--detector", f"{plug}:brightest", "--workers", n, "--out", f"{n}.json")
    one, two = (re.sub(r'"ms":[0-9.]+', "", (folder / f"{n}.json").read_text()) for n in (1, 2))
    assert one == two


def test_each_image_has_its_file_size_and_time(folder, plug):
    photos(folder)
    (folder / "photos" / "sub" / "broken.png").write_bytes(b"no image")
    kpbench("detect", "photos", "--detector", f"{plug}:brightest", "--out", "p.json", code=1)
    p = read_predictions("p.json")
    assert p.file == ("photos/0.png", "photos/sub/1.png", "photos/sub/2.png", "photos/sub/broken.png")
    assert p.size.tolist() == [[80, 60]] * 3 + [[0, 0]]
    assert (p.ms[:3] > 0).all()
    assert np.isnan(p.ms[3])
    assert (p.frame_index, p.time_s) == (None, None)
    for more in ((), ("--out", "-")):  # nothing is written that could hold the cost
        assert "--cost needs a predictions" in kpbench("detect", "photos/0.png", "--cost", *more, code=2).stderr
    kpbench("detect", "photos/0.png", "--detector", f"{plug}:brightest", "--out", "one.json")
    assert read_predictions("one.json").file == ("photos/0.png",)
    generate(SynthConfig(2, size_px=(96, 80)), "set", workers=1)
    kpbench("detect", "set", "--detector", f"{plug}:brightest", "--out", "set.json")
    of_set = read_predictions("set.json")
    assert (of_set.file, of_set.size.tolist(), len(of_set.ms)) == (None, [[96, 80]] * 2, 2)


@pytest.mark.parametrize("source", ["photos", "set"])
def test_lines_are_streamed_to_stdout(folder, plug, source):
    photos(folder)
    generate(SynthConfig(3, size_px=(96, 96)), "set", workers=1)
    found = kpbench("detect", source, "--detector", f"{plug}:brightest", "--out", "-")
    assert not (folder / "-").exists()
    assert "stdout: 6 detections in 3 images" in found.stderr
    header, *lines = found.stdout.splitlines()
    assert json.loads(header)["detector"]["name"] == f"{plug}:brightest"
    assert [json.loads(line)["image_id"] for line in lines] == [0, 1, 2]
    (folder / "p.jsonl").write_text(found.stdout)
    kpbench("detect", source, "--detector", f"{plug}:brightest", "--out", "q.jsonl")
    p, q = read_predictions("p.jsonl"), read_predictions("q.jsonl")
    assert (p.detector, p.dataset, p.fingerprint, p.file) == (q.detector, q.dataset, q.fingerprint, q.file)
    assert (p.xy.tolist(), p.patch_id.tolist(), p.size.tolist()) == (
        q.xy.tolist(),
        q.patch_id.tolist(),
        q.size.tolist(),
    )


def test_a_line_comes_before_the_next_image_is_read():
    def images():
        yield "0.png", np.zeros((8, 8), np.uint8)
        assert [len(p) for p in seen] == [0, 1]
        yield "1.png", np.zeros((8, 8), np.uint8)

    seen = []
    detector = LoadedDetector("none", "1", lambda image: Detections.none())
    run = predict_images(ImageSource(images(), None), detector, sink=seen.append)
    assert [p.image_id.tolist() for p in seen] == [[], [0], [1]]
    assert len(run.predictions) == 2


def test_several_sources_and_patterns(folder, plug):
    photos(folder)
    (folder / "more").mkdir()
    (folder / "photos" / "0.png").rename(folder / "more" / "9.png")
    args = ("--detector", f"{plug}:brightest", "--threshold", 0.5)
    kpbench("detect", "more/9.png", "photos", "photos/sub/1.png", *args, "--overlay", "drawn")
    p = read_predictions("preds.json")
    assert p.file == ("more/9.png", "photos/sub/1.png", "photos/sub/2.png")
    assert p.xy.tolist() == [[20, 10], [20, 11], [20, 12]]
    drawn = [path.relative_to("drawn").as_posix() for path in sorted(Path("drawn").rglob("*.png"))]
    assert drawn == ["more/9.png", "photos/sub/1.png", "photos/sub/2.png"]
    kpbench("detect", "photos/**/*.png", *args)
    assert read_predictions("preds.json").file == ("photos/sub/1.png", "photos/sub/2.png")
    kpbench("detect", "photos/sub/../sub/1.png", folder / "more", *args, "--overlay", "again")
    assert read_predictions("preds.json").file == (f"{folder}/photos/sub/1.png", f"{folder}/more/9.png")
    assert sorted(path.name for path in Path("again").rglob("*.png")) == ["1.png", "9.png"]


@pytest.mark.parametrize(
    ("sources", "says"),
    [
        (["*.tif"], "*.tif: the pattern fits no file"),
        (["photos", "film.mp4"], "film.mp4: expected an image or a folder of images, as one of 2 sources"),
        (["photos", "camera:0"], "camera:0: expected an image or a folder"),
        (["photos", "set"], "set: expected an image or a folder"),
        (["photos", "none.png"], "none.png: expected an image or a folder"),
    ],
)
def test_a_source_that_cannot_be_one_of_several_is_named(folder, plug, sources, says):
    photos(folder)
    generate(SynthConfig(1, size_px=(96, 96)), "set", workers=1)
    result = kpbench("detect", *sources, "--detector", f"{plug}:brightest", code=1)
    assert says in result.stderr
    assert not Path("preds.json").exists()


def test_a_folder_in_order_of_names_and_a_threshold(folder, plug):
    photos(folder)
    kpbench("detect", "photos", "--detector", f"{plug}:brightest", "--threshold", 0.5, "--overlay", "drawn")
    assert read_predictions("preds.json").xy.tolist() == [[20, 10], [20, 11], [20, 12]]
    assert sorted(p.relative_to(folder / "drawn").as_posix() for p in (folder / "drawn").rglob("*.png")) == [
        "0.png",
        "sub/1.png",
        "sub/2.png",
    ]


def test_a_threshold_takes_the_place_of_the_detectors_own(folder, plug):
    photos(folder, 1)
    for threshold, count in ([], 1), (["--threshold", 0.1], 2), (["--threshold", 1.1], 0):
        assert f"{count} detections" in kpbench("detect", "photos", "--detector", f"{plug}:Unsure", *threshold).stdout


@pytest.mark.parametrize("name", ["template", "superpoint", "superpoint-small"])
def test_the_shipped_detectors_have_a_threshold(name):
    assert load_detector(name, 0.9).run.__self__.threshold == 0.9


def test_one_image_is_drawn_into_one_file_and_more_into_a_folder(folder, plug):
    (folder / "two").mkdir()
    for n in range(2):
        cv2.imwrite(str(folder / "two" / f"{n}.png"), np.full((24, 32), 90, np.uint8))
    kpbench("detect", "two/0.png", "--detector", f"{plug}:brightest", "--overlay", "drawn.png")
    assert cv2.imread("drawn.png").shape == (96, 128, 3)
    refused = kpbench("detect", "two", "--detector", f"{plug}:brightest", "--overlay", "other.png", code=1)
    assert "there is more than one image, expected a folder" in refused.output


def test_a_video_and_its_overlay(folder, plug):
    writer = cv2.VideoWriter("in.mp4", cv2.VideoWriter.fourcc(*"mp4v"), 10, (96, 64))
    for n in range(5):
        frame = np.zeros((64, 96, 3), np.uint8)
        cv2.rectangle(frame, (10 + 8 * n, 20), (20 + 8 * n, 30), (255, 255, 255), -1)
        writer.write(frame)
    writer.release()
    kpbench("detect", "in.mp4", "--detector", f"{plug}:brightest", "--overlay", "out.mp4", "--threshold", 0.5)
    p = read_predictions("preds.json")
    assert (p.file, p.frame_index.tolist(), p.size.tolist()) == (("in.mp4",) * 5, [*range(5)], [[96, 64]] * 5)
    np.testing.assert_allclose(p.time_s, np.arange(5) / 10)
    x = p.xy[:, 0]
    assert len(x) == 5
    assert (np.abs(x - (15 + 8 * np.arange(5))) <= 8).all()
    assert cv2.VideoCapture("out.mp4").get(cv2.CAP_PROP_FRAME_COUNT) == 5


@pytest.mark.parametrize("length", [3, None])
def test_an_interrupt_keeps_what_an_endless_source_has_shown(length):
    def images():
        yield "0.png", np.zeros((8, 8), np.uint8)
        raise KeyboardInterrupt

    source = ImageSource(images(), length)
    detector = LoadedDetector("none", "1", lambda image: Detections.none())
    with nullcontext() if length is None else pytest.raises(KeyboardInterrupt):
        assert len(predict_images(source, detector).predictions) == 1


def test_an_image_that_fails_is_named_and_counted_and_the_rest_goes_on(folder, plug):
    photos(folder)
    (folder / "photos" / "broken.jpg").write_bytes(b"nothing")
    cv2.imwrite(str(folder / "photos" / "even.png"), np.full((40, 40, 3), 2, np.uint8))
    result = kpbench("detect", "photos", "--detector", f"{plug}:moody", code=1)
    assert "broken.jpg: cannot be decoded" in result.stderr
    assert "0.png: RuntimeError: not today" in result.stderr
    assert "4 images failed" in result.stderr
    assert len(read_predictions("preds.json")) == 5


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("nowhere", "nowhere: no such dataset, image, folder or video"),
        ("empty", "empty: neither a dataset nor a folder with images"),
        ("text.png", "text.png: cannot be decoded as an image"),
        ("text.mp4", "text.mp4: cannot be opened as a video"),
        ("camera:x", "camera:x: expected camera:0"),
        ("camera:²", "camera:²: expected camera:0"),
    ],
)
def test_bad_sources_are_one_line(folder, plug, source, says):
    (folder / "empty").mkdir()
    (folder / "text.png").write_text("no image")
    (folder / "text.mp4").write_text("no video")
    result = kpbench("detect", source, "--detector", f"{plug}:brightest", code=1)
    assert result.stderr.startswith(f"kpbench: {says}")
    assert result.stderr.count("\n") == 1


def test_predictions_for_another_dataset_are_refused_by_its_fingerprint(folder, plug):
    for seed in (0, 1):
        generate(SynthConfig(4, seed=seed, size_px=(160, 120)), f"set-{seed}", workers=1)
    kpbench("detect", "set-0", "--detector", f"{plug}:brightest", "--workers", 1)
    kpbench("score", "preds.json")
    refused = kpbench("score", "preds.json", "--gt", "set-1", code=1)
    assert "made for the dataset with fingerprint" in refused.stderr
    assert refused.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("code", "says"),
    [
        ("def f(image:\n", "cannot be imported, SyntaxError"),
        ("raise SystemExit(7)\n", "cannot be imported, SystemExit: 7"),
        ("class f:\n    def __init__(self, a):\n        pass\n", "cannot be made, TypeError"),
        (
            "def f(image):\n    raise ValueError('a\\nb')\n",
            "failed on all 3 images, first 0.png: ValueError: a b (bad_",
        ),
    ],
)
def test_mistakes_in_a_detector_of_ones_own_are_one_line_and_keep_older_predictions(folder, code, says):
    photos(folder)
    (folder / "preds.json").write_text('{"schema": "kpbench.predictions/1"}')
    name = f"bad_{abs(hash((str(folder), code)))}"
    (folder / f"{name}.py").write_text(code)
    result = kpbench("detect", "photos", "--detector", f"{name}:f", code=1)
    assert says in result.stderr
    assert result.stderr.count("\n") == 1
    assert (folder / "preds.json").read_text() == '{"schema": "kpbench.predictions/1"}'


def test_template_looks_for_the_designs_it_is_told(folder):
    other = Path(__file__).parents[2] / "benchmarks" / "designs" / "runner-up" / "007f4f4f.toml"
    limits = Limits(count=(1, 1), radius_px=(20, 40), tilt_deg=30)
    generate(
        SynthConfig(4, size_px=(160, 120), deteriorate="none", patches=load_patches([other]), limits=limits), "set"
    )
    kpbench("detect", "set", "--patches", other)
    ids = read_predictions("preds.json").patch_id
    assert len(ids) >= 3
    assert set(ids) == {4}
    refused = kpbench("detect", "set", "--patches", other, "--detector", "superpoint-small", code=2)
    assert "--patches is for the template detector" in refused.stderr


def test_photographs_are_not_drawn_over_and_drawings_not_read(folder, plug):
    photos(folder)
    before = {path: path.read_bytes() for path in (folder / "photos").rglob("*.png")}
    for source, overlay in ("photos", "photos"), ("photos/0.png", "photos/0.png"), ("photos/0.png", "photos"):
        refused = kpbench("detect", source, "--detector", f"{plug}:brightest", "--overlay", overlay, code=1)
        assert (
            refused.stderr
            == f"kpbench: {overlay}: holds the images themselves, which would be overwritten; name another place\n"
        )
    for _ in range(2):
        assert (
            "in 3 images"
            in kpbench("detect", "photos", "--detector", f"{plug}:brightest", "--overlay", "photos/drawn").stdout
        )
    assert {path: path.read_bytes() for path in before} == before


def test_two_photographs_of_one_stem_are_drawn_into_two_files(folder, plug):
    photos(folder, 1)
    cv2.imwrite(str(folder / "photos" / "0.jpg"), np.zeros((60, 80, 3), np.uint8))
    kpbench("detect", "photos", "--detector", f"{plug}:brightest", "--overlay", "drawn")
    assert sorted(path.name for path in (folder / "drawn").iterdir()) == ["0.jpg.png", "0.png"]


@pytest.mark.parametrize(
    ("option", "value", "says"),
    [
        ("--out", "preds.xml", "preds.xml: unknown kind of predictions file"),
        ("--out", "no/preds.json", "no/preds.json: cannot be written, there is no folder no"),
        ("--overlay", "one.png", "one.png: there is more than one image"),
    ],
)
def test_what_cannot_be_written_is_told_before_the_first_image(folder, option, value, says):
    generate(SynthConfig(3, size_px=(96, 96)), "set", workers=1)
    name = f"counting_{abs(hash((str(folder), value)))}"
    code = "def f(image):\n    open('called', 'w')\n    return Detections.none()\n"
    (folder / f"{name}.py").write_text(f"from kpbench import Detections\n{code}")
    result = kpbench("detect", "set", "--detector", f"{name}:f", "--workers", 1, option, value, code=1)
    assert result.stderr.startswith(f"kpbench: {says}")
    assert not (folder / "called").exists()


def test_a_detection_far_outside_is_not_drawn():
    far = Detections([[1e10, 5.0], [5.0, -1e12]], [1.0, 1.0], [0, 1])
    assert (draw_detections(np.zeros((20, 30), np.uint8), far) == 0).all()


def test_a_threshold_is_for_one_call_alone():
    class Unsure:
        threshold = 0.5

        def detect(self, image):
            return Detections([[1.0, 1.0]], [0.6])[np.array([self.threshold <= 0.6])]

    module = types.ModuleType("unsure_of_a_test")
    module.one = Unsure()
    sys.modules[module.__name__] = module
    image = np.zeros((4, 4), np.uint8)
    found = [len(load_detector(f"{module.__name__}:one", threshold)(image)) for threshold in (None, 0.8, None)]
    assert found == [1, 0, 1]


def test_a_patch_id_under_zero_is_named():
    with pytest.raises(DataError, match="detector wrong: returned the patch id -1, expected 0 or more"):
        LoadedDetector("wrong", "1", lambda image: Detections([[1, 1]], [1.0], [-1]))(np.zeros((4, 4), np.uint8))


def test_an_interrupt_says_how_to_go_on(folder):
    photos(folder)
    name = f"stopped_{abs(hash(str(folder)))}"
    (folder / f"{name}.py").write_text("def f(image):\n    raise KeyboardInterrupt\n")
    result = kpbench("detect", "photos", "--detector", f"{name}:f", code=130)
    assert result.stderr == "kpbench: interrupted: preds.json is not written; the same command starts anew\n"


def draw_video(count, stop=None):
    with image_writer(Path("out.mp4"), count) as draw:
        for _ in range(count):
            draw("0.png", np.zeros((64, 96, 3), np.uint8))
        if stop:
            raise stop


def test_a_video_that_is_not_finished_is_not_there(folder):
    with pytest.raises(KeyboardInterrupt):
        draw_video(3, KeyboardInterrupt)
    assert not [path for path in folder.iterdir() if "out" in path.name]
    draw_video(3)
    assert cv2.VideoCapture("out.mp4").get(cv2.CAP_PROP_FRAME_COUNT) == 3


def test_a_video_that_lacks_frames_is_told(folder, monkeypatch):
    class Full:
        fourcc = staticmethod(cv2.VideoWriter.fourcc)

        def __init__(self, name, *_):
            Path(name).write_bytes(b"cut")

        def __getattr__(self, name):
            return lambda *_: True

    monkeypatch.setattr(cv2, "VideoWriter", Full)
    with pytest.raises(DataError, match=r"out\.mp4: cannot be written whole, is the disk full"):
        draw_video(1)
    assert not [path for path in folder.iterdir() if "out" in path.name]


def test_a_name_that_is_no_utf8_is_drawn_and_made_into_a_set(folder, plug):
    photos(folder, 1)
    os.rename(folder / "photos" / "0.png", os.fsencode(folder / "photos") + b"/\xff.png")
    kpbench("detect", "photos", "--detector", f"{plug}:brightest", "--overlay", "drawn")
    assert os.listdir(os.fsencode(folder / "drawn")) == [b"\xff.png"]
    made = generate(SynthConfig(2, size_px=(96, 96), backgrounds=folder / "photos"), "set", workers=1)
    assert len(list(made.dataset.verify())) == 1


@pytest.mark.parametrize("name", ["orb", "sift"])
def test_an_image_of_a_few_px_holds_no_features(name):
    assert [len(load_detector(name)(np.zeros(size, np.uint8))) for size in ((1, 1), (2, 3), (1, 50))] == [0, 0, 0]


def test_images_of_several_sizes_make_no_video(folder, plug):
    photos(folder, 2)
    cv2.imwrite(str(folder / "photos" / "z.png"), np.zeros((30, 40, 3), np.uint8))
    result = kpbench("detect", "photos", "--detector", f"{plug}:brightest", "--overlay", "out.mp4", code=1)
    assert result.stderr.startswith("kpbench: out.mp4: z.png differs in size from the images before, expected a folder")
    assert not (folder / "out.mp4").exists()


BOARD_MODULE = """
import numpy as np
from kpbench import Detections

def four(image):  # four patches in a square, seen from the front at 2 px per mm
    xy = np.array([[280.0, 200], [360, 200], [280, 280], [360, 280]])
    return Detections(xy, np.ones(4), [0, 1, 1, 2], np.tile(20 * np.eye(2), (4, 1, 1)))
"""
BOARD = "grid = { rows = 2, columns = 2, pitch_mm = 40 }\ndiameter_mm = 20\n"


@pytest.fixture
def film(here, monkeypatch):
    """Images, a detector that sees a board in each of them, the board and the camera."""
    monkeypatch.syspath_prepend(str(here))
    (here / f"plug_{abs(hash(str(here)))}.py").write_text(BOARD_MODULE)
    (here / "square.toml").write_text(BOARD)
    write_camera("camera.yaml", Camera(640, 480, 700.0, principal_px=(320.0, 240.0)))
    (here / "photos").mkdir()
    for n in range(3):
        cv2.imwrite(f"photos/{n}.png", np.full((480, 640), n, np.uint8))
    return next(here.glob("plug_*.py")).stem + ":four"


def test_boards_and_poses_without_a_line_of_python(film):
    boards = ("--board", "square.toml", "--board", "hexagon", "--camera", "camera.yaml")
    done = kpbench("detect", "photos", "--detector", film, *boards, "--poses", "poses.jsonl", "--out", "p.csv")
    assert "poses.jsonl: 3 of 3 images have a pose; 0 poses are ambiguous" in done.stderr
    poses = [json.loads(line) for line in Path("poses.jsonl").read_text().splitlines()[1:]]
    assert [(p["file"], p["board"], p["reason"]) for p in poses[:2]] == [
        ("photos/0.png", "square", None),
        ("photos/0.png", "hexagon-checker", "the board was not found"),
    ]
    np.testing.assert_allclose(poses[0]["translation_mm"], [0, 0, 350], atol=1e-6)
    predictions = read_predictions("p.csv")
    assert predictions.boards[:2] == ("square", "hexagon-checker")
    assert predictions.points.tolist() == [0, 1, 2, 3] * 3
    assert predictions.board.tolist() == [0] * 12


def test_boards_go_into_the_stream(film):
    done = kpbench("detect", "photos", "--detector", film, "--board", "square.toml", "--out", "-")
    header, *lines = map(json.loads, done.stdout.splitlines())
    assert header["boards"] == ["square"]
    assert [line["points"] for line in lines] == [[0, 1, 2, 3]] * 3


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (
            ("--board", "none.toml"),
            1,
            "none.toml: no such file, expected hexagon, grid, truth, field or a board's file",
        ),
        (("--board", "camera.yaml"), 1, "camera.yaml: not valid TOML"),
        (("--board", "square.toml", "--camera", "square.toml"), 1, "square.toml: no calibration file"),
        (("--board", "square.toml", "--camera", "small.yaml"), 1, "photos/0.png: the image has 640x480 px, expected"),
        (("--board", "square.toml", "--camera", "camera.yaml", "--poses", "p.txt"), 1, "p.txt: unknown kind of poses"),
        (("--board", "square.toml", "--poses", "p.csv"), 2, "--poses needs --board and --camera"),
        (("--camera", "camera.yaml"), 2, "--camera and --second-look need --board"),
    ],
)
def test_what_is_wrong_with_boards_and_cameras_is_one_line(film, options, code, message):
    write_camera("small.yaml", Camera(400, 300, 700.0))
    done = kpbench("detect", "photos", "--detector", film, *options, code=code)
    assert message in done.stderr
    assert code == 2 or len(done.stderr.splitlines()) == 1
    assert not Path("preds.json").exists()


def test_a_single_image_is_drawn_and_its_detections_are_printed(folder, plug):
    photos(folder)
    lines = kpbench("detect", "photos/0.png", "--detector", f"{plug}:brightest").stdout.splitlines()
    assert lines[0] == f"photos/0.png: 2 detections by {plug}:brightest"
    assert [line.split() for line in lines[1:]] == [
        ["ID", "name", "x", "px", "y", "px", "radius", "px", "score"],
        ["1", "-", "20.00", "10.00", "-", "1.00"],
        ["0", "-", "0.00", "0.00", "-", "0.20"],
        ["0-found.png"],
    ]
    assert sorted(path.name for path in folder.iterdir() if path.is_file() and path.suffix != ".py") == ["0-found.png"]
    assert not kpbench(
        "detect", "photos/0.png", "--detector", f"{plug}:brightest"
    ).stderr  # its own drawing is replaced
    (folder / "0-found.png").write_bytes((folder / "photos" / "0.png").read_bytes())
    assert "0-found.png" in kpbench("detect", "photos/0.png", "--detector", f"{plug}:brightest", code=1).stderr
    kpbench("detect", "photos/0.png", "--detector", f"{plug}:brightest", "--out", "one.json")
    assert "draws them" in kpbench("detect", "photos", "--detector", f"{plug}:brightest").stdout


def test_a_single_image_tells_the_pose_of_a_board(film):
    boards = ("--board", "square.toml", "--camera", "camera.yaml")
    found = kpbench("detect", "photos/0.png", "--detector", film, *boards, "--poses", "p.csv", "--overlay", "drawn.png")
    [line] = [line for line in found.stdout.splitlines() if line.startswith("board")]
    assert line == "board square: 4 points, 350 mm away, tilted by 0.0 degrees, reprojection error 0.00 px"
    x_axis = cv2.imread("drawn.png")[480, 660:700]  # the picture is enlarged; the axis begins at the board's middle
    assert (x_axis.astype(int) @ [-1, -1, 2] > 100).any()
    assert Path("p.csv").exists()


def test_the_help_names_every_detector():
    text = kpbench("detect", "--help").stdout
    assert {*re.findall(r"[\w-]+", text)} >= {*DETECTORS}
    assert "superpoint-small    small network, the default" in text
    assert DEFAULT_DETECTOR == "superpoint-small"
