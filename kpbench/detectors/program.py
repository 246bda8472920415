"""Detectors that are programs. A program reads images from PNG files and writes a predictions file."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from kpbench.errors import DataError, system_reason
from kpbench.images import encode_png
from kpbench.predictions.files import read_predictions
from kpbench.types import Detections, UInt8


def _run(words: Sequence[str], stderr: Path) -> tuple[int, str]:
    """Run a program; return its exit code and its standard error. Bytes that are not UTF-8 are replaced by a mark.

    Standard error goes to a file, not to a pipe: a process that the program leaves behind would keep a pipe open. If
    kpbench is interrupted, the program and its children are killed.
    """
    with stderr.open("wb") as file:
        try:
            program = subprocess.Popen(
                words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=file, start_new_session=True
            )
        except (OSError, ValueError) as error:
            raise DataError(f"{words[0]}: cannot be started, {system_reason(error) or error}") from None
        try:
            code = program.wait()
        except BaseException:
            with suppress(OSError):
                os.killpg(program.pid, signal.SIGKILL)
            raise
    return code, stderr.read_text("utf-8", errors="replace")


def split_command(command: str) -> list[str]:
    """Return the program and the arguments of a command, quoted as for a shell.

    Raises
    ------
    DataError
        If there is no such program that may be executed, or a quotation does not end.
    """
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise DataError(f"{command}: no command, {error}") from None
    if not words or shutil.which(words[0]) is None:
        raise DataError(f"{command}: there is no program {words[0] if words else ''!r} that may be executed")
    return words


def run_program(command: str, images: Sequence[UInt8]) -> list[Detections]:
    """Run ``COMMAND FOLDER FILE`` over images.

    FOLDER holds the images as 00000000.png, 00000001.png, …. The program writes FILE, a predictions file in JSON. The
    ``image_id`` in FILE is the number in the image's name.

    Parameters
    ----------
    command : str
        Program and arguments, quoted as for a shell. No shell runs the command.
    images : sequence of ndarray
        (H, W) grey or (H, W, 3) RGB, uint8.

    Returns
    -------
    list of Detections
        One element per image.

    Raises
    ------
    DataError
        If the program cannot be started, ends with an exit code other than 0, writes no FILE, or leaves out an image.
    PredictionsError
        If FILE is not a predictions file.
    """
    with tempfile.TemporaryDirectory(prefix="kpbench-") as scratch:
        folder, out = Path(scratch) / "images", Path(scratch) / "predictions.json"
        folder.mkdir()
        for n, image in enumerate(images):
            try:
                (folder / f"{n:08d}.png").write_bytes(encode_png(image, "program-input"))
            except OSError as error:
                raise DataError(f"{folder}: cannot be written, {system_reason(error) or error}") from None
        code, stderr = _run([*split_command(command), str(folder), str(out)], Path(scratch) / "stderr")
        if code:
            lines = stderr.strip().splitlines() or ["nothing on stderr"]
            raise DataError(f"{command}: exit code {code}, {lines[-1]}")
        if not out.is_file():  # nothing, a folder, or a pipe, which would block the reader
            raise DataError(f"{command}: wrote no predictions file where its last argument says")
        found = read_predictions(out)
    by_image = dict(zip(found.image_id.tolist(), found.detections(), strict=True))
    missing = [n for n in range(len(images)) if n not in by_image]
    if missing:
        raise DataError(f"{command}: no prediction for image {missing[0]:08d}.png")
    return [by_image[n] for n in range(len(images))]
