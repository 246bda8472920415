"""Write and remove files, by these rules:

1. A file appears whole or not at all.
2. A file that exists is replaced only if it is empty, or if kpbench wrote it as a file of the same kind. A mark in each
   file names the kind: a text such as ``kpbench.predictions/2``, in the place that the form of the file has for it.
3. A command never writes to a file that it reads.
4. A symbolic link is followed. Data for a device or a pipe go into the device or pipe, which is not replaced.
5. A new file gets its mode from the umask. A replaced file keeps its mode.
"""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from kpbench.errors import DataError, system_reason
from kpbench.files import is_local, is_read

_MARK = rb"kpbench\.(?P<kind>[a-z-]+)/\d+"
_TEXT_MARKS = [
    re.compile(pattern.replace(b"MARK", _MARK), re.DOTALL)
    for pattern in (
        rb'\s*\{\s*"schema"\s*:\s*"MARK"',  # JSON, and JSON Lines
        rb'\{"info": \{"description": "kpbench dataset \(MARK\)"',  # COCO
        rb'# \{"schema": "MARK"',  # CSV of predictions
        rb"schema,[^\n]*\nMARK,",  # CSV of scores
        rb'<!doctype html>\n(?:<[^\n]*\n){1,9}?<meta name="generator" content="MARK">\n',
        rb"<\?xml [^\n]*\n<svg [^\n]*\n<!-- MARK -->\n",  # SVG
        rb"<!-- MARK -->\n",  # Markdown of a report
        rb"---\n(?:[^\n]+\n){1,9}---\n\n<!-- MARK: kpbench replaces this file ",  # Markdown of a dataset's card
        rb"% MARK\n",  # LaTeX
        rb"# MARK\ntrain: images(?:/train)?\n",  # YAML of an export
        rb"(?:%YAML:1\.0\n---\n)?# MARK\n(?:image_width|cam0):",  # YAML of a calibration
        rb"(?:%YAML:1\.0\n---\n)?##? MARK\n(?:object_points|target_type|# point)",  # a board for another program
        rb"999\nMARK\n",  # DXF
        rb"MARK (?:coco|yolo|webdataset|parquet) [0-9a-f]{64}\n",  # state of an export
    )
]
"""The start of each form of text that kpbench writes. In a text of any other form, a mark is a quotation."""
_BINARY_MARKS = [
    (re.compile(start, re.DOTALL), re.compile(pattern.replace(b"MARK", _MARK), re.DOTALL))
    for start, pattern in (
        (rb"\x89PNG\r\n\x1a\n", rb"tEXtSoftware\0MARK"),
        (rb"\xff\xd8\xff\xfe\0.", rb"\A....\0.MARK"),  # JPEG whose first segment is a comment
        (rb"%PDF-", rb"/Keywords \(MARK\)"),
        (rb"....ftyp|RIFF|\x1aE\xdf\xa3", rb"MARK \Z"),  # films
        (rb"PAR1", rb'\{"schema": "MARK"'),  # Parquet
        (rb'.{8}\{"__metadata__":', rb'\{\\"schema\\": \\"MARK\\"'),  # safetensors
        # the last two forms also hold designs, each with the mark of a design
        (rb"\x89HDF\r\n\x1a\n", rb"kpbench\.(?P<kind>dataset|predictions)/\d+"),
        (rb"\x08[\x01-\x20]", rb'"schema": "kpbench\.(?P<kind>superpoint|verifier)/\d+"'),  # ONNX
    )
]
"""The start of each binary form that kpbench writes, and how a mark stands in the form."""
HEAD_BYTES, TAIL_BYTES = 65536, 16384
"""The mark of a binary form lies in the first ``HEAD_BYTES`` bytes or in the last ``TAIL_BYTES`` bytes of a file."""


def kind_of(head: bytes, tail: bytes = b"") -> str | None:
    """Return the kind that the mark of a file names; None if kpbench did not write the file.

    A mark counts only in the place where kpbench's own writer of the form puts it.
    """
    text = head.replace(b"\r\n", b"\n")  # git may have changed the ends of lines
    found = next(filter(None, (pattern.match(text) for pattern in _TEXT_MARKS)), None)
    for start, pattern in () if found else _BINARY_MARKS:
        if start.match(head):
            found = pattern.search(head) or pattern.search(tail)
            break
    return found["kind"].decode() if found else None


def write_file(path: Path, data: bytes | memoryview) -> None:
    """Write a file whole or not at all.

    On this machine, the data go into a temporary file in the same folder. The temporary file is synced to the disk and
    renamed, and the folder is synced. At a URL, the data are sent in one piece. Object stores write a piece whole or
    not at all.

    Raises
    ------
    DataError
        If the file exists and kpbench did not write it, or wrote it as a file of another kind. If the running command
        reads the file. If the disk is full or the folder cannot be written. No temporary file is left behind.
    """
    if not is_local(path):
        with _remote_errors(path):
            path.write_bytes(bytes(data))
        return
    with _one_line_errors(path):
        target, mode = _find_target(path)
        if mode is not None and not stat.S_ISREG(mode):
            with open(target, "wb") as device:
                device.write(data)
            return
        if mode is not None:
            if target.stat().st_size == len(data) and target.read_bytes() == data:
                return
            _require_replaceable(path, target, kind_of(bytes(data[:HEAD_BYTES]), bytes(data[-TAIL_BYTES:])))
        part = target.with_name(f".{target.name}.{secrets.token_hex(4)}.part")
        try:
            with open(part, "xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            _put_in_place(part, target, mode)
        except BaseException:
            with suppress(OSError):
                os.unlink(part)
            raise


def move_file(part: Path, path: Path) -> None:
    """Move a finished file to a path, under the rules of :func:`write_file`.

    ``part`` lies in the folder of ``path``. If ``path`` is a device or a pipe, the data are copied and ``part`` stays.

    Raises
    ------
    DataError
        As :func:`write_file`.
    """
    with _one_line_errors(path):
        target, mode = _find_target(path)
        if mode is not None and not stat.S_ISREG(mode):
            with open(part, "rb") as file, open(target, "wb") as device:
                shutil.copyfileobj(file, device)
            return
        if mode is not None:
            _require_replaceable(path, target, kind_of(*_ends(part)))
        with open(part, "rb") as file:
            os.fsync(file.fileno())
        _put_in_place(part, target, mode)


def is_replaceable(path: Path, kind: str) -> bool:
    """Return whether a path has no file, or a file of this kind. A path at a URL is not checked and gives True."""
    return not is_local(path) or not path.exists() or kind_of(*_ends(path)) == kind


def require_writable(path: Path, kind: str) -> None:
    """Refuse, before any work is done, a path that :func:`write_file` would refuse after the work.

    Raises
    ------
    DataError
        If there is no folder for the file, or the folder cannot be written, or the file must not be replaced.
    """
    if not is_local(path):
        return
    with _one_line_errors(path):
        target, mode = _find_target(path)
        if mode is not None and not stat.S_ISREG(mode):
            return
        if mode is not None:
            _require_replaceable(path, target, kind)
        if not target.parent.is_dir():
            raise DataError(f"{path}: cannot be written, there is no folder {path.parent}")
        if not os.access(target.parent, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))


def require_space(folder: Path, needed: int, purpose: str, of_empty_disk: bool = False) -> None:
    """Refuse, before any work is done, to write more bytes than the disk has free, or than an empty disk would have.

    Raises
    ------
    DataError
        The message says how much space the purpose needs.
    """
    if not is_local(folder):
        return
    with _one_line_errors(folder):
        usage = shutil.disk_usage(folder)
    space, word = (usage.total, "in all") if of_empty_disk else (usage.free, "free")
    if needed > space:
        raise DataError(
            f"{folder}: {purpose} need about {_format_bytes(needed)}, the disk has {_format_bytes(space)} {word}"
        )


def _format_bytes(count: float) -> str:
    """Return a number of bytes for people, such as 12.3 MB."""
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if count < 1000 or unit == "TB":
            break
        count /= 1000
    return f"{count:.3g} {unit}"


def remove_file(path: Path, kind: str) -> None:
    """Remove a file that kpbench wrote as a file of this kind. Ignore a missing file.

    Raises
    ------
    DataError
        If kpbench did not write the file, or wrote it as a file of another kind.
    """
    require_removable(path, kind)
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise DataError(f"{path}: cannot be removed, {system_reason(error) or error}") from None


def require_removable(path: Path, kind: str) -> None:
    """Refuse a file that :func:`remove_file` would refuse.

    Raises
    ------
    DataError
        As :func:`remove_file`.
    """
    try:
        if is_local(path) and path.exists() and path.stat().st_size and kind_of(*_ends(path)) != kind:
            raise DataError(f"{path}: would be removed, but kpbench did not write it; move it elsewhere")
    except OSError as error:
        raise DataError(f"{path}: cannot be read, {system_reason(error) or error}") from None


def is_leftover(path: Path) -> bool:
    """Return whether a path has the name of an unfinished part of a file."""
    return re.fullmatch(r"\..+\.[0-9a-f]{8}\.part", path.name) is not None


def remove_leftovers(paths: Iterable[Path]) -> None:
    """Remove the unfinished parts of files that a killed process left behind. Files at URLs have no such parts."""
    names: dict[Path, set[str]] = {}
    for path in paths:
        if is_local(path):
            names.setdefault(path.parent, set()).add(path.name)
    for folder, wanted in names.items():
        for part in folder.glob(".*.part"):
            if part.name[1:-14] in wanted:  # .NAME.01234567.part
                with suppress(OSError):
                    part.unlink()


def _find_target(path: Path) -> tuple[Path, int | None]:
    """Follow symbolic links. Return the file that will be written, and its mode. The mode of a missing file is None."""
    target = Path(os.path.realpath(path))
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        return target, None
    if stat.S_ISDIR(mode):
        raise DataError(f"{path}: cannot be written, it is a folder")
    return target, mode


def _require_replaceable(path: Path, target: Path, kind: str | None) -> None:
    """Refuse to replace a file by a file of this kind if the running command reads the file, or if its kind differs."""
    if is_read(target):
        raise DataError(f"{path}: this command reads it; name another file to write")
    if not target.stat().st_size:
        return
    old = kind_of(*_ends(target))
    if old is None:
        raise DataError(f"{path}: exists, and kpbench did not write it; name another file, or move it elsewhere")
    if old != kind:
        raise DataError(f"{path}: exists, and is a file of another kind (kpbench.{old}); name another file to write")


def _put_in_place(part: Path, target: Path, mode: int | None) -> None:
    if mode is not None:
        os.chmod(part, stat.S_IMODE(mode))
    os.replace(part, target)
    with suppress(OSError):  # some file systems do not let a folder be opened
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _ends(path: Path) -> tuple[bytes, bytes]:
    """Return the first and the last bytes of a file."""
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
        file.seek(max(0, os.fstat(file.fileno()).st_size - TAIL_BYTES))
        return head, file.read()


@contextmanager
def _one_line_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise DataError(f"{path}: cannot be written, {system_reason(error) or error}") from None


@contextmanager
def _remote_errors(path: Path) -> Iterator[None]:
    """Turn every error of a remote file system into one line."""
    try:
        yield
    except Exception as error:
        raise DataError(f"{path}: cannot be written ({' '.join(str(error).split())[:160]})") from None
