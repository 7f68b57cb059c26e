"""Reads topics of ROS bags as numeric columns: ROS 1, ROS 2 and MCAP."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["bag_topics", "is_bag", "read_topic"]

EXTRA = "pip install 'torch_denkf[ros]'"
_LONGEST = 64  # largest array to read: a covariance, but no image or scan


def is_bag(file: Path) -> bool:
    """Returns True for the path of a ROS bag."""
    return file.suffix.lower() in (".bag", ".mcap", ".db3") or (file.is_dir() and (file / "metadata.yaml").is_file())


def bag_topics(file: Path) -> dict[str, str]:
    """Maps the topics of a bag to the types of their messages.

    Raises:
        FileNotFoundError: without the file.
        ImportError: without rosbags.
        ValueError: if it is damaged.
    """
    with _opened(file) as reader:
        return {one.topic: one.msgtype for one in reader.connections}


def read_topic(file: Path, topic: str | None = None) -> tuple[str, dict[str, np.ndarray]]:
    """Reads the numeric fields of a topic's messages.

    Args:
        file: the bag.
        topic: name of the topic; may be left out if the bag has only one.

    Returns:
        The topic, and columns ``[n]`` by name: ``time``, s, of the header's stamp, or of the recording if there is
        none; ``recorded``, s; and the numeric fields of the messages, such as ``twist.twist.linear.x``.

    Raises:
        FileNotFoundError: without the file.
        ImportError: without rosbags.
        ValueError: if it is damaged, or has no such topic.
    """
    with _opened(file) as reader:
        topics = sorted({one.topic for one in reader.connections})
        if topic is None and len(topics) == 1:
            topic = topics[0]
        if topic is None or topic not in topics:
            raise ValueError(f"{file} has the topics {topics}; pass topic= for one of them, got {topic!r}")
        rows: list[dict[str, float]] = []
        for connection, recorded, data in reader.messages([one for one in reader.connections if one.topic == topic]):
            message = reader.deserialize(data, connection.msgtype)
            row = {"recorded": 1e-9 * recorded, **dict(_numbers(message, ""))}
            stamp = row.pop("header.stamp.sec", 0.0) + 1e-9 * row.pop("header.stamp.nanosec", 0.0)
            rows.append({"time": stamp or row["recorded"], **row})
    names = dict.fromkeys(name for row in rows for name in row)
    return topic, {name: np.array([row.get(name, np.nan) for row in rows], float) for name in names or ["time"]}


@contextmanager
def _opened(file: Path) -> Iterator[Any]:
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ImportError(f"{file} is a ROS bag, which needs rosbags: {EXTRA}") from error
    if not file.exists():
        raise FileNotFoundError(f"no bag {file}; check the path")
    whole = file.suffix.lower() == ".db3" and (file.parent / "metadata.yaml").is_file()
    try:
        bag = file.parent if whole else file
        with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except (AnyReaderError, OSError) as error:
        raise ValueError(f"{file} is no complete bag ({error}); copy it again, or pass its folder") from error


def _numbers(value: Any, name: str) -> Iterator[tuple[str, float]]:
    """Yields name and value of each numeric field of a message."""
    if isinstance(value, (bool, int, float, np.number, np.bool_)):
        yield name, float(value)
    elif isinstance(value, np.ndarray) and len(value) <= _LONGEST and value.dtype.kind in "fiub":
        yield from ((f"{name}.{place}", float(number)) for place, number in enumerate(value))
    elif hasattr(value, "__dataclass_fields__"):
        for field in value.__dataclass_fields__:
            if not field.startswith("__"):
                yield from _numbers(getattr(value, field), f"{name}.{field}" if name else field)
