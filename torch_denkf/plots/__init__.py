"""Plots of beliefs: paths, bands over time, calibration, videos.

Each function takes a roll-out, the result of :meth:`torch_denkf.filters.Filter.sequence`, or plain tensors. It draws
into the given Axes, or into a new figure, and returns the Axes; ``axes.figure.savefig("path.png")`` writes the figure.
New figures are not registered with pyplot: no window opens, and they need not be closed. For a window or a notebook,
pass an Axes of ``plt.subplots()``.

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
