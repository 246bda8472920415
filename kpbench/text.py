"""Text from files and from users: the rule for names, and one function per format that text is written into."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable
from html import escape

LONGEST_NAME = 100
NAME_RULE = (
    f"a name of at most {LONGEST_NAME} letters, digits, spaces and ._+-, which does not begin with a space, . or -"
)
"""What :func:`is_name` accepts, in words."""


def is_name(text: object) -> bool:
    """Return whether a value is a text that is safe as a part of a path and in every output. See ``NAME_RULE``.

    Letters and digits are those of all scripts, with their accents.
    """
    return (
        isinstance(text, str)
        and 0 < len(text) <= LONGEST_NAME
        and text[0] not in " .-"
        and all(c in " ._+-" or unicodedata.category(c)[0] in "LMN" for c in text)
    )


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return the end of a message about an unknown name: the known name that is closest to it, or "" if none is close.

    >>> did_you_mean("suprpoint", ["template", "superpoint"])
    "; did you mean 'superpoint'?"
    """
    from difflib import get_close_matches  # imported here: only a message about a mistake needs it

    return "".join(f"; did you mean {close!r}?" for close in get_close_matches(name, known, n=1))


def escape_terminal(text: str, lines: bool = False) -> str:
    r"""Return a text in which every character that is not printed is written as an escape such as ``\x1b``.

    These are the control characters (C0 and C1), the characters that change the direction of text, line separators
    and halves of surrogate pairs. With ``lines``, line feeds stay.
    """
    if text.isprintable():
        return text
    return "".join(
        c if c.isprintable() or (lines and c == "\n") else c.encode("unicode_escape").decode("ascii") for c in text
    )


def replace_unprinted(text: str) -> str:
    """Return a text for paper, with a question mark in place of each character that is not printed."""
    return "".join(c if c.isprintable() else "?" for c in text)


LATEX_OF = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "ε": r"$\varepsilon$",
} | {c: f"\\{c}" for c in "&%$#_{}"}
"""LaTeX commands for the characters that LaTeX does not print literally."""


def escape_latex(text: str) -> str:
    """Return a text that LaTeX prints literally, in one line."""
    escaped = "".join(LATEX_OF.get(c, c) for c in escape_terminal(text))
    return f"{{{escaped[0]}}}{escaped[1:]}" if escaped[:1] in ("[", "*") else escaped  # arguments of the row above


def escape_markdown(text: str) -> str:
    r"""Return a text that Markdown shows literally, in one line. It holds no HTML and no end of a table's cell.

    An underscore within a word stays: it marks nothing.
    """
    return re.sub(r"[\\`*\[\]<>|~$]|&(?=[#\w])|(?<!\w)_|_(?!\w)", r"\\\g<0>", escape_terminal(text))


def escape_markup(text: str) -> str:
    """Return a text for XML, SVG and HTML, within an element or an attribute, in one line.

    Escapes stand for the control characters, which XML forbids.
    """
    return escape(escape_terminal(text))


def escape_yaml(text: str) -> str:
    r"""Return a text as a scalar of YAML in quotation marks, in one line. The scalar is also a string of TOML.

    JSON is no substitute: it writes a character above U+FFFF as two halves, which YAML does not join.
    """
    whole = text.encode(errors="backslashreplace").decode()
    marked = whole.replace("\\", r"\\").replace('"', r"\"")
    return '"' + "".join(c if c.isprintable() else _unicode_escape(c) for c in marked) + '"'


def _unicode_escape(c: str) -> str:
    return f"\\u{ord(c):04x}" if ord(c) < 0x10000 else f"\\U{ord(c):08x}"


def escape_dxf(text: str) -> str:
    r"""Return a text for DXF in ASCII. ``\U+`` and four hexadecimal digits stand for every other character.

    ``\`` and ``^`` would start a code of DXF, and are written so too. ``%%`` would start one, and becomes ``% %``.
    Characters from U+10000 up do not fit into four digits and are dropped.
    """
    units = (c if c.isascii() and c.isprintable() and c not in "\\^" else f"\\U+{ord(c):04X}" for c in text)
    return "".join(unit for unit in units if len(unit) <= 7).replace("%%", "% %")


FORMULA = "=+@\uff1d\uff0b\uff0d\uff20-"
"""Characters that begin a formula, also in their wide forms."""
CELL = r"(?:^|[,;|])[\s\"\\]*"
"""How a cell begins. Spreadsheets split lines at , or ; as the language of the machine is, and also inside of texts."""


def escape_csv(value: object) -> object:
    """Return the value of a cell in one line, which no spreadsheet takes for a formula.

    A ``'`` stands before each character of ``FORMULA`` that begins the text, or that follows a comma, a semicolon or a
    ``|``. Numbers stay as they are.
    """
    if not isinstance(value, str):
        return value
    return re.sub(f"({CELL})(?=[{FORMULA}])", r"\1'", escape_terminal(value))


def escape_csv_comment(text: str) -> str:
    r"""Return a line of JSON whose texts cannot become cells with formulas when the line is split.

    The first character of such a cell becomes an escape of JSON, such as ``\u003d``.
    """

    def escape_string(string: re.Match[str]) -> str:
        return '"' + re.sub(f"({CELL})([{FORMULA}])", lambda m: f"{m[1]}\\u{ord(m[2]):04x}", string[0][1:-1]) + '"'

    return re.sub(r'"(?:[^"\\]|\\.)*"', escape_string, text)
