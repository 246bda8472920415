"""Changes to images and films: files made of parts with lengths and checksums."""

from __future__ import annotations

import random
import struct
import zlib

from .trees import damage

SIDES = (0, 1, 2, 3, 5, 7, 9, 31, 64, 1000, 4096, 16384, 20000, 32767, 65500, 65535, 2**20, 2**31 - 1, 2**31, 2**32 - 1)
LENGTHS = (0, 1, 3, 4, 7, 8, 100, 2**16, 600 * 2**20, 2**30, 2**31 - 1, 2**31, 2**32 - 1, 2**32 - 245)


# --- PNG -----------------------------------------------------------------------------------------------------------


def png_chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    """The (name, content) of each chunk; raises ValueError where the chunks do not follow each other to IEND."""
    if data[:8] != b"\x89PNG\r\n\x1a\n":
        raise ValueError("no PNG signature")
    chunks, at = [], 8
    while at < len(data):
        if at + 12 > len(data):
            raise ValueError("cut off")
        length = int.from_bytes(data[at : at + 4], "big")
        if at + 12 + length > len(data):
            raise ValueError("cut off")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
        if chunks[-1][0] == b"IEND":
            return chunks
    raise ValueError("no IEND")


def join_png(chunks: list[tuple[bytes, bytes]]) -> bytes:
    parts = [struct.pack(">I", len(c)) + n + c + struct.pack(">I", zlib.crc32(n + c)) for n, c in chunks]
    return b"".join([b"\x89PNG\r\n\x1a\n", *parts])


def mutate_png(rng: random.Random, data: bytes) -> bytes:
    """Change chunks, their order or what they hold, mostly with sound checksums."""
    chunks = png_chunks(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        n = rng.randrange(len(chunks))
        name, content = chunks[n]
        kind = rng.randrange(10)
        if kind <= 2:
            n = 0
            fields = list(struct.unpack(">IIBBBBB", chunks[0][1].ljust(13, b"\0")[:13]))
            k = rng.randrange(7)
            fields[k] = rng.choice(SIDES) if k < 2 else rng.choice((0, 1, 2, 3, 4, 5, 6, 8, 16, 32, 255))
            if k < 2 and rng.random() < 0.5:
                fields[k] = rng.randrange(1, 60)
            chunks[0] = (b"IHDR", struct.pack(">IIBBBBB", *fields))
        elif kind == 3:
            extra = (
                b"tRNS",
                b"gAMA",
                b"iCCP",
                b"sRGB",
                b"pHYs",
                b"bKGD",
                b"PLTE",
                b"eXIf",
                b"acTL",
                b"fcTL",
                b"zTXt",
                b"cHRM",
            )
            content = rng.choice(
                (rng.randbytes(rng.choice((0, 1, 4, 6, 26, 32, 300))), b"x\0\0" + zlib.compress(bytes(10**6)))
            )
            chunks.insert(rng.randrange(1, len(chunks)) if len(chunks) > 1 else 0, (rng.choice(extra), content))
        elif kind == 4 and len(chunks) > 1:
            del chunks[n]
        elif kind == 5:
            chunks.insert(n, chunks[rng.randrange(len(chunks))])
        elif kind == 6:
            other = rng.randrange(len(chunks))
            chunks[n], chunks[other] = chunks[other], chunks[n]
        elif name == b"IDAT" and kind == 7:
            try:
                raw = damage(rng, zlib.decompress(content))
                chunks[n] = (name, zlib.compress(raw))
            except zlib.error:
                chunks[n] = (name, damage(rng, content))
        else:
            chunks[n] = (name, damage(rng, content))
    out = join_png(chunks)
    kind = rng.random()
    if kind < 0.05:
        at = out.find(chunks[rng.randrange(len(chunks))][0]) - 4
        return out[: max(at, 8)] + struct.pack(">I", rng.choice(LENGTHS)) + out[max(at, 8) + 4 :]
    return damage(rng, out) if kind < 0.15 else out


# --- JPEG ----------------------------------------------------------------------------------------------------------


def jpeg_segments(data: bytes) -> tuple[list[tuple[int, bytes]], bytes]:
    """The (marker, content) of each segment up to the scan, and the rest; raises ValueError if there is no scan."""
    if data[:2] != b"\xff\xd8":
        raise ValueError("no JPEG")
    segments, at = [], 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        segments.append((marker, data[at + 4 : at + 2 + length]))
        at += 2 + length
        if marker == 0xDA:
            return segments, data[at:]
    raise ValueError("no scan")


def mutate_jpeg(rng: random.Random, data: bytes) -> bytes:
    """Change segments (sizes, sampling, tables, orientation) or the scan."""
    segments, scan = jpeg_segments(data)
    for _ in range(rng.choice((1, 1, 2))):
        n = rng.randrange(len(segments))
        marker, content = segments[n]
        kind = rng.randrange(8)
        frame = next(
            (k for k, (m, _) in enumerate(segments) if 0xC0 <= m <= 0xCF and m not in (0xC4, 0xC8, 0xCC)), None
        )
        if kind <= 1 and frame is not None:
            m, c = segments[frame]
            part = bytearray(c)
            if kind == 0:
                part[1:5] = struct.pack(">HH", *(rng.choice((*SIDES[:15], 24, 30, 32)) & 0xFFFF for _ in range(2)))
            else:
                part[rng.choice((0, 5, *range(6, len(part))))] = rng.choice(
                    (0, 1, 2, 3, 4, 8, 12, 0x11, 0x22, 0x44, 0xFF)
                )
            segments[frame] = (rng.choice((m, m, m, 0xC0, 0xC1, 0xC2, 0xC3, 0xC9)), bytes(part))
        elif kind == 2:
            exif = (
                b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0"
                + bytes([rng.randrange(12), 0, 0, 0])
                + bytes(4)
            )
            segments.insert(0, (0xE1, exif if rng.random() < 0.7 else damage(rng, exif)))
        elif kind == 3:
            segments.insert(
                n, (rng.choice((0xDD, 0xFE, 0xE0, 0xE2, 0xEE, 0xDB, 0xC4)), rng.randbytes(rng.choice((2, 5, 12, 65))))
            )
        elif kind == 4:
            scan = damage(rng, scan)
        elif kind == 5 and marker != 0xDA and rng.random() < 0.5:
            del segments[n]
        else:
            segments[n] = (marker, damage(rng, content)[:65000])
    parts = [struct.pack(">BBH", 0xFF, m, (len(c) + 2) & 0xFFFF) + c for m, c in segments]
    out = b"".join([b"\xff\xd8", *parts, scan])
    return damage(rng, out) if rng.random() < 0.1 else out


# --- TIFF ----------------------------------------------------------------------------------------------------------


def mutate_tiff(rng: random.Random, data: bytes) -> bytes:
    """Change entries of the directory: sizes, bits, compression, places of the strips."""
    order = "<" if data[:2] == b"II" else ">"
    out = bytearray(data)
    (at,) = struct.unpack_from(order + "I", out, 4)
    (count,) = struct.unpack_from(order + "H", out, at)
    for _ in range(rng.choice((1, 1, 2, 3))):
        place = at + 2 + 12 * rng.randrange(count)
        kind = rng.randrange(10)
        if kind == 0:
            tags = (
                254,
                256,
                257,
                258,
                259,
                262,
                273,
                274,
                277,
                278,
                279,
                284,
                317,
                320,
                322,
                323,
                324,
                338,
                339,
                347,
                34675,
            )
            struct.pack_into(order + "H", out, place, rng.choice(tags))
        elif kind == 1:
            struct.pack_into(order + "H", out, place + 2, rng.randrange(20))
        elif kind == 2:
            struct.pack_into(order + "I", out, place + 4, rng.choice((0, 1, 2, 3, 4, 100, 2**16, 2**31, 2**32 - 1)))
        elif kind <= 7:
            width = struct.unpack_from(order + "H", out, place + 2)[0]
            low = rng.choice((*range(10), 16, 32, 64, 32773, 50000, rng.randrange(256)))
            number = rng.choice((low, low, rng.choice(SIDES)))
            code, most = ("H", 2**16) if width == 3 else ("I", 2**32)
            struct.pack_into(order + code, out, place + 8, number % most)
        elif kind == 8:
            struct.pack_into(order + "I", out, at + 2 + 12 * count, rng.choice((0, 8, at, len(out), 2**32 - 1)))
        else:
            return damage(rng, bytes(out))
    return bytes(out)


# --- Films ---------------------------------------------------------------------------------------------------------


def mutate_riff(rng: random.Random, data: bytes) -> bytes:
    """Change an AVI: numbers in its headers, lengths of its chunks, bytes of its frames."""
    return _mutate_parts(rng, data, _riff_parts(data), "<I")


def mutate_boxes(rng: random.Random, data: bytes) -> bytes:
    """Change an MP4: numbers in its boxes, their lengths, bytes of its frames."""
    return _mutate_parts(rng, data, _box_parts(data, 0, len(data)), ">I")


def _riff_parts(data: bytes) -> list[tuple[int, int]]:
    """Place and length of what each chunk holds."""
    parts, at = [], 12
    while at + 8 <= len(data):
        name, length = data[at : at + 4], int.from_bytes(data[at + 4 : at + 8], "little")
        parts.append((at + 8, min(length, len(data) - at - 8)))
        at += 12 if name == b"LIST" else 8 + length + length % 2
    return parts


def _box_parts(data: bytes, at: int, stop: int) -> list[tuple[int, int]]:
    parts = []
    while at + 8 <= stop:
        length, name = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        if length < 8:
            break
        parts.append((at + 8, min(length, stop - at) - 8))
        if name in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):
            parts += _box_parts(data, at + 8, min(at + length, stop))
        at += length
    return parts


def _mutate_parts(rng: random.Random, data: bytes, parts: list[tuple[int, int]], number: str) -> bytes:
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 3))):
        at, length = rng.choice(parts)
        kind = rng.randrange(10)
        if kind == 0:
            struct.pack_into(number, out, at - (8 if number == ">I" else 4), rng.choice(LENGTHS))
        elif kind == 1 and at + length <= len(out):
            return bytes(out[: at - 8] + out[at + length :])
        elif kind == 2:
            return bytes(out[:at] + out[at - 8 : at + length] + out[at:])
        elif kind <= 6 and length >= 4:
            place = at + 4 * rng.randrange(min(length // 4, 40))
            old = struct.unpack_from(number, out, place)[0]
            new = rng.choice((rng.choice(LENGTHS), rng.choice(SIDES), old + 1, old * 2, rng.randrange(256)))
            struct.pack_into(number, out, place, new % 2**32)
        elif length > 0:
            return damage(rng, bytes(out), at, at + length)
    return bytes(out)
