"""Plain parsers of networks, pipelines, images and films; as in ``references.py``."""

from __future__ import annotations

import io
import json
import re
import struct
import zlib
from typing import Any

import numpy as np

from .references import Refusal, loads

# --- Networks and pipelines ----------------------------------------------------------------------------------------


def safetensors_header(data: bytes) -> dict[str, Any]:
    length = int.from_bytes(data[:8], "little")
    if length > len(data) - 8:
        raise ValueError("cut off")
    header: dict[str, Any] = loads(data[8 : 8 + length])
    return header


def checkpoint(data: bytes, found: Any) -> str:
    header = safetensors_header(data)
    body = data[8 + int.from_bytes(data[:8], "little") :]
    content, tensors = found
    if content != loads(header.pop("__metadata__")["kpbench"]):
        return "content differs"
    if header.keys() != tensors.keys():
        return "names differ"
    for name, entry in header.items():
        low, high = entry["data_offsets"]
        if entry["dtype"] == "F32" and tensors[name].numpy().tobytes() != body[low:high]:
            return "a tensor differs"
        if list(tensors[name].shape) != entry["shape"]:
            return "a shape differs"
    return ""


def pipeline_json(data: bytes, found: Any) -> str:
    return "" if json.dumps(loads(data), sort_keys=True) == found else "content differs"


def pipeline_yaml(data: bytes, found: Any) -> str:
    import yaml

    return "" if json.dumps(yaml.safe_load(data.decode("utf-8")), sort_keys=True) == found else "content differs"


# --- Images and films ----------------------------------------------------------------------------------------------


MODES = {
    "PNG": ("L", "RGB", "P", "1"),
    "JPEG": ("L", "RGB"),
    "PPM": ("L", "RGB"),
    "WEBP": ("RGB",),
    "TIFF": ("L", "RGB"),
}
"""Images on which decoders must agree, by format: opaque, of 8 bits, one frame."""


def png(data: bytes, found: Any) -> str:
    """Against the checksums and the length of the pixels, by hand; then as any image."""
    at, packed, header = 8, b"", b""
    while data[at + 4 : at + 8] not in (b"IEND", b""):
        length, name = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        content = data[at + 8 : at + 8 + length]
        if len(content) < length or not name:
            break  # cut off, which matters where pixels are missing
        if name in (b"IHDR", b"PLTE", b"IDAT") and zlib.crc32(name + content) != int.from_bytes(
            data[at + 8 + length :][:4], "big"
        ):
            raise Refusal("a wrong checksum of a PNG")
        packed += content if name == b"IDAT" else b""
        header = header or content
        at += 12 + length
    width, height, bits, colour, _, _, interlaced = struct.unpack(">IIBBBBB", header)
    row = 1 + -(-width * bits * {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colour] // 8)
    try:
        raw = zlib.decompressobj().decompress(packed, 2**24)
    except zlib.error:
        raise Refusal("damaged pixels of a PNG") from None
    if not interlaced and len(raw) < min(row * height, 2**24):
        raise Refusal("a PNG with too few pixels")
    return image(data, found)


def image(data: bytes, found: Any) -> str:
    """Against Pillow, for opaque images of 8 bits; a file whose pixels Pillow finds cut off was read in part."""
    from PIL import Image, ImageOps

    try:
        with Image.open(io.BytesIO(data)) as opened:
            kind, mode, clear = opened.format, opened.mode, "transparency" in opened.info
            oriented = opened.getexif().get(0x112)
            opened.load()
            if getattr(opened, "n_frames", 1) > 1 or mode not in MODES.get(kind, ()) or clear:
                return ""
            expected = np.asarray(ImageOps.exif_transpose(opened).convert("RGB"))
    except Exception as error:  # Pillow knows fewer kinds, and is strict where no pixel depends on it
        if isinstance(error, OSError) and re.search("truncated|broken data stream", str(error)):
            raise Refusal(f"a file whose pixels are cut off or damaged, {kind}") from None
        return ""
    got = found[0]
    if got is None:
        return ""
    if got.shape != expected.shape:
        turned = got.shape == (expected.shape[1], expected.shape[0], 3)
        if turned and oriented not in range(1, 9):  # a damaged EXIF block may be read in two ways
            return ""
        return f"size differs: {got.shape} of {expected.shape}"
    worst = int(np.abs(got.astype(int) - expected).max(initial=0))
    return f"pixels differ: by up to {worst}" if worst > (0 if kind in ("PNG", "PPM") else 40) else ""


def avi(data: bytes, found: Any) -> str:
    """Against the number of frames in the list ``movi``, where all chunks fit."""
    at = data.find(b"movi")
    if at < 8 or data[:4] != b"RIFF":
        return ""
    stop, count, at = at + int.from_bytes(data[at - 4 : at], "little"), 0, at + 4
    while at + 8 <= stop <= len(data):
        length = int.from_bytes(data[at + 4 : at + 8], "little")
        if data[at : at + 4] != b"00dc":
            return ""
        count += length > 0
        at += 8 + length + length % 2
    return _frames(found, count) if at == stop else ""


def mp4(data: bytes, found: Any) -> str:
    """Against the number of samples that the box ``stsz`` lists."""
    at = data.find(b"stsz")
    if at < 0 or data.count(b"stsz") > 1 or at + 16 > len(data):
        return ""
    _, size, count = struct.unpack_from(">III", data, at + 4)
    if size or count > 100 or int.from_bytes(data[at - 4 : at], "big") != 20 + 4 * count:
        return ""
    return _frames(found, count)


def _frames(found: list[Any], count: int) -> str:
    return "" if len(found) == count else f"number of frames differs: {len(found)} of {count}"
