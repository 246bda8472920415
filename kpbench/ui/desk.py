"""What the pages share: one person sits at one desk. A second browser window shows the same."""

from __future__ import annotations

import re
import secrets
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from kpbench.errors import DataError, KpbenchError
from kpbench.files import open_file, read_text
from kpbench.films import VIDEO_SUFFIXES
from kpbench.geometry.camera import Camera
from kpbench.geometry.camera_file import read_camera
from kpbench.patches.board import Board
from kpbench.patches.board_file import load_board, load_boards
from kpbench.patches.design import Patch, load_patch, shipped_patches
from kpbench.ui.designer import PrintChoice, chosen_boards, chosen_designs
from kpbench.ui.watcher import Look, Watcher

MOST_DOWNLOADS = 16
"""Number of the newest downloads that can be fetched."""
OWN_DETECTOR = "template: my design"
"""The detector ``template``, for the edited design."""
FILM_HEAD = re.compile(rb"RIFF....AVI |....(ftyp|moov|mdat|free|skip|wide|pnot)|\x1a\x45\xdf\xa3", re.DOTALL)
"""How the films begin that a browser may send."""
NO_BOARD, MY_BOARD, FILE_BOARD = "no board", "the board of the Design page", "a board's file"
"""Boards to look for, beside the shipped ones."""
NO_CAMERA, VIEW_CAMERA, FILE_CAMERA = "no camera", "field of view", "a calibration"


@dataclass
class Desk:
    """The state of the application.

    Attributes
    ----------
    folder : Path
        The only folder that the application writes to.
    design : Patch
    choice : PrintChoice
    detector : str
    board_name, camera_name : str
        What is chosen on the page.
    board, camera : Board or None, Camera or None
        Those of files.
    view_deg : float
        Field of view along the longer side of an image.
    dark : bool or None
        None: as the browser wishes.

    Examples
    --------
    >>> from pathlib import Path
    >>> from kpbench.ui.desk import Desk
    >>> Desk(Path(".")).look().detector
    'superpoint-small'
    """

    folder: Path
    design: Patch = field(default_factory=lambda: shipped_patches()[1])
    choice: PrintChoice = field(default_factory=PrintChoice)
    detector: str = "superpoint-small"
    board_name: str = NO_BOARD
    camera_name: str = NO_CAMERA
    view_deg: float = 65.0
    dark: bool | None = None
    watcher: Watcher = field(default_factory=Watcher)
    sources: list[tuple[str, str]] = field(default_factory=list)
    board: Board | None = None
    camera: Camera | None = None
    _downloads: OrderedDict[str, tuple[str, bytes]] = field(default_factory=OrderedDict)

    def board_names(self) -> list[str]:
        """Return the boards to choose from."""
        shipped = [board.name for board in _shipped_boards()]
        return [NO_BOARD, MY_BOARD, *shipped, *([FILE_BOARD] if self.board is not None else [])]

    def camera_names(self) -> list[str]:
        """Return the cameras to choose from."""
        return [NO_CAMERA, VIEW_CAMERA, *([FILE_CAMERA] if self.camera is not None else [])]

    def look(self) -> Look:
        """Return what is looked for.

        Raises
        ------
        DesignError
            If the board of the Design page is impossible.
        DataError
            If the Design page has patches to cut out, or several boards.
        """
        board = None
        if self.board_name == MY_BOARD:
            boards = chosen_boards(self.design, self.choice)
            if len(boards) != 1:
                what = f"prints {len(boards)} boards" if boards else "prints patches to cut out"
                raise DataError(f"the Design page {what}, expected one board")
            [board] = boards
        elif self.board_name == FILE_BOARD:
            board = self.board
        elif self.board_name != NO_BOARD:
            board = next(board for board in _shipped_boards() if board.name == self.board_name)
        is_own = self.detector == OWN_DETECTOR
        camera = self.camera if self.camera_name == FILE_CAMERA else None
        view_deg = self.view_deg if self.camera_name == VIEW_CAMERA else None
        patches = (self.design,) if is_own else ()
        return Look("template" if is_own else self.detector, patches, board, camera, view_deg)

    def watch(self, sources: Sequence[tuple[str, str]] | None = None) -> None:
        """Look at sources, or again at those before."""
        self.sources = self.sources if sources is None else list(sources)
        if self.sources:
            self.watcher.open(self.sources, self.look())

    def place_for(self, name: str, suffixes: Sequence[str]) -> Path:
        """Return a path of the folder for a file that a browser sends. Of its name, the path has the suffix alone.

        Raises
        ------
        DataError
            If the name has another suffix.
        """
        suffix = Path(name).suffix.lower()
        if suffix not in suffixes:
            raise DataError(f"{name}: expected a file ending in {', '.join(suffixes)}")
        return self.folder / f"{secrets.token_hex(8)}{suffix}"

    def take(self, name: str, path: Path) -> str:
        """Take a file of a board, a camera or a design, choose what it holds, and return that in a word.

        Raises
        ------
        KpbenchError
            If it holds none of them. The message has the name that the browser gave.
        """
        try:
            text = read_text(path, DataError)
            if path.suffix == ".toml" and "semicircles" in text:
                self.design = load_patch(path)
                return "design"
            if path.suffix == ".toml" or "kpbench.board" in text:
                designs = chosen_designs(self.design, PrintChoice(designs="mixed"))
                self.board, self.board_name = load_board(path, designs), FILE_BOARD  # which may not name other files
                return "board"
            self.camera, self.camera_name = read_camera(path), FILE_CAMERA
            return "camera"
        except KpbenchError as error:
            raise DataError(str(error).replace(str(path), name)) from None

    def drop(self, files: Sequence[tuple[str, Path]]) -> None:
        """Look at photographs and films that a browser sent, instead of those before, whose files are deleted.

        Refused files are deleted, too.

        Raises
        ------
        DataError
            If a file is named as a film, and is none. FFmpeg would take a list of other files for a film.
        """
        for name, path in files:
            if path.suffix in VIDEO_SUFFIXES and not FILM_HEAD.match(_head(path)):
                for _, refused in files:
                    refused.unlink(missing_ok=True)
                raise DataError(f"{name}: cannot be opened as a video, expected AVI, MP4, MOV, Matroska or WebM")
        self.watcher.close()
        for path in [Path(source) for _, source in self.sources]:
            if path.parent == self.folder:
                path.unlink(missing_ok=True)
        self.watch([(name, str(path)) for name, path in files])

    def offer(self, name: str, content: bytes) -> str:
        """Keep a download for a while. Return its address, which cannot be guessed."""
        key = secrets.token_urlsafe(16)
        self._downloads[key] = (name, content)
        while len(self._downloads) > MOST_DOWNLOADS:
            self._downloads.popitem(last=False)
        return f"/download/{key}"

    def fetch(self, key: str) -> tuple[str, bytes] | None:
        """Return name and content of a download, None if it is gone."""
        return self._downloads.get(key)


def _head(path: Path) -> bytes:
    with open_file(path, is_noted=False) as file:
        return file.read(16)


def _shipped_boards() -> list[Board]:
    return [board for name in ("hexagon", "grid", "truth", "field") for board in load_boards(name)]
