from .serving import serve as serve

__all__: list[str]
