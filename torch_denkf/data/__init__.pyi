from .episodes import Episode
from .lerobot.lag import lag_errors
from .lerobot.replay import LeRobotReplay
from .recordings.frames import Images, Video
from .recordings.offsets import clock_offsets
from .recordings.replay import Recording, RecordingReplay
from .recordings.tables import Table
from .replay import EpisodeReplay

__all__ = [
    "Episode",
    "EpisodeReplay",
    "Images",
    "LeRobotReplay",
    "Recording",
    "RecordingReplay",
    "Table",
    "Video",
    "clock_offsets",
    "lag_errors",
]
