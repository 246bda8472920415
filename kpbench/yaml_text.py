"""Reading YAML of strangers: no code, no aliases, no deep nesting, in a time that grows with the text only."""

from __future__ import annotations

from typing import Any

DEEPEST = 100
"""Largest number of levels."""
LONGEST_SCALAR = 1000
"""Characters of a value: a number of a hundred thousand digits takes seconds."""
MATRIX_TAG = "tag:yaml.org,2002:opencv-matrix"
"""Tag with which OpenCV marks a matrix: a mapping of rows, cols, dt and data."""


def parse_yaml(text: str) -> Any:
    r"""Return the content of YAML, OpenCV's included. Whatever the text is, the error is a ValueError or a YAMLError.

    Raises
    ------
    ValueError, yaml.YAMLError
        If the text is no YAML, or has an alias, a tag, a long value or many levels.

    Examples
    --------
    >>> from kpbench.yaml_text import parse_yaml
    >>> parse_yaml("%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 1\n   data: [ 2.5 ]\n")
    {'K': {'rows': 1, 'data': [2.5]}}
    """
    import yaml  # type: ignore[import-untyped]

    if text.startswith("%YAML:"):  # OpenCV's first line is not quite YAML
        text = text.partition("\n")[2]
    base = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the loader in Python needs seconds for some small files
    loader: Any = type("Loader", (base,), {})
    loader.add_constructor(MATRIX_TAG, lambda self, node: self.construct_mapping(node, deep=True))
    depth = 0
    # a few lines of aliases of aliases stand for millions of values
    for event in yaml.parse(text, loader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if isinstance(event, yaml.AliasEvent) or len(getattr(event, "value", "")) > LONGEST_SCALAR:
            raise ValueError(f"it has an alias (*name), or a value of over {LONGEST_SCALAR} characters")
        if depth > DEEPEST:
            raise ValueError(f"it is nested more than {DEEPEST} levels deep")
    try:
        return yaml.load(text, loader)
    except (TypeError, AttributeError, OverflowError) as error:  # a matrix that is no mapping, an impossible date
        raise ValueError(str(error)) from None
