"""Images of a recording's video as JPEG, one for each hop."""

from collections.abc import Callable, Iterator
from pathlib import Path

from worldstate.adapters.camera.video import VIDEO_NAME, open_video, opencv
from worldstate.ground.values import nanoseconds

from .log_message import LogMessage, image_message

# OVAD's images, 1936 pixels wide, are shown in a third of a screen: halved they take 77 kB in a log, not 245.
_WIDEST_PX, _QUALITY = 1000, 80


def camera_images(recording: Path, start_ns: int = 0) -> Callable[[int], Iterator[LogMessage]]:
    """Return what yields the last image before a stamp, asked in order of time, if it is a new one."""
    path = recording / VIDEO_NAME
    if not path.is_file():
        return lambda stamp_ns: iter(())
    cv2, video = opencv(), open_video(path)
    frames = enumerate(video.frames())
    ahead = next(frames, None)

    def image_before(stamp_ns: int) -> Iterator[LogMessage]:
        nonlocal ahead
        shown = None
        while ahead is not None and start_ns + nanoseconds(ahead[0] / video.frame_rate_hz) <= stamp_ns:
            shown, ahead = ahead, next(frames, None)
        if shown is not None:
            step = -(-video.width_px // _WIDEST_PX)
            size = video.width_px // step, video.height_px // step
            small = cv2.resize(shown[1], size, interpolation=cv2.INTER_AREA)
            _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
            yield image_message(start_ns + nanoseconds(shown[0] / video.frame_rate_hz), jpeg.tobytes())

    return image_before
