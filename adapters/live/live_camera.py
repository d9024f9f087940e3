"""A camera that runs, as the channel that is asked for co-evidence."""

from collections import deque
from collections.abc import Callable, Collection, Iterable
from dataclasses import replace

import numpy as np

from worldstate.abduction.co_evidence import CoEvidence
from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog
from worldstate.adapters.camera.vision_query import VisionQuery
from worldstate.adapters.listen import Source
from worldstate.ground.values import NotUsable
from worldstate.measurement.measurement import Bearing, Look, Side, Sighting

# Looks that are remembered: whether a box stands still is asked over the last second, and a camera of more
# than 60 images a second brings nothing to a decision every 0.1 s.
REMEMBERED = 64

StampedFrames = Iterable[tuple[int, DetectionFrame]]


class LiveCamera:
    """Answers as `VisionQuery` does over a recording, from the last looks of a running detector.

    Parameters
    ----------
    source : Source
        Lens, miss rates, context and boxes that count.
    new_looks : callable
        Returns the looks since it was asked last: time of capture on the stream's clock, nanoseconds, and
        what was detected. A look that is no later than the one before is left out.
    degradation : callable
        Returns d of the camera at a stamp.
    """

    def __init__(
        self,
        source: Source,
        new_looks: Callable[[], StampedFrames],
        degradation: Callable[[int], float] = lambda stamp_ns: 0.0,
    ) -> None:
        self._source = replace(source, degradation=degradation)
        self._new_looks = new_looks
        self._looks: deque[tuple[int, DetectionFrame]] = deque(maxlen=REMEMBERED)
        self._channel = self._over_looks()

    def ask(
        self,
        stamp_ns: int,
        bearing: Bearing | NotUsable,
        expected_labels: Collection[str] | None = None,
        side: Side | None = None,
    ) -> CoEvidence:
        """Search a sector of the last image at or before the stamp."""
        return self._current().ask(stamp_ns, bearing, expected_labels, side)

    def sightings(self, stamp_ns: int) -> tuple[Sighting, ...]:
        """Return the boxes that count in that image."""
        return self._current().sightings(stamp_ns)

    def last_look(self, stamp_ns: int) -> Look | None:
        """Return what the whole image says, None without one."""
        return self._current().last_look(stamp_ns)

    def _current(self) -> VisionQuery:
        news = False
        for stamp_ns, frame in self._new_looks():
            if not self._looks or stamp_ns > self._looks[-1][0]:
                self._looks.append((stamp_ns, frame))
                news = True
        if news:
            self._channel = self._over_looks()
        return self._channel

    def _over_looks(self) -> VisionQuery:
        stamps_ns = np.array([stamp_ns for stamp_ns, _ in self._looks], dtype=np.int64)
        log = DetectionLog(tuple(frame for _, frame in self._looks), stamps_ns, "the camera")
        on_sound_clock = log.shifted(self._source.camera.stamp_offset_s)
        return replace(self._source, detections=on_sound_clock).camera_channel()
