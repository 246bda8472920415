"""The whole chain, small."""

from __future__ import annotations

from pathlib import Path

import click

__all__ = ["demo"]
