"""Changes to trees of dictionaries, lists and values, as JSON, TOML and YAML hold them, and to plain bytes."""

from __future__ import annotations

import copy
import random
from collections.abc import Callable
from typing import Any, NamedTuple

Tree = Any


class Raw(str):
    """Text that a writer puts into the file as it is, where no Python value has that text."""


class Slot(NamedTuple):
    """A place in a tree: ``parent[key]``."""

    parent: Any
    key: Any

    @property
    def value(self) -> Any:
        """What is in the place."""
        return self.parent[self.key]


NUMBERS: tuple[Any, ...] = (
    *(0, 1, -1, 2, 3, 7, 255, 256, 32767, 32768, 65536, 10**6, 2**31 - 1, 2**31, 2**32, 10**9),
    *(2**53, 2**53 + 1, 2**63 - 1, 2**63, -(2**63), -(2**63) - 1, 2**64 - 1, 2**64, 10**30),
    *(-0.0, 0.5, 1e-3, 1e-40, 5e-324, 1e6, 3.5e38, 1e300, 1.7976931348623157e308, -1e300, 0.1 + 0.2, 1.0, 2.0),
    *(float("nan"), float("inf"), float("-inf")),
)
RAW_NUMBERS = ("1e400", "-1e400", "1e-400", "1E5", "1e+2", "-0", "01", "+1", "1.", ".5", "0x10", "1_000", "9" * 400)
RAW_NUMBERS = tuple(map(Raw, (*RAW_NUMBERS, "9" * 5000, "0." + "1" * 400, "NaN", "Infinity", "nan", "-inf", "1e", "-")))
TEXTS = (
    *("", " ", "a", "0", "1", "1.5", "-1", "nan", "inf", "true", "null", "\u0661", "1e400", "9" * 400),
    *(
        "a\nb",
        "a\r\nb",
        "\x00",
        "a\x00b",
        "\x1b[31mred",
        "\x7f",
        "\x85",
        "\u2028",
        "\u202e",
        "\ud800",
        "\udfff",
        "\ufeff",
    ),
    *(
        "..",
        ".",
        "/",
        "../../x",
        "/etc/passwd",
        "a/b",
        "a\\b",
        "C:\\x",
        "~",
        "file:///etc/passwd",
        "s3://a/b",
        "%s",
        "{0}",
    ),
    *("=1+1", "@x", "\\input{x}", "<script>", "|", "`x`", "$(x)", "e\u0301", "\U0001f600", "a" * 300, "a" * 20_000),
)
EMPTY: tuple[Any, ...] = (None, True, False, [], {}, [[]], [None], {"": None})
KEYS = ("", " ", "a", "id", "name", "schema", "version", "__class__", "a.b", "a\nb", "\x1b[31m", "\ud800", "x" * 300)


def mutate_tree(rng: random.Random, tree: Tree, often: tuple[str, ...] = ()) -> Tree:
    """Change a copy of a tree in one to three places; values below keys in ``often`` are chosen more often."""
    holder = [copy.deepcopy(tree)]
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        slots = [slot for slot in slots_of(holder) if isinstance(slot.parent, dict | list)]
        if not slots:
            break
        named = [slot for slot in slots if slot.key in often]
        slot = rng.choice(named if named and rng.random() < 0.5 else slots)
        if slot.parent is holder and len(slots) > 1 and rng.random() < 0.9:  # rarely the whole file
            slot = rng.choice(slots[1:])
        rng.choices(CHANGES, WEIGHTS)[0](rng, slot, slots)
    return holder[0]


def slots_of(root: list[Any]) -> list[Slot]:
    """All places of a tree, from the root on."""
    found = [Slot(root, 0)]
    for slot in found:
        value = slot.value
        if isinstance(value, dict):
            found.extend(Slot(value, key) for key in value)
        elif isinstance(value, list):
            found.extend(Slot(value, n) for n in range(min(len(value), 60)))
    return found


def odd_value(rng: random.Random, value: Any) -> Any:
    """A value in place of another, of the same type in half of all cases."""
    if rng.random() < 0.5:
        if isinstance(value, bool) or value is None:
            return copy.deepcopy(rng.choice(EMPTY))
        if isinstance(value, int | float):
            return rng.choice(NUMBERS) if rng.random() < 0.8 else rng.choice(RAW_NUMBERS)
        if isinstance(value, str):
            return rng.choice(TEXTS)
    return copy.deepcopy(rng.choice((*NUMBERS, *RAW_NUMBERS, *TEXTS, *EMPTY, *EMPTY)))


def _replace(rng: random.Random, slot: Slot, slots: list[Slot]) -> None:
    slot.parent[slot.key] = odd_value(rng, slot.value)


def _nudge(rng: random.Random, slot: Slot, slots: list[Slot]) -> None:
    """A value close to the one that is there."""
    value = slot.value
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300:
        by: tuple[Callable[[Any], Any], ...] = (
            *(lambda v: v + 1, lambda v: v - 1, lambda v: -v, lambda v: v * 2, lambda v: v / 2, lambda v: v + 1e-9),
            *(float, int, str, bool, lambda v: [v], lambda v: v * 1e9, lambda v: v + 2**32, lambda v: v + 2**64),
        )
        slot.parent[slot.key] = rng.choice(by)(value)
    elif isinstance(value, str) and value:
        at = rng.randrange(len(value))
        odd = rng.choice(("", " ", "\n", "\x00", "0", "/", value[at].swapcase(), rng.choice(TEXTS)))
        slot.parent[slot.key] = value[:at] + odd + value[at + 1 :]
    else:
        _replace(rng, slot, slots)


def _delete(rng: random.Random, slot: Slot, slots: list[Slot]) -> None:
    if slot.parent is not slots[0].parent:
        del slot.parent[slot.key]


def _duplicate(rng: random.Random, slot: Slot, slots: list[Slot]) -> None:
    if isinstance(slot.parent, list) and slot.parent is not slots[0].parent:
        times = rng.choice((1, 1, 1, 2, 50, 500)) if len(slots) < 400 else 1
        slot.parent[slot.key : slot.key] = [copy.deepcopy(slot.value) for _ in range(times)]
    elif isinstance(slot.parent, dict):
        slot.parent[_odd_key(rng, slot.key)] = copy.deepcopy(slot.value)


def _odd_key(rng: random.Random, key: str) -> str:
    near = (key.upper(), key[:-1], key + "s", key + " ", key.replace("_", "-"))
    return rng.choice((*near, *KEYS))


def _rename(rng: random.Random, slot: Slot, slots: list[Slot]) -> None:
    if isinstance(slot.parent, dict):
        slot.parent[_odd_key(rng, slot.key)] = slot.parent.pop(slot.key)


def _add(rng: random.Random, slot: Slot, slots: list[Slot]) -> None:
    if isinstance(slot.parent, dict):
        slot.parent[rng.choice(KEYS)] = odd_value(rng, slot.value)
    elif slot.parent is not slots[0].parent:
        slot.parent.insert(slot.key, odd_value(rng, slot.value))


def _wrap(rng: random.Random, slot: Slot, slots: list[Slot]) -> None:
    slot.parent[slot.key] = rng.choice(([slot.value], {"a": slot.value}, {"0": slot.value}, [slot.value, None]))


def _unwrap(rng: random.Random, slot: Slot, slots: list[Slot]) -> None:
    inner = slot.value
    if isinstance(inner, dict):
        inner = list(inner.values())
    slot.parent[slot.key] = rng.choice(inner) if isinstance(inner, list) and inner else odd_value(rng, inner)


def _exchange(rng: random.Random, slot: Slot, slots: list[Slot]) -> None:
    other = rng.choice(slots[1:]) if len(slots) > 1 else slot
    slot.parent[slot.key], other.parent[other.key] = copy.deepcopy(other.value), copy.deepcopy(slot.value)


def _deepen(rng: random.Random, slot: Slot, slots: list[Slot]) -> None:
    depth = rng.choice((3, 30, 300, 900, 2000, 20_000))
    opening, closing = rng.choice((("[", "]"), ('{"a":', "}")))
    slot.parent[slot.key] = Raw(opening * depth + ("1" if opening != "[" else "") + closing * depth)


CHANGES: tuple[Callable[[random.Random, Slot, list[Slot]], None], ...] = (
    *(_replace, _nudge, _delete, _duplicate, _rename, _add, _wrap, _unwrap, _exchange, _deepen),
)
WEIGHTS = (30, 30, 8, 6, 4, 6, 4, 4, 6, 1)


# --- Bytes ---------------------------------------------------------------------------------------------------------


def damage(rng: random.Random, data: bytes, low: int = 0, high: int | None = None) -> bytes:
    """Change bytes between two positions: bits, numbers, pieces that go, come or repeat; or cut the end off."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 8))):
        stop = min(high if high is not None else len(out), len(out))
        if stop <= low:
            break
        at = rng.randrange(low, stop)
        length = rng.choice((1, 2, 4, 8, 16, 64, 256))
        kind = rng.randrange(9)
        if kind <= 1:
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 2:
            out[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFE, 0xFF, 0x20, 0x22, 0x2C))
        elif kind == 3:
            width = rng.choice((2, 4, 8))
            number = rng.choice(
                (0, 1, 2 ** (8 * width - 1) - 1, 2 ** (8 * width) - 1, 2**16 - 1, len(data), 600 * 2**20)
            )
            number %= 2 ** (8 * width)
            out[at : at + width] = number.to_bytes(width, rng.choice(("little", "big")))
        elif kind == 4:
            del out[at : at + length]
        elif kind == 5:
            out[at:at] = out[at : at + length]
        elif kind == 6:
            out[at : at + length] = rng.randbytes(len(out[at : at + length]))
        elif kind == 7:
            out[at : at + length] = bytes(len(out[at : at + length]))
        else:
            source = rng.randrange(len(out))
            out[at : at + length] = out[source : source + length]
    if rng.random() < 0.08:
        del out[rng.randrange(len(out) + 1) :]
    elif rng.random() < 0.04:
        out += rng.choice((b"\x00", b"\n", b"x", rng.randbytes(64), bytes(out[:200])))
    return bytes(out)
