"""Frames to a film: an MP4 with all of them, and a small GIF for pages that show nothing else."""

import contextlib
import importlib.util
import io
import itertools
import os
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import astuple
from pathlib import Path
from subprocess import PIPE

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree

from rcdsac_trl.colors import LIGHT, rgb
from rcdsac_trl.errors import FaultError, UserInputError
from rcdsac_trl.storage import atomic

Frame = NDArray[np.uint8]

# Constant quality of x264: lines and text stay sharp, and flat colours cost little.
_QUALITY = "26"
# A GIF stores every change of a pixel: fewer frames and pixels keep it to a few MB.
_GIF_FPS = 3.0
_GIF_WIDTH_PX = 960
# As many as the format has. Of these, so many are what most pixels of the frames are, exactly: a mean of two areas'
# colours would be neither's, and what is translucent would get a mesh where it crosses a grid.
_GIF_COLORS, _FREQUENT_COLORS = 256, 64
# Frames that the GIF's colours are taken from.
_PALETTE_FRAMES = 12


def check_extra() -> None:
    """Refuse to film where the package for it is missing.

    Raises:
        UserInputError: with the line that installs it.
    """
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        raise UserInputError("imageio_ffmpeg is not installed: pip install 'rcdsac-trl[video]'")


def write_video(frames: Iterable[Frame], path_stem: Path, fps: float) -> list[Path]:
    """Write a film as ``<path_stem>.mp4`` and ``<path_stem>.gif``; each file is whole or absent.

    The frames pass by one at a time, so their number costs no memory to speak of. The GIF has three of them a second,
    at most 960 pixels wide.

    Args:
        frames: uint8 RGB, ``[height, width, 3]`` each, all of one size.
        path_stem: the files' path without suffix; its folder must exist.
        fps: frames a second.

    Returns:
        The two files.

    Raises:
        UserInputError: if the package is missing, there is no frame, or `fps` is not above 0.
        FaultError: if ffmpeg fails.
    """
    check_extra()
    if not fps > 0:
        raise UserInputError(f"fps={fps:g} is not above 0: give how many frames are shown a second")
    iterator = iter(frames)
    first = next(iterator, None)
    if first is None:
        raise UserInputError(f"there is no frame to write to {path_stem}: film at least one step")
    movie, gif = (path_stem.with_name(path_stem.name + suffix) for suffix in (".mp4", ".gif"))
    every = max(1, round(fps / _GIF_FPS))
    kept: list[bytes] = []
    unfinished = atomic.unfinished(movie)
    try:
        _write_mp4(_keeping(itertools.chain([first], iterator), every, kept), unfinished, fps)
        atomic.sync(unfinished)
        os.rename(unfinished, movie)
    finally:
        unfinished.unlink(missing_ok=True)
    atomic.write(gif, _gif(kept, every / fps))
    return [movie, gif]


def _keeping(frames: Iterable[Frame], every: int, kept: list[bytes]) -> Iterator[Frame]:
    """Pass the frames on, and keep some of them for the GIF, small and packed."""
    for number, frame in enumerate(frames):
        if number % every == 0:
            image = Image.fromarray(frame)
            if image.width > _GIF_WIDTH_PX:
                image = image.resize(
                    (_GIF_WIDTH_PX, round(image.height * _GIF_WIDTH_PX / image.width)), Image.Resampling.LANCZOS
                )
            packed = io.BytesIO()
            image.save(packed, "png", compress_level=1)
            kept.append(packed.getvalue())
        yield frame


def _write_mp4(frames: Iterator[Frame], path: Path, fps: float) -> None:
    """Hand the frames to ffmpeg."""
    import imageio_ffmpeg  # an extra, which brings the program

    first = _evened(next(frames))
    height, width, _ = first.shape
    given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-"]
    wanted = ["-vcodec", "libx264", "-pix_fmt", "yuv420p", "-crf", _QUALITY, "-threads", "1", "-movflags", "+faststart"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", *given, *wanted, str(path)]
    # In a session of its own: Ctrl-C is for this process, which ends it.
    with subprocess.Popen(command, stdin=PIPE, stderr=PIPE, start_new_session=True) as encoder:
        assert encoder.stdin is not None
        try:
            for frame in itertools.chain([first], frames):
                encoder.stdin.write(_evened(frame).tobytes())
        except BrokenPipeError:
            pass  # it says why below
        except BaseException:
            encoder.kill()
            with contextlib.suppress(BrokenPipeError):  # what is not written yet
                encoder.stdin.close()
            raise
        messages = encoder.communicate()[1].decode(errors="replace")
    if encoder.returncode != 0:
        raise FaultError(f"the film was not written: {' '.join(messages.split()) or 'ffmpeg failed'}")


def _evened(frame: Frame) -> Frame:
    """Repeat the last line or column where their number is odd: colours are stored at half the resolution."""
    height, width, _ = frame.shape
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _gif(packed: Sequence[bytes], period_s: float) -> bytes:
    """Make the GIF of frames that were kept, with one palette for all: what does not move then costs nothing."""
    step = max(1, len(packed) // _PALETTE_FRAMES)
    samples = [_image(data) for data in packed[::step]]
    mosaic = Image.new("RGB", (samples[0].width, samples[0].height * len(samples)))
    for number, sample in enumerate(samples):
        mosaic.paste(sample, (0, number * sample.height))
    colors = _gif_colors(mosaic)
    first, *others = (_in_colors(_image(data), colors) for data in packed)
    out = io.BytesIO()
    first.save(out, "gif", save_all=True, append_images=others, duration=round(1000 * period_s), loop=0, optimize=False)
    return out.getvalue()


def _gif_colors(frames: Image.Image) -> NDArray[np.uint8]:
    """Return the GIF's colours, [256, 3]: the palette's of all pictures, frequent ones, and what covers the rest.

    Args:
        frames: RGB; some of those that will be shown, in one picture.
    """
    found, counts = np.unique(_packed(frames), return_counts=True)
    frequent = _unpacked(found[np.argsort(counts)[::-1][:_FREQUENT_COLORS]])
    exact = np.unique(np.concatenate([np.array([*map(rgb, astuple(LIGHT))], np.uint8), frequent]), axis=0)
    covering = frames.quantize(_GIF_COLORS - len(exact), Image.Quantize.MAXCOVERAGE).getpalette() or []
    colors = np.zeros((_GIF_COLORS, 3), np.uint8)
    given = np.concatenate([exact, np.array(covering, np.uint8).reshape(-1, 3)])
    colors[: len(given)] = given
    return colors


def _in_colors(image: Image.Image, colors: NDArray[np.uint8]) -> Image.Image:
    """Return a picture with a palette, each pixel in the nearest colour; Pillow takes one that is near alone."""
    found, places = np.unique(_packed(image), return_inverse=True)
    _, nearest = cKDTree(colors).query(_unpacked(found))
    shown = Image.fromarray(nearest[places].astype(np.uint8).reshape(image.height, image.width))
    shown.putpalette(colors.tobytes())
    return shown


def _packed(image: Image.Image) -> NDArray[np.uint32]:
    """Return an RGB picture's pixels as one number each."""
    red, green, blue = np.asarray(image, np.uint32).reshape(-1, 3).T
    return np.asarray(red << 16 | green << 8 | blue, np.uint32)


def _unpacked(packed: NDArray[np.uint32]) -> NDArray[np.uint8]:
    """Return red, green and blue of such numbers, [n, 3]."""
    return np.stack([packed >> 16, packed >> 8 & 255, packed & 255], axis=-1).astype(np.uint8)


def _image(data: bytes) -> Image.Image:
    return Image.open(io.BytesIO(data)).convert("RGB")
