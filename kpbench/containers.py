"""Containers of films: find damage in AVI, MP4 and Matroska files of which FFmpeg would make other frames.

All consist of parts, each with a name and a length, which hold further parts. FFmpeg searches for frames behind a
part whose length is damaged. It then repeats frames, leaves frames out, or takes much memory.
"""

from __future__ import annotations

import mmap
import re
import struct
from collections.abc import Iterator
from pathlib import Path

from kpbench.errors import DataError
from kpbench.files import open_file, require_readable

PART, PART_WITH_FRAMES = (
    re.compile(rb"(?![0-9]{2}(dc|db|wb|pc))[ -~]{4}"),
    re.compile(rb"[0-9A-Fa-f]{2}[ -~]{2}|ix..|JUNK|LIST"),
)
"""Names of the parts of an AVI outside of the list of frames, and within."""
CODEC = re.compile(rb"[ -~]{4}|.\x00\x00\x00", re.DOTALL)
"""The codec of a stream of pictures in an AVI: four letters, or a small number."""
EBML, SIMPLE_BLOCK = b"\x1a\x45\xdf\xa3", b"\xa3"
SEGMENT, CLUSTER, GROUP = b"\x18\x53\x80\x67", b"\x1f\x43\xb6\x75", b"\xa0"
"""Elements of Matroska and WebM (RFC 9559): the head, the film, a second or so of it, a frame with what it needs."""
MOST_VP8_PIXELS = 2**26
"""Largest number of pixels of a frame of VP8."""
LARGEST_ELEMENT = 2**26
"""Largest number of bytes of an element that is cut off: FFmpeg takes memory for what an element declares."""
BOXES = (b"moov", b"trak", b"mdia", b"minf", b"stbl")
"""Boxes of MP4 that hold the boxes of a track (ISO 14496-12)."""


def require_sound_container(path: Path) -> None:
    """Refuse an AVI, an MP4 or a Matroska file with damaged lengths or tables. A file that is cut off is accepted.

    Raises
    ------
    DataError
        The message names the place.
    """
    require_readable(path)
    with open_file(path) as file:
        if not file.read(1):
            return  # OpenCV refuses an empty file
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            try:
                if data[:4] == b"RIFF" and data[8:12] == b"AVI ":
                    _check_avi(data)
                elif data[4:8] in (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide"):
                    _check_mp4(data)
                elif data[:4] == EBML:
                    _check_matroska(data, 0, len(data))
            except (ValueError, struct.error) as problem:
                raise DataError(
                    f"{path}: its container is damaged ({problem}); `ffmpeg -i FILE -c copy NEW` may repair it"
                ) from None


def _check_avi(data: mmap.mmap) -> None:
    at = 0
    while data[at : at + 4] in (b"RIFF", b"JUNK"):  # further parts of a large file, and kpbench's mark
        length = int.from_bytes(data[at + 4 : at + 8], "little")
        stop = at + 8 + length
        if data[at : at + 4] == b"RIFF":
            stop = _end_of_list(at, length, len(data))
            _check_chunks(data, at + 12, stop, b"RIFF")
        at = stop + stop % 2


def _end_of_list(at: int, length: int, stop: int) -> int:
    """Return where a list ends. A recording that was interrupted has not stated its length."""
    return stop if length in (0, 2**32 - 1) else at + 8 + length


def _check_chunks(data: mmap.mmap, at: int, stop: int, parent: bytes) -> None:
    is_video = parent == b"strl" and data[at + 8 : at + 12] == b"vids"
    while at + 8 <= min(stop, len(data)):
        name, length = data[at : at + 4], int.from_bytes(data[at + 4 : at + 8], "little")
        kind = data[at + 8 : at + 12] if name == b"LIST" else b""
        end = _end_of_list(at, length, stop) if kind == b"movi" else at + 8 + length
        holds_frames = parent in (b"movi", b"rec ")
        if not (PART_WITH_FRAMES if holds_frames else PART).fullmatch(name):
            raise ValueError(f"at byte {at}: a part with the name {name!r}")
        is_cut_off = stop >= len(data) and (holds_frames or parent == b"RIFF")
        if end > stop and not is_cut_off:
            raise ValueError(f"at byte {at}: a part of {length} bytes, of which {stop - at - 8} are there")
        if is_video and name == b"strf" and not CODEC.fullmatch(codec := data[at + 24 : at + 28]):
            raise ValueError(f"at byte {at}: a codec with the name {codec!r}")
        if kind in (b"hdrl", b"strl", b"movi", b"rec "):
            _check_chunks(data, at + 12, end, kind)
        at = end + length % 2


def _check_matroska(data: mmap.mmap, at: int, stop: int) -> None:
    while at < min(stop, len(data)):
        name_bytes, size_bytes = _length_of_number(data[at]), 0
        if at + name_bytes < len(data):
            size_bytes = _length_of_number(data[at + name_bytes])
        name, start = data[at : at + name_bytes], at + name_bytes + size_bytes
        size = int.from_bytes(data[at + name_bytes : start], "big") & ((1 << 7 * size_bytes) - 1)
        is_list, is_unknown = name in (SEGMENT, CLUSTER, GROUP), size == (1 << 7 * size_bytes) - 1
        end = stop if is_unknown and is_list else start + size
        if (
            not name_bytes
            or not size_bytes
            or (end > stop and (stop < len(data) or size > LARGEST_ELEMENT) and not is_list)
        ):
            raise ValueError(
                f"at byte {at}: a part {name.hex()} of {size} bytes, of which {max(0, stop - start)} are there"
            )
        if is_list:
            _check_matroska(data, start, min(end, stop))
        elif name == SIMPLE_BLOCK:
            _check_vp8_frame(data, start + 4)
        at = end


def _check_vp8_frame(data: mmap.mmap, at: int) -> None:
    """Refuse a frame of VP8 (RFC 6386, 9.1) that declares many pixels: FFmpeg takes memory for them."""
    if data[at + 3 : at + 6] == b"\x9d\x01\x2a" and data.find(b"V_VP8", 0, 2**16) >= 0:
        width, height = (side & 0x3FFF for side in struct.unpack_from("<HH", data, at + 6))
        if width * height > MOST_VP8_PIXELS:
            raise ValueError(f"at byte {at}: a frame of {width} x {height} pixels")


def _length_of_number(first: int) -> int:
    """Return the number of bytes of a number of EBML, from its first byte; 0 if there is no such number."""
    return 9 - first.bit_length() if first else 0


def _check_mp4(data: mmap.mmap) -> None:
    for name, at, stop in _boxes(data, 0, len(data)):
        if name == b"moov":
            for part, low, high in _boxes(data, at, stop):
                if part == b"trak":
                    _check_track(data, low, high)


def _check_track(data: mmap.mmap, at: int, stop: int) -> None:
    """Compare the number of frames in the table of times and in the table of sizes."""
    tables = dict[bytes, tuple[int, int]]()
    left = [(at, stop)]
    while left:
        for name, low, high in _boxes(data, *left.pop()):
            if name in BOXES:
                left.append((low, high))
            tables[name] = low, high
    if not {b"hdlr", b"stts", b"stsz"} <= tables.keys():
        return
    handler = tables[b"hdlr"][0] + 8
    if data[handler : handler + 4] != b"vide":
        return
    (times, times_end), sizes = tables[b"stts"], tables[b"stsz"][0]
    (entries,), (sized,) = struct.unpack_from(">I", data, times + 4), struct.unpack_from(">I", data, sizes + 8)
    if times + 8 + 8 * entries > times_end:
        raise ValueError(f"at byte {times}: {entries} times, which do not fit")
    timed = sum(count for count, _ in struct.iter_unpack(">II", data[times + 8 : times + 8 + 8 * entries]))
    if timed != sized:
        raise ValueError(f"at byte {times}: times of {timed} frames, sizes of {sized}")


def _boxes(data: mmap.mmap, at: int, stop: int) -> Iterator[tuple[bytes, int, int]]:
    """Yield name, start and end of the content of each box."""
    while at + 8 <= stop:
        (length, name), head = struct.unpack_from(">I4s", data, at), 8
        if length == 1 and at + 16 <= stop:
            (length,), head = struct.unpack_from(">Q", data, at + 8), 16
        end = stop if length == 0 else at + length
        if (length and length < head) or (end > stop and stop < len(data)):
            raise ValueError(f"at byte {at}: a part {name!r} of {length} bytes, of which {stop - at} are there")
        yield name, at + head, min(end, stop)
        at = end
