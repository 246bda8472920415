"""Writers of trees as JSON, TOML and YAML that can also write what no sound writer would, and changes to CSV."""

from __future__ import annotations

import datetime
import json
import math
import random
import re
from typing import Any

from .trees import KEYS, TEXTS, Raw, Tree, damage, mutate_tree


def finish_text(rng: random.Random, text: str) -> bytes:
    """UTF-8, in a few cases with what editors and broken programs make of it."""
    data = text.encode(errors="surrogatepass")
    kind = rng.randrange(60)
    if kind == 0:
        return b"\xef\xbb\xbf" + data
    if kind == 1:
        return text.encode(rng.choice(("utf-16", "utf-32", "latin-1", "utf-16-le")), errors="replace")
    if kind == 2:
        return data.replace(b"\n", b"\r\n") + rng.choice((b"", b"\r", b"\x1a"))
    if kind == 3:
        at = rng.randrange(len(data) + 1)
        return (
            data[:at]
            + rng.choice((b"\xff", b"\xc3", b"\xed\xa0\x80", b"\x00", b"\x1b[31m", b"\xf4\x90\x80\x80"))
            + data[at:]
        )
    if kind == 4:
        return data + rng.choice((b"x", b"{}", b"\n\n", b" ", b",", b"]", b"\x00", data[:50]))
    if kind < 14:
        return damage(rng, data)
    return data


# --- JSON ----------------------------------------------------------------------------------------------------------


def json_text(rng: random.Random, tree: Tree) -> str:
    """JSON, in one of several styles; at times with a key twice, a comma too many, or a comment."""
    colon, comma, ascii_only = rng.choice((":", ": ", " :\n")), rng.choice((",", ", ", ",\n ")), rng.random() < 0.6
    twice, extra = rng.random() < 0.03, rng.random() < 0.03

    def write(value: Any) -> str:
        if isinstance(value, Raw):
            return str(value)
        if isinstance(value, str):
            return json.dumps(value, ensure_ascii=ascii_only)
        if isinstance(value, dict):
            parts = [f"{json.dumps(str(k), ensure_ascii=ascii_only)}{colon}{write(v)}" for k, v in value.items()]
            if twice and parts:
                parts.append(rng.choice(parts))
                if rng.random() < 0.5:
                    parts[-1] = (
                        f"{json.dumps(str(rng.choice(list(value))))}{colon}{write(rng.choice((0, 'a', [], None)))}"
                    )
            return "{" + comma.join(parts) + "}"
        if isinstance(value, list | tuple):
            return "[" + comma.join(map(write, value)) + "]"
        return json.dumps(value)

    text = write(tree)
    if extra:
        text = re.sub(
            r"([\]}])", rng.choice((r",\1", r"/* */\1", r" \1", r"//\n\1")), text, count=rng.choice((1, 2, 0))
        )
    return text


def mutate_json(rng: random.Random, tree: Tree, often: tuple[str, ...] = ()) -> bytes:
    """The JSON of a tree, changed in the tree in nine of ten cases, and at times in the text."""
    return finish_text(rng, json_text(rng, mutate_tree(rng, tree, often) if rng.random() < 0.9 else tree))


# --- TOML ----------------------------------------------------------------------------------------------------------


def toml_text(rng: random.Random, tree: dict[str, Any]) -> str:
    """TOML with a table a section, or all inline; dates, hexadecimal numbers and dotted keys among it."""
    inline, odd = rng.random() < 0.2, rng.random() < 0.1

    def key(text: object) -> str:
        return str(text) if re.fullmatch(r"[A-Za-z0-9_-]+", str(text)) and rng.random() < 0.95 else quote(str(text))

    def quote(text: str) -> str:
        escaped = json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
        return escaped if rng.random() < 0.97 else f'"""\n{escaped[1:-1]}"""'

    def write(value: Any) -> str:
        if isinstance(value, Raw):
            return str(value).replace('{"a":', "{a=")
        if isinstance(value, bool):
            return str(value).lower()
        if isinstance(value, int):
            return rng.choice((hex, oct, str))(value) if odd and value >= 0 else str(value)
        if isinstance(value, float):
            return str(value) if math.isfinite(value) else str(value).replace("+", "")
        if isinstance(value, str):
            return quote(value)
        if isinstance(value, dict):
            return "{ " + ", ".join(f"{key(k)} = {write(v)}" for k, v in value.items() if v is not None) + " }"
        if isinstance(value, list | tuple):
            return "[" + ", ".join(write(v) for v in value if v is not None) + "]"
        return str(value)  # dates

    plain, tables = [], []
    for name, value in tree.items() if isinstance(tree, dict) else ():
        is_tables = isinstance(value, list) and value and all(isinstance(entry, dict) for entry in value)
        if inline or not (isinstance(value, dict) or is_tables):
            plain += [f"{key(name)} = {write(value)}"] if value is not None else []
            continue
        heading = f"[{key(name)}]" if isinstance(value, dict) else f"[[{key(name)}]]"
        for entry in [value] if isinstance(value, dict) else value:
            tables += [heading, *(f"{key(k)} = {write(v)}" for k, v in entry.items() if v is not None)]
    return "\n".join([*plain, *tables, ""])


DATES = (datetime.date(2026, 1, 1), datetime.datetime(2026, 1, 1, 1, 2, 3), datetime.time(1, 2, 3))


def mutate_toml(rng: random.Random, tree: dict[str, Any], often: tuple[str, ...] = ()) -> bytes:
    """The TOML of a tree that is changed, and at times its text."""
    changed = mutate_tree(rng, tree, often) if rng.random() < 0.95 else tree
    if rng.random() < 0.03 and isinstance(changed, dict) and changed:
        changed[rng.choice(list(changed))] = rng.choice(DATES)
    return finish_text(rng, toml_text(rng, changed))


# --- YAML ----------------------------------------------------------------------------------------------------------


def mutate_yaml(rng: random.Random, tree: Tree) -> bytes:
    """The YAML of a tree that is changed; JSON is YAML too, and anchors, tags and dates are only YAML."""
    import yaml

    changed = mutate_tree(rng, tree) if rng.random() < 0.9 else tree
    kind = rng.randrange(100)
    if kind < 30:
        return finish_text(rng, json_text(rng, changed))
    try:
        text = yaml.safe_dump(_without_raw(changed), allow_unicode=rng.random() < 0.5, sort_keys=rng.random() < 0.5)
    except (yaml.YAMLError, ValueError):
        return finish_text(rng, json_text(rng, changed))
    if kind == 30:
        levels, width = rng.randrange(2, 12), rng.randrange(2, 10)
        lines = ["a0: &a0 [x]", *(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * width)}]" for n in range(1, levels))]
        text = "\n".join([*lines, text])
    elif kind < 42:
        odd = (
            "!!python/object/apply:os.getcwd []",
            "!!binary eA==",
            "2026-01-01",
            "!!set {a}",
            "*x",
            "&x [*x]",
            "<<",
            "1:30",
        )
        at = [match.end() for match in re.finditer(r": ", text)]
        place = rng.choice(at) if at else len(text)
        text = (
            text[:place] + rng.choice((*odd, "? [a]\n: b", "0o17", "~", "!!float x", "!!int x", ".nan")) + text[place:]
        )
    return finish_text(rng, text)


def _without_raw(tree: Tree) -> Tree:
    if isinstance(tree, Raw):
        return str(tree)[:100]
    if isinstance(tree, dict):
        return {k: _without_raw(v) for k, v in tree.items()}
    return [_without_raw(v) for v in tree] if isinstance(tree, list) else tree


# --- CSV -----------------------------------------------------------------------------------------------------------

CELLS = (
    *(
        "",
        " ",
        "1",
        "0",
        "-1",
        "1.0",
        "1.5",
        " 1",
        "1 ",
        "\t1",
        "+1",
        "01",
        "1e5",
        "1E5",
        "1e-400",
        "1e400",
        "0x10",
        "1_000",
    ),
    *(
        "nan",
        "NaN",
        "inf",
        "-inf",
        "Infinity",
        "NA",
        "null",
        "None",
        "true",
        "-",
        "--1",
        "1,5",
        "1;5",
        "1.5.1",
        "1e",
        ".",
        "1d",
    ),
    *("9007199254740993", "9223372036854775807", "9223372036854775808", "-9223372036854775809", "9" * 40, "9" * 400),
    *(
        "0.1",
        "5e-324",
        "1.7976931348623157e308",
        "0.30000000000000004",
        "123456789.123456789123456789",
        "\u0661",
        "\uff11",
    ),
    *(
        "=1+1",
        "'1",
        '"',
        '""',
        '"1"',
        '"1',
        '"a\nb"',
        "a",
        "\x00",
        "#",
        "\xa01",
        "1\xa0",
        "(1)",
        "$1",
        "1%",
        "1e5 ",
        "1j",
    ),
)


def mutate_csv(rng: random.Random, text: str) -> bytes:
    """CSV with other cells, rows, columns, separators or line ends."""
    lines = text.rstrip("\n").split("\n")
    header = lines.pop(0) if lines[0].startswith("#") else None
    rows = [line.split(",") for line in lines]
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        _change_csv(rng, rows)
    if header is not None and rng.random() < 0.3:
        header = "#" + json_text(rng, mutate_tree(rng, json.loads(header[1:]))).replace("\n", " ")
    separator = rng.choice((*[","] * 30, ";", "\t", ", ", " ,"))
    end = rng.choice((*["\n"] * 12, "\r\n", "\r", "\n\r", "\r\r\n"))
    if rng.random() < 0.1:
        header = None
    out = end.join([*([header] if header is not None else []), *(separator.join(row) for row in rows)])
    out += rng.choice((*[end] * 12, "", end * 2, end * 3, f"{end} ", f"{end},,,,{end}", "\x00", f"{end}#x{end}"))
    return finish_text(rng, out)


def _change_csv(rng: random.Random, rows: list[list[str]]) -> None:
    if not rows:
        return
    kind, n = rng.randrange(16), rng.randrange(len(rows))
    if kind < 8 and rows[n]:
        n = rng.randrange(1, len(rows)) if len(rows) > 1 and kind < 7 else n
        if rows[n]:
            rows[n][rng.randrange(len(rows[n]))] = rng.choice((*CELLS, *TEXTS[:12]))
    elif kind == 8 and rows[n]:
        del rows[n][rng.randrange(len(rows[n])) :]
    elif kind == 9:
        rows[n].extend(rng.choice((["1"], [""], ["1", "2"], ["x"] * 9)))
    elif kind == 10:
        rows.insert(n, rng.choice((list(rows[n]), [], [""], [" "], ["#x"], ["1"], ["nan"] * len(rows[n]))))
    elif kind == 11:
        del rows[n]
    elif kind == 30:
        order = rng.sample(range(len(rows[0])), len(rows[0]))
        for row in rows:
            row[:] = [row[k] for k in order if k < len(row)]
    elif kind == 13:
        k = rng.randrange(len(rows[0]) or 1)
        for row in rows:
            del row[k : k + 1]
    elif kind == 14 and rows[0]:
        k = rng.randrange(len(rows[0]))
        name = rows[0][k]
        rows[0][k] = rng.choice((f" {name}", f'"{name}"', name.upper(), f"{name} ", f"{name}.1", "id", "x", *KEYS))
    else:
        other = rng.randrange(len(rows))
        rows[n], rows[other] = rows[other], rows[n]
