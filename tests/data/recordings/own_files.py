"""Small recordings as a newcomer has them: a video, images, and tables with a clock of their own."""

import cv2
import numpy as np

SIZE = (24, 32)


def grey(number):
    """Returns a picture whose brightness tells its number, RGB."""
    return np.full((*SIZE, 3), (10 + 4 * number, 200 - 3 * number, 7), np.uint8)


def pixels(number):
    return grey(number).transpose(2, 0, 1).astype(np.float32) / 255


def write_video(file, frames, rate=10):
    writer = cv2.VideoWriter(str(file), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"FFV1"), rate, SIZE[::-1])
    for number in range(frames):
        writer.write(np.ascontiguousarray(grey(number)[..., ::-1]))
    writer.release()


def write_images(folder, names):
    folder.mkdir(parents=True)
    for number, name in enumerate(names):
        cv2.imwrite(str(folder / name), np.ascontiguousarray(grey(number)[..., ::-1]))


def write_csv(file, **columns):
    lines = [",".join(columns), *(",".join(map(repr, map(float, row))) for row in zip(*columns.values(), strict=True))]
    file.write_text("\n".join(lines) + "\n")
    return file
