"""A mark counts only where kpbench's writers put it, and each command has kinds of its own."""

import cv2
import numpy as np
import pytest
from helpers import kpbench, write_dataset

from kpbench.errors import DataError
from kpbench.files import PACKAGE
from kpbench.images import drawing_name, encode_png
from kpbench.printing.formats import PAGE_WRITERS
from kpbench.printing.page import Page
from kpbench.writing import kind_of, write_file

IMAGES = [[(3, 4, 2, 0), (6, 2, 2, 1)], [(5, 5, 2, 2)]]
MARK = b"kpbench.scores/1"
QUOTATIONS = {
    "text": b"kpbench writes kpbench.scores/1 into its files.\n",
    "text that begins with a mark": MARK + b" is the mark of scores\n",
    "a line of its own": b"my notes\n" + MARK + b"\nmore notes\n",
    "Markdown": b"# My notes\n\n<!-- " + MARK + b" -->\n",
    "a heading": b"# " + MARK + b"\n\nWhat I know of it\n",
    "Markdown with a header": b"---\ntitle: notes\n---\n\nabout `" + MARK + b"`\n",
    "JSON, another key": b'{"note": "' + MARK + b'"}',
    "JSON, a later key": b'{"title": "mine", "schema": "' + MARK + b'"}',
    "JSON, a part of a value": b'{"schema": "of ' + MARK + b'"}',
    "JSON, an inner key": b'{"mine": {"schema": "' + MARK + b'"}}',
    "JSON, a list": b'[{"schema": "' + MARK + b'"}]',
    "COCO": b'{"info": {"description": "mine, from ' + MARK + b'"}}',
    "HTML": b"<!doctype html>\n<html>\n<body>\n<p>" + MARK + b"</p>\n",
    "HTML, another name": b'<!doctype html>\n<html>\n<meta name="about" content="' + MARK + b'">\n',
    "CSV, a cell": b"name,schema\nmine," + MARK + b"\n",
    "CSV, a comment": b"# from " + MARK + b"\nimage_id,x,y\n",
    "LaTeX": b"\\documentclass{article}\n% " + MARK + b"\n",
    "SVG": b'<?xml version="1.0"?>\n<svg width="1">\n<title>' + MARK + b"</title>\n</svg>\n",
    "YAML": b"# " + MARK + b"\nmine: 1\n",
    "TOML": b'schema = "' + MARK + b'"\n',
    "Python": b'SCHEMA = "' + MARK + b'"\n',
    "PNG": cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes() + MARK,
    "JPEG": cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))[1].tobytes() + MARK,
    "PDF": b"%PDF-1.4\n1 0 obj\n<< /Title (about " + MARK + b") >>\n",
    "a film": b"\0\0\0\x20ftypisom" + MARK + b" and more",
    "bytes": b"\x08\x08" + MARK,
}


@pytest.mark.parametrize("name", QUOTATIONS)
def test_a_file_that_quotes_a_mark_is_the_users(tmp_path, name):
    file = tmp_path / "file"
    file.write_bytes(QUOTATIONS[name])
    for ours in (b'{"schema": "kpbench.scores/1"}', QUOTATIONS[name] + b"more"):
        with pytest.raises(DataError, match="kpbench did not write it"):
            write_file(file, ours)
    assert file.read_bytes() == QUOTATIONS[name]


@pytest.mark.parametrize(
    ("kind", "data"),
    [
        ("scores", b'{\n  "schema": "kpbench.scores/1",\n  "dataset": 1}'),
        ("scores", b'{\r\n  "schema": "kpbench.scores/1",\r\n  "dataset": 1}'),
        ("predictions", b'{"schema":"kpbench.predictions/1","detector":{}}\n{"image_id":0}\n'),
        ("predictions", b'# {"schema": "kpbench.predictions/1", "detector": {}}\nimage_id,x,y\n'),
        ("table", b"schema,detector\nkpbench.table/1,mine\n"),
        ("table", b"schema,detector\r\nkpbench.table/1,mine\r\n"),
        ("report", b"<!-- kpbench.report/1 -->\r\n\r\n# Title\r\n"),
        ("report", b"% kpbench.report/1\n\\section{A}\n"),
        ("picture", encode_png(np.zeros((8, 8), np.uint8), "picture")),
        ("picture", b"\xff\xd8\xff\xfe\0\x13kpbench.picture/1\xff\xe0"),
        ("video", b"\0\0\0\x20ftypisom....\0\0\0\x18freekpbench.video/1 "),
        ("checkpoint", b'\x90\0\0\0\0\0\0\0{"__metadata__":{"kpbench":"{\\"schema\\": \\"kpbench.checkpoint/1\\"}"}}'),
    ],
)
def test_files_that_earlier_versions_wrote_are_recognised(kind, data):
    assert kind_of(data, data) == kind


def test_weights_hold_designs_and_are_of_their_own_kind():
    for path in PACKAGE.glob("detectors/weights/superpoint*.onnx"):
        data = path.read_bytes()
        assert kind_of(data[:65536], data[-16384:]) == "superpoint"


@pytest.mark.parametrize("suffix", PAGE_WRITERS)
def test_a_figure_is_no_print(suffix):
    kinds = []
    for mark in ("kpbench.print/1", "kpbench.figure/1"):
        [data] = PAGE_WRITERS[suffix]([Page(20.0, 20.0, (), (), "a page", mark)], 50)
        kinds.append(kind_of(data, data))
    assert kinds == ["print", "figure"]


def test_no_command_draws_over_the_pictures_of_another(here):
    """Each folder holds a picture of one command; every other command is asked to replace it."""
    write_dataset(here / "set", IMAGES)
    (here / "photos").mkdir()
    cv2.imwrite("photos/00000000.png", np.full((40, 60), 90, np.uint8))
    name = "00000000.png"
    kpbench("export", "set", "--format", "coco", "--out", "coco")
    (here / "coco" / "images").rename(here / "export")
    commands = {
        "overlay": ("detect", "photos", "--out", "p.json", "--overlay"),
        "degraded": ("degrade", "photos", "--effect", "blur", "--level", "1", "--out"),
        "picture": ("preview", "set", "--out"),
    }
    for kind, command in commands.items():
        (here / kind).mkdir()
        kpbench(*command, f"{kind}/{name}" if kind == "picture" else kind)
    (here / "print").mkdir()
    [page] = PAGE_WRITERS[".png"]([Page(20.0, 20.0, (), (), "a print")], 50)
    (here / "print" / name).write_bytes(page)
    folders = {folder: (here / folder / name).read_bytes() for folder in ("export", "print", *commands)}
    for kind, command in commands.items():
        for folder, data in folders.items():
            target = f"{folder}/{name}" if kind == "picture" else folder
            result = kpbench(*command, target, code=int(folder != kind))
            if folder != kind:
                assert f"{folder}/{name}: exists, and is a file of another kind" in result.stderr
            assert (here / folder / name).read_bytes() == data


def test_two_images_never_become_one_file(here):
    names = ["a.jpg", "a.jpg.png", "a.jpg.png.png", "a.png", "a.PNG", "a.PNG.png", "b/a.png", "c/a.png", "00000001.png"]
    assert len({drawing_name(name) for name in names}) == len(names)
    assert [name for name in names if drawing_name(name) == name] == ["a.png", "b/a.png", "c/a.png", "00000001.png"]
    for n, name in enumerate(names):
        (here / "photos" / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(f"photos/{name}", np.full((20 + n, 30), 90, np.uint8))
    kpbench("degrade", "photos", "--effect", "blur", "--level", "1", "--out", "worse")
    kpbench("detect", "photos", "--out", "p.json", "--overlay", "drawn")
    for folder, enlarged in (("worse", 1), ("drawn", 4)):
        heights = sorted(cv2.imread(str(path)).shape[0] // enlarged for path in (here / folder).rglob("*.png"))
        assert heights == [*range(20, 20 + len(names))]
