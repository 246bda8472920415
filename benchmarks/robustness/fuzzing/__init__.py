"""Parts of ``fuzz.py``: valid files, what is changed in them, plain reference parsers, supervised workers."""
