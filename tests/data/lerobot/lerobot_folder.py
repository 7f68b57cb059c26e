"""Writes small recordings in LeRobot's layout, as its own writers lay them out."""

import json

import av
import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet

FPS = 10
SIZE = (48, 64)
NAMES = ["shoulder", "elbow", "wrist"]


def colours(episode, length):
    """Returns the mean colour of each frame; neighbours differ by 14 in red, so that a shift by one shows."""
    k = np.arange(length)
    return np.stack([20 + 14 * k, 230 - 10 * k, np.full(length, 40 + 30 * episode)], -1)


def pictures(episode, length, size=SIZE):
    """RGB uint8 [length, H, W, 3]: the colour, and a soft ramp to the right that tells left from right."""
    ramp = np.linspace(-12, 12, size[1]).round().astype(int)
    return (colours(episode, length)[:, None, None] + ramp[:, None]).clip(0, 255).astype(np.uint8).repeat(size[0], 1)


def joints(episode, length):
    k = np.arange(length)
    return np.stack([0.1 * k + episode, np.sin(k), np.full(length, 0.5)], -1).astype(np.float32)


def actions(episode, length):
    return (joints(episode, length)[:, :2] * 2 + 1).astype(np.float32)


def write_video(file, frames, codec):
    file.parent.mkdir(parents=True, exist_ok=True)
    if codec == "av1":
        with av.open(str(file), "w") as container:
            stream = container.add_stream("libsvtav1", rate=FPS, options={"g": "2", "crf": "20"})  # LeRobot's g
            stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], "yuv420p"
            for frame in frames:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
            container.mux(stream.encode())
        return
    writer = cv2.VideoWriter(str(file), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*codec), FPS, frames.shape[2:0:-1])
    assert writer.isOpened(), codec
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()


def png(frame):
    return cv2.imencode(".png", np.ascontiguousarray(frame[..., ::-1]))[1].tobytes()


def columns(episode, length, first):
    return {
        "observation.state": pa.array(list(joints(episode, length)), pa.list_(pa.float32())),
        "action": pa.array(list(actions(episode, length)), pa.list_(pa.float32(), 2)),
        "timestamp": pa.array((np.arange(length) / FPS).astype(np.float32)),
        "frame_index": pa.array(np.arange(length)),
        "episode_index": pa.array(np.full(length, episode)),
        "index": pa.array(first + np.arange(length)),
        "task_index": pa.array(np.zeros(length, int)),
    }


def write_info(root, version, video, suffix="mp4", cameras=("observation.images.top",), **changes):
    place = ("chunk_index", "file-{file_index:03d}") if version == "v3.0" else ("episode_chunk", None)
    name = place[1] or "episode_{episode_index:06d}"
    chunk = f"chunk-{{{place[0]}:03d}}"
    videos = f"{{video_key}}/{chunk}" if version == "v3.0" else f"{chunk}/{{video_key}}"
    camera = {"dtype": "video" if video else "image", "shape": [*SIZE, 3], "names": ["height", "width", "channels"]}
    info = {
        "codebase_version": version,
        "fps": FPS,
        "chunks_size": 2,
        "data_path": f"data/{chunk}/{name}.parquet",
        "video_path": f"videos/{videos}/{name}.{suffix}" if video else None,
        "features": {
            "observation.state": {"dtype": "float32", "shape": [3], "names": {"motors": NAMES}},
            "action": {"dtype": "float32", "shape": [2], "names": None},
            **dict.fromkeys(cameras, camera),
            "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        },
        **changes,
    }
    (root / "meta").mkdir(parents=True, exist_ok=True)
    (root / "meta/info.json").write_text(json.dumps(info))


def write_version_2(root, lengths, *, version="v2.1", images=None, codec="FFV1", suffix="mkv"):
    """``images``: None for videos; "bytes" in the parquet files; "path" or "folder" for files next to them."""
    write_info(root, version, images is None, suffix)
    lines, first = [], 0
    for episode, length in enumerate(lengths):
        frames, chunk = pictures(episode, length), f"chunk-{episode // 2:03d}"
        table = columns(episode, length, first)
        first += length
        if images is None:
            write_video(root / f"videos/{chunk}/observation.images.top/episode_{episode:06d}.{suffix}", frames, codec)
        elif images == "bytes":
            table["observation.images.top"] = pa.array([{"bytes": png(f), "path": None} for f in frames])
        else:
            folder = root / f"images/observation.images.top/episode_{episode:06d}"
            folder.mkdir(parents=True)
            names = [folder / f"frame_{k:06d}.png" for k in range(length)]
            for name, frame in zip(names, frames, strict=True):
                name.write_bytes(png(frame))
            if images == "path":
                paths = [{"bytes": None, "path": str(name.relative_to(root))} for name in names]
                table["observation.images.top"] = pa.array(
                    paths, pa.struct({"bytes": pa.binary(), "path": pa.string()})
                )
        (root / f"data/{chunk}").mkdir(parents=True, exist_ok=True)
        parquet.write_table(pa.table(table), root / f"data/{chunk}/episode_{episode:06d}.parquet")
        lines.append(json.dumps({"episode_index": episode, "tasks": ["pick"], "length": length}))
    (root / "meta/episodes.jsonl").write_text("\n".join(lines) + "\n")


def write_version_3(root, groups, *, codec="FFV1", suffix="mkv", groups_of_videos=None):
    """``groups``: lengths of the episodes in each data file; videos may be grouped in another way."""
    write_info(root, "v3.0", True, suffix)
    lengths, entries, first = [n for group in groups for n in group], {}, 0
    numbers = iter(range(len(lengths)))
    for part, group in enumerate(groups):
        tables = []
        for length in group:
            episode = next(numbers)
            tables.append(pa.table(columns(episode, length, first)))
            first += length
            entries[episode] = {
                "episode_index": episode,
                "length": length,
                "data/chunk_index": 0,
                "data/file_index": part,
                "stats/unused": [0.0],
            }
        (root / "data/chunk-000").mkdir(parents=True, exist_ok=True)
        parquet.write_table(pa.concat_tables(tables), root / f"data/chunk-000/file-{part:03d}.parquet")
    key, numbers = "observation.images.top", iter(range(len(lengths)))
    for part, group in enumerate(groups_of_videos or groups):
        shown, begin = [], 0
        for length in group:
            episode = next(numbers)
            shown.append(pictures(episode, length))
            entries[episode] |= {
                f"videos/{key}/chunk_index": 0,
                f"videos/{key}/file_index": part,
                f"videos/{key}/from_timestamp": begin / FPS,
                f"videos/{key}/to_timestamp": (begin + length) / FPS,
            }
            begin += length
        write_video(root / f"videos/{key}/chunk-000/file-{part:03d}.{suffix}", np.concatenate(shown), codec)
    (root / "meta/episodes/chunk-000").mkdir(parents=True)
    table = pa.Table.from_pylist([entries[k] for k in sorted(entries)])
    parquet.write_table(table, root / "meta/episodes/chunk-000/file-000.parquet")
