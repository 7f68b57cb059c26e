"""The order of the tutorials in the gallery: the order in which a newcomer reads them."""

from pathlib import Path

ORDER = (
    "first_filter",
    "all_filters",
    "own_recordings",
    "two_sensors",
    "late_readings",
    "phone",
    "smoothing",
    "training",
    "diagnostics",
    "monitor",
    "hidden",
    "policy",
    "to_robot",
)


class ReadingOrder:
    """Sorts the scripts ``plot_NAME.py`` by :data:`ORDER`; others come last."""

    def __init__(self, src_dir: str):
        self.src_dir = src_dir

    def __call__(self, filename: str) -> tuple[int, str]:
        """The place of a script."""
        name = Path(filename).stem.removeprefix("plot_")
        return ORDER.index(name) if name in ORDER else len(ORDER), name
