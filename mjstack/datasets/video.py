"""Videos of a dataset: encoded by processes of their own, cut and joined without a loss of a frame.

Every frame can be found by its time: times are multiples of one over the rate, and every second
frame is complete in itself.
"""

import errno
import os
import subprocess
import time
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np

from mjstack.datasets.spec import Video
from mjstack.errors import FolderError, MissingExtra, first_line

# Settings of each codec. One thread each: encoders are as many as cores, and results are alike.
_ENCODERS = {
    "h264": ["libx264", "-preset", "veryfast", "-crf", "20", "-bf", "0", "-threads", "1"],
    "av1": ["libsvtav1", "-preset", "12", "-crf", "30", "-svtav1-params", "lp=1"],
}
_GROUP = ["-g", "2"]  # a complete frame, and one that depends on it
_PIXELS = ["-f", "rawvideo", "-pix_fmt", "rgb24"]


def encode(images: np.ndarray, fps: int, codec: str, path: Path | None = None) -> None:
    """Write images, shape ``(frames, height, width, 3)``, uint8, ``fps`` a second, as an mp4 in
    ``h264`` or ``av1``; without a path the result is not kept. An OSError if the encoder fails,
    such as on a full disk.
    """
    height, width = images.shape[1:3]
    size = ["-s", f"{width}x{height}", "-r", str(fps)]
    output = ["-f", "null", "-"] if path is None else ["-f", "mp4", str(path)]
    encoder = ["-c:v", *_ENCODERS[codec], *_GROUP, "-pix_fmt", "yuv420p"]
    _ffmpeg([*_PIXELS, *size, "-i", "-", *encoder, *output], np.ascontiguousarray(images).data)


def join(paths: Sequence[Path], path: Path) -> None:
    """Join videos of the same size, rate and codec, without encoding anew.

    Raises:
        OSError: The file cannot be written.
    """
    listed = path.with_name(f"{path.name}.txt")
    listed.write_text("".join(f"file '{os.path.relpath(clip, path.parent)}'\n" for clip in paths))
    source = ["-f", "concat", "-safe", "0", "-i", str(listed)]
    _ffmpeg([*source, "-c", "copy", "-f", "mp4", str(path)])
    listed.unlink()


def check_encoder(videos: Mapping[str, Video], fps: int) -> None:
    """Encode a few images as those of each video will be, and keep nothing.

    Raises:
        MissingExtra: The package with the encoder is not installed.
        FolderError: It cannot encode them.
    """
    for name, video in videos.items():
        images = np.zeros((4, video.height, video.width, 3), np.uint8)
        try:
            encode(images, fps, video.codec)
        except OSError as error:
            raise FolderError(
                f"{name}: {video.height}x{video.width} pixels in {video.codec} cannot be encoded"
                f" ({error.strerror or first_line(error)}), expected an encoder for them."
                " Choose another codec or size, or unset IMAGEIO_FFMPEG_EXE"
            ) from error


def _ffmpeg(arguments: Sequence[str], content: memoryview | None = None) -> None:
    """Run ffmpeg. Ctrl-C does not reach ffmpeg, so a video once begun is completed."""
    try:
        import imageio_ffmpeg

        program = imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:  # the package, or the program inside
        raise MissingExtra("a dataset with images", "imageio-ffmpeg", "video") from error
    done = subprocess.run(
        [program, "-nostdin", "-loglevel", "error", "-y", *arguments],
        input=content or b"",
        capture_output=True,
        start_new_session=True,
        env=os.environ | {"SVT_LOG": "1"},  # quiet
    )
    if done.returncode:
        text = done.stderr.decode(errors="replace").strip()
        if os.strerror(errno.ENOSPC) in text:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        line = text.splitlines()[0] if text else f"status {done.returncode}"
        raise OSError(errno.EIO, f"ffmpeg: {line}")


class VideoEncoder:
    """Encodes the images of episodes beside what goes on, as many at a time as there are cores, and
    joins them into a file for each video.

    Attributes:
        waited: Time for which `add` and `complete` have waited for encoders [s].
    """

    def __init__(
        self, videos: Mapping[str, Video], fps: int, paths: Mapping[str, Path], most: float
    ) -> None:
        """Begin videos by name, ``fps`` images a second, with the file of each, beside which files
        of its episodes lie until they are joined. ``most`` is how much images may take which wait
        for an encoder [bytes].
        """
        self.waited = 0.0
        self._videos = videos
        self._fps = fps
        self._paths = paths
        self._most = most
        self._pool = ThreadPoolExecutor(os.cpu_count() or 1, "encoder")
        self._clips: dict[str, list[Path]] = {name: [] for name in videos}
        self._running: deque[tuple[Future[None], int]] = deque()  # with bytes of images

    def add(self, images: Mapping[str, np.ndarray]) -> None:
        """Begin to encode an episode. Waits while too many images are there.

        Raises:
            OSError: An encoder has failed.
        """
        for name, video in self._videos.items():
            clips = self._clips[name]
            whole = self._paths[name]
            whole.parent.mkdir(parents=True, exist_ok=True)
            clips.append(whole.with_name(f"{whole.name}.{len(clips):06d}"))
            work = self._pool.submit(encode, images[name], self._fps, video.codec, clips[-1])
            self._running.append((work, images[name].nbytes))
        while self._running and (
            sum(size for _, size in self._running) > self._most or self._running[0][0].done()
        ):
            self._finish_one()

    def megabytes(self) -> float:
        """Size of the largest video so far, as far as it is encoded [MiB]."""
        sizes = [
            sum(path.stat().st_size for path in clips if path.exists())
            for clips in self._clips.values()
        ]
        return max(sizes, default=0) / 2**20

    def complete(self) -> None:
        """Wait for the encoders, and write each video's file, which is on the disk then.

        Raises:
            OSError: An encoder has failed, or a file cannot be written.
        """
        while self._running:
            self._finish_one()
        for name, clips in self._clips.items():
            path = self._paths[name]
            join(clips, path)
            with open(path, "rb") as file:
                os.fsync(file.fileno())
        self.abandon()

    def abandon(self) -> None:
        """Wait for what is being encoded, and remove the episodes' files."""
        self._pool.shutdown(cancel_futures=True)
        for clips in self._clips.values():
            for path in clips:
                path.unlink(missing_ok=True)

    def _finish_one(self) -> None:
        work, _ = self._running.popleft()
        began = time.perf_counter()
        work.result()
        self.waited += time.perf_counter() - began
