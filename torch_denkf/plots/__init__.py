"""Pictures of beliefs: paths, bands over time, calibration, videos.

Each function takes what a roll-out or :meth:`torch_denkf.filters.Filter.sequence` gives, or plain tensors. It draws
into the Axes that it is given, or into a figure of its own, and returns the Axes; ``axes.figure.savefig("path.png")``
writes it. Figures of its own are not known to pyplot: nothing pops up, nothing has to be closed. Pass an Axes of
``plt.subplots()`` where a window or a notebook is to show it.

Needs matplotlib and pillow, ``pip install "torch_denkf[plots]"``; importing this package needs neither.
"""

from torch_denkf.plots.bands import plot_bands
from torch_denkf.plots.calibration import plot_calibration
from torch_denkf.plots.path import plot_path
from torch_denkf.plots.spread import plot_spread_error
from torch_denkf.plots.video import belief_video, write_video

__all__ = [
    "belief_video",
    "plot_bands",
    "plot_calibration",
    "plot_path",
    "plot_spread_error",
    "write_video",
]
