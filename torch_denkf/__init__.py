"""Differentiable Bayesian filters for robots as TorchRL parts."""

import lazy_loader

__version__ = "0.1.0"

# __init__.pyi lists the public names and their modules; a module is imported when one of its names is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
