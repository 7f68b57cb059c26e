"""Environments: toy systems and replays; transforms that disturb or drop frames, or hold the last one."""

import lazy_loader

# __init__.pyi names what is here, and where; a module is imported when one of its names is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
