"""Pictures of beliefs: paths, bands over time, calibration, cost, videos, and a stream into a viewer.

Each function takes what a roll-out or :meth:`torch_denkf.filters.Filter.sequence` gives, or plain tensors. It draws
into the Axes that it is given, or into a figure of its own, and returns the Axes; ``axes.figure.savefig("path.png")``
writes it. Figures of its own are not known to pyplot: nothing pops up, nothing has to be closed. Pass an Axes of
``plt.subplots()`` where a window or a notebook is to show it.

Needs matplotlib and pillow, ``pip install "torch_denkf[plots]"``; importing this package needs neither.
"""

from torch_denkf.plots.bands import plot_bands
from torch_denkf.plots.calibration import plot_calibration
from torch_denkf.plots.cost import plot_error_cost
from torch_denkf.plots.drive import NamedSpan, drive_animation, drive_picture
from torch_denkf.plots.path import plot_path
from torch_denkf.plots.spread import plot_spread_error
from torch_denkf.plots.video import belief_video, write_video
from torch_denkf.plots.viewer import log_rollout

__all__ = [
    "NamedSpan",
    "belief_video",
    "drive_animation",
    "drive_picture",
    "log_rollout",
    "plot_bands",
    "plot_calibration",
    "plot_error_cost",
    "plot_path",
    "plot_spread_error",
    "write_video",
]
