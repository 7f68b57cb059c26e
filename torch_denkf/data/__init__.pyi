from .episodes import Episode
from .lerobot.latency import lag_errors
from .lerobot.replay import LeRobotReplay
from .recordings.frames import Images, Video
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
    "lag_errors",
]
