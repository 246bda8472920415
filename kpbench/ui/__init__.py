"""The local web application: design and print patches, look at photographs, watch films and cameras.

It needs ``pip install 'kpbench[ui]'``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
