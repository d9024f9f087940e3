"""What a detector of one's own reports, image by image, as datagrams on a socket."""

from collections.abc import Callable

from worldstate.adapters.camera.detections import DetectionFrame, frame_of

from .datagram_socket import DatagramSocket


class DetectionSocket(DatagramSocket[DetectionFrame]):
    """Looks that arrive as UDP datagrams: OVAD's record of one image, and the age of the image when sent.

    ``{"boxes": [[x1, y1, x2, y2], ...], "scores": [...], "classes_str": [...], "age_s": 0.04}``; an image in
    which nothing was found is sent, too: it was searched. A datagram that is lost is an image not asked.
    """

    def __init__(self, address: str, stamp_ns: Callable[[float], int]) -> None:
        super().__init__(address, stamp_ns, lambda record: frame_of(record, "datagram"), "--detections")
