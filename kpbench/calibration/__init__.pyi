from .marks import BoardPoints as BoardPoints
from .marks import MarkFinder as MarkFinder

__all__: list[str]
