"""Algorithms that edit a scene: a module each, of the method's name, with its settings, its class
and its presets. Every module here is imported, so a new one is known to commands and studies.
"""

from importlib import import_module
from pkgutil import iter_modules

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")
