"""Export of a filter's step to a file that runs without the training code, and an analysis over several processes.

:func:`load_step` needs only torch. The others, which need all of torch_denkf, are imported when they are used.
"""

from importlib import import_module

from torch_denkf.deployment.package import load_step

__all__ = [
    "ShardedEnsembleAnalysis",
    "export_step",
    "load_step",
]

_FILES = {"ShardedEnsembleAnalysis": "sharded", "export_step": "export", "PackagedRun": "in_environment"}


def __getattr__(name: str):
    if name not in _FILES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_FILES[name]}"), name)
