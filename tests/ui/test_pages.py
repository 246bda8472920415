"""The pages in a real browser. Each worker of pytest-xdist has a server and a browser of its own."""

import concurrent.futures
import contextlib
import http.client
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path

import cv2
import pytest
import track_scenes
from helpers import kpbench

from kpbench import load_board
from kpbench.geometry import write_camera
from kpbench.predictions import read_predictions
from kpbench.ui import serving as serving_module

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
WAIT_MS = 60_000
"""A test waits so long for what should be there soon: other tests may share the processor."""


@contextlib.contextmanager
def serving(place, *command):
    """A server in an empty folder, its temporary files beside it. At the end it must have left nothing."""
    folders = {name: place / name for name in ("work", "home", "temporary")}
    for folder in folders.values():
        folder.mkdir()
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST", "XDG_", "NICEGUI"))}
    settings = {"HOME": str(folders["home"]), "TMPDIR": str(folders["temporary"])}
    words = [sys.executable, "-m", "kpbench", *map(str, command), "--port", "0", "--no-browser"]
    root = str(Path(__file__).parents[2])
    environment = kept | settings | {"PYTHONPATH": os.pathsep.join([root, kept.get("PYTHONPATH", "")])}
    with subprocess.Popen(words, cwd=folders["work"], env=environment, stdout=subprocess.PIPE, text=True) as process:
        try:
            address = process.stdout.readline().strip()
            assert address.startswith("http://127.0.0.1:"), address
            yield address
        finally:
            process.send_signal(signal.SIGINT)
            code = process.wait(20)
    assert code == 0
    assert not [*place.rglob("*.*"), *folders["work"].iterdir(), *folders["temporary"].iterdir()]


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    """A photograph and a film of a board, the board's sidecar and the camera."""
    folder = tmp_path_factory.mktemp("scene")
    kpbench("render-patches", "--board", "hexagon", "--patch", "trefoil", "--svg", "--out", folder)
    board, size = (
        load_board(folder / "hexagon-trefoil.json"),
        (track_scenes.CAMERA.width_px, track_scenes.CAMERA.height_px),
    )
    images = [track_scenes.shot(track_scenes.pose_at(n, turn_deg=1), board) for n in range(6)]
    cv2.imwrite(str(folder / "photo.png"), images[5])
    cv2.imwrite(str(folder / "other.png"), images[0])
    video = cv2.VideoWriter(str(folder / "film.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, size, False)
    for image in images:
        video.write(image)
    video.release()
    write_camera(folder / "camera.yaml", track_scenes.CAMERA)
    return folder


@pytest.fixture(scope="session")
def address(tmp_path_factory, scene):
    """A server that ``kpbench live`` started; it has looked at its film before a page is opened."""
    options = ("--board", scene / "hexagon-trefoil.json", "--camera", scene / "camera.yaml")
    with serving(tmp_path_factory.mktemp("served"), "live", scene / "film.mp4", *options) as url:
        assert url.endswith("/detect")
        while ask(url, "GET", "/picture/5")[0] != 200:
            time.sleep(0.1)
        yield url.removesuffix("/detect")


@pytest.fixture(scope="session")
def browser():
    with playwright.sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield chromium
        chromium.close()


@pytest.fixture
def open_page(browser):
    """A function that opens a page; no page may ask another host, log an error, or be wider than its window."""
    pages, outside, errors = [], [], []

    def opened(url, size=(1200, 900), **settings):
        context = browser.new_context(viewport={"width": size[0], "height": size[1]}, **settings)
        page = context.new_page()
        page.set_default_timeout(WAIT_MS)
        host = url.split("/")[2]
        page.on("request", lambda r: None if r.url.startswith(("data:", "blob:")) else outside.append(r.url))
        page.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.route(lambda asked: asked.split("/")[2:3] != [host], lambda route: route.abort())
        page.goto(url)
        pages.append((page, host))
        return page

    yield opened
    for page, host in pages:
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
        assert not [url for url in outside if url.split("/")[2] != host]
        page.context.close()
    assert not errors


def drop(page, files, place=0):
    page.set_input_files(f"input[type=file] >> nth={place}", files)


def status(page, text):
    page.wait_for_selector(f'[data-kp=status]:has-text("{text}")')


def problem(page, text):
    """Wait for a line that tells a problem, and return it."""
    page.wait_for_selector(f'.kp-problem:has-text("{text}")')
    return page.inner_text(f'.kp-problem:has-text("{text}")')


def choose(page, label, option):
    page.get_by_label(label, exact=True).first.click()
    page.get_by_role("option", name=option, exact=True).click()


def test_a_patch_is_designed_and_printed(address, open_page, here):
    page = open_page(f"{address}/")
    choose(page, "Start from", "checker")
    page.wait_for_selector('img[alt="the design checker"]')
    before = page.inner_html("[data-kp=previews]")
    page.get_by_role("button", name="Add a semi-circle").click()
    page.get_by_role("group", name="semi-circle 3").wait_for()
    page.get_by_label("Name", exact=True).fill("mine")
    slider = page.get_by_role("slider", name="Start (°) of semi-circle 3")
    slider.locator("[tabindex]").focus()
    for _ in range(30):
        page.keyboard.press("ArrowRight")
    number = page.get_by_role("group", name="semi-circle 3").get_by_label("Start (°)").first
    playwright.expect(number).to_have_value("30")
    page.wait_for_function("html => document.querySelector('[data-kp=previews]').innerHTML != html", arg=before)
    number.fill("35")
    page.wait_for_selector("[data-kp=measures] :text('mushroom')")
    assert "Cramér-Rao bound" in page.inner_text("[data-kp=measures]")
    choose(page, "Sheet", "hexagon board")
    page.wait_for_selector(".kp-note:has-text('hexagon-mine.svg')")
    for form in ("toml", "svg"):
        with page.expect_download() as done:
            page.get_by_role("button", name=f"download {form}").click()
        done.value.save_as(done.value.suggested_filename)
    kpbench("render-patches", "--board", "hexagon", "--svg", "--design", "mine.toml", "--out", "printed")
    assert Path("hexagon-mine.svg").read_bytes() == Path("printed/hexagon-mine.svg").read_bytes()
    page.get_by_label("Page", exact=True).fill("a9")
    assert "a9" in problem(page, "`page` is 'a9'")
    page.get_by_label("Page", exact=True).fill("a4")
    page.wait_for_selector("img.kp-sheet")
    page.get_by_role("button", name="remove semi-circle 3").click()
    playwright.expect(page.get_by_role("group", name="semi-circle 3")).to_have_count(0)


def test_a_photograph_and_a_film_are_looked_at(address, open_page, scene, here):
    page = open_page(f"{address}/detect")
    choose(page, "Board", "no board")
    page.wait_for_selector("[data-kp=pose]:has-text('no board is chosen')")
    drop(page, [scene / "hexagon-trefoil.json", scene / "camera.yaml"], place=1)
    page.wait_for_selector("[data-kp=pose]:has-text('hexagon-trefoil')")
    drop(page, [scene / "photo.png", scene / "other.png"])
    choose(page, "Photograph", "other.png")
    status(page, "other.png, 406 x 310 px: 6 points")
    playwright.expect(page.get_by_text("refused:")).to_have_count(0)
    choose(page, "Photograph", "photo.png")
    status(page, "photo.png, 406 x 310 px: 6 points")
    page.wait_for_selector("[data-kp=pose]:has-text('hexagon-trefoil, seen: x ')")
    assert page.locator("tbody tr").count() == 6
    for name in ("predictions", "picture", "poses"):
        with page.expect_download() as done:
            page.get_by_role("button", name=f"Save {name}").click()
        done.value.save_as(done.value.suggested_filename)
    assert len(read_predictions("predictions.json").xy) == 12
    assert cv2.imread("photo-overlay.jpg").shape == (310, 406, 3)
    assert "hexagon-trefoil" in Path("poses.csv").read_text()
    drop(page, scene / "film.mp4")
    page.wait_for_selector("text=Pose over time")
    status(page, "at its end")
    page.wait_for_selector("[data-kp=pose]:has-text('tracked')")
    page.get_by_role("button", name="Look again").click()
    page.get_by_role("button", name="Freeze").click()
    page.get_by_role("button", name="Go on").click()
    status(page, "at its end")


def test_the_keyboard_reaches_everything_in_a_narrow_dark_window(address, open_page, scene):
    page = open_page(f"{address}/", (390, 844), color_scheme="dark")
    assert page.evaluate("document.body.classList.contains('body--dark')")
    for _ in range(2):
        page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    page.wait_for_url("**/detect")
    page.wait_for_selector("text=Look for")
    with page.expect_file_chooser() as chooser:
        page.get_by_role("button", name="choose files: Drop photographs").focus()
        page.keyboard.press("Enter")
    chooser.value.set_files(scene / "photo.png")
    status(page, "photo.png")
    page.wait_for_selector(".q-loading-bar[aria-hidden]", state="attached")
    page.get_by_role("button", name="light or dark").focus()
    page.keyboard.press("Enter")
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    page.wait_for_function("!document.body.classList.contains('body--dark')")
    page.keyboard.press("Enter")
    page.wait_for_function("document.body.classList.contains('body--dark')")


def huge_png(side=33_000):
    """A PNG file with as many pixels as it declares, one bit each."""

    def chunk(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    rows = zlib.compress(bytes((1 + -(-side // 8)) * side), 1)
    head = struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def test_bad_uploads_are_refused_in_one_line_each(address, open_page, here):
    page = open_page(f"{address}/detect")
    drop(page, {"name": "huge.png", "mimeType": "image/png", "buffer": huge_png()})
    assert problem(page, "huge.png: cannot be decoded").endswith("as an image of at most 200 megapixels")
    drop(page, {"name": "broken.mp4", "mimeType": "video/mp4", "buffer": b"\0\0\0\x18ftypmp42" + bytes(5000)})
    assert "\n" not in problem(page, "broken.mp4: ")
    drop(page, {"name": "../../../outside.png", "mimeType": "image/png", "buffer": b"x"})
    assert problem(page, "outside.png: cannot be decoded")
    with Path("large.png").open("wb") as file:
        file.truncate(50 * 2**20)
    drop(page, "large.png")
    assert problem(page, "large.png: cannot be decoded")
    drop(page, {"name": "board.json", "mimeType": "application/json", "buffer": b"{}"}, place=1)
    assert problem(page, "board.json: ")


def ask(address, method, path, **headers):
    with contextlib.closing(http.client.HTTPConnection(address.split("/")[2], timeout=60)) as connection:
        connection.request(method, path, headers={name.replace("_", "-"): value for name, value in headers.items()})
        with connection.getresponse() as answer:
            return answer.status, b"" if answer.status == 101 else answer.read()


def test_requests_of_others_are_refused(address):
    host = address.split("/")[2]
    upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec_WebSocket_Version": "13"}
    upgrade |= {"Sec_WebSocket_Key": "AAAAAAAAAAAAAAAAAAAAAA=="}
    socket_path = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
    assert ask(address, "GET", "/", Host="evil.example")[0] == 421
    assert ask(address, "GET", "/", Host="10.0.0.1:80")[0] == 421
    assert ask(address, "GET", socket_path, Origin="http://evil.example", **upgrade)[0] == 403
    assert ask(address, "GET", socket_path, Origin=f"http://{host}", **upgrade)[0] == 101
    assert (
        ask(address, "POST", "/_nicegui/client/x/upload/1", Origin="http://evil.example", Content_Length="0")[0] == 403
    )
    assert ask(address, "POST", "/", Content_Length=str(2**30)) == (
        413,
        b"kpbench: 1024 MiB, expected at most 256 MiB\n",
    )
    for path in ("/download/..%2f..%2fetc%2fpasswd", "/picture/../../etc/passwd", "/_nicegui/../../../../etc/passwd"):
        status_code, content = ask(address, "GET", path)
        assert status_code in (404, 422)
        assert b"root:" not in content


def test_many_quick_requests_are_answered(address):
    with concurrent.futures.ThreadPoolExecutor(16) as pool:
        codes = list(pool.map(lambda n: ask(address, "GET", ("/detect", "/picture/0")[n % 4 > 0])[0], range(200)))
    assert codes[::4] == [200] * 50
    assert set(codes) <= {200, 204}


def test_the_commands_serve_this_machine_alone_unless_asked(monkeypatch):
    calls = []
    monkeypatch.setattr(serving_module, "serve", lambda *arguments, **settings: calls.append((arguments, settings)))
    assert not kpbench("ui").stderr
    assert calls[0][0] == ("127.0.0.1", 8000)
    assert calls[0][1]["open_browser"]
    warned = kpbench("live", "camera:0", "--host", "0.0.0.0", "--port", "80", "--no-browser").stderr
    assert warned.startswith("kpbench: every machine that reaches 0.0.0.0 can use the application")
    assert calls[1][1]["source"] == "camera:0"


def test_wrong_calls_are_one_line(scene, address):
    port = address.rpartition(":")[2]
    taken = kpbench("ui", "--no-browser", "--port", port, code=1)
    assert taken.stderr.startswith(f"kpbench: --port {port} of --host 127.0.0.1 cannot be opened (")
    assert "no such" in kpbench("live", "gone.mp4", code=1).stderr
    boards = kpbench("live", scene / "film.mp4", "--board", "hexagon", code=1)
    assert "names 4 boards" in boards.stderr
