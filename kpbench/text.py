"""Text from files and from users: the rule for names, and one function per format that text is written into."""

from __future__ import annotations

import re
import unicodedata

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


def escape_csv(value: object) -> object:
    """Return the value of a cell in one line, which no spreadsheet takes for a formula.

    A text that begins with =, +, - or @ gets a ``'`` before it. Numbers stay as they are.
    """
    if not isinstance(value, str):
        return value
    text = escape_terminal(value)
    return f"'{text}" if text.startswith(("=", "+", "-", "@")) else text


def escape_csv_comment(text: str) -> str:
    r"""Return a line of JSON whose texts cannot become cells with formulas when the line is split.

    The first character of such a cell becomes an escape of JSON, such as ``\u003d``.
    """
    return re.sub(r"(?<=[,;])[=+@-]", lambda found: f"\\u{ord(found[0]):04x}", text)
