"""A filter's step as a file that runs without the training code.

:func:`load_step` needs torch alone. :func:`export_step`, which needs all of torch_denkf, is imported when it is used.
"""

from torch_denkf.deployment.package import load_step

__all__ = [
    "export_step",
    "load_step",
]


def __getattr__(name: str):
    if name == "export_step":
        from torch_denkf.deployment.export import export_step

        return export_step
    if name == "PackagedRun":
        from torch_denkf.deployment.in_environment import PackagedRun

        return PackagedRun
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
