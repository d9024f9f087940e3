"""A detector of your own: how often it misses, by azimuth and noise, and what its silence is worth."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
from tutorial_options import tutorial_options

from worldstate import Absent, DetectionFrame, PinholeCamera, SignatureEvidence, Unqueried
from worldstate.abduction import abduce
from worldstate.adapters import DetectionLog, save_miss_rates
from worldstate.operations import AbsenceSettings, measure_absence
from worldstate.operations.detectors.miss_rate_measurement import LabelledVideo
from worldstate.operations.figure_style import figure_file

HEARD = SignatureEvidence(("left", "right"), hidden=(2.0, 0.0), visible=2.0, none=0.0)  # nats
EVEN, LEVELS = np.zeros(4), np.linspace(0.0, 1.0, 21)  # log prior; degradation d


class BrightColumns:
    """A detector without training: one box around the columns that are brighter than the road."""

    def detect(self, image: np.ndarray) -> DetectionFrame:
        """Return the boxes of one image of shape (height, width, 3)."""
        bright = np.flatnonzero((road := image[90:150].mean(axis=(0, 2))) > 1.25 * np.median(road))
        boxes = [[bright[0], 90, bright[-1] + 1, 150]] if bright.size > 8 else np.empty((0, 4))
        return DetectionFrame(np.array(boxes, float), np.full(len(boxes), 0.9), ("car",) * len(boxes))


def street(left_px: float, rng: np.random.Generator) -> np.ndarray:
    """Return an image of a car on a road that lies in shade towards the edges."""
    image = rng.normal(60.0, 8.0, (200, 320, 3)) + rng.uniform(-8.0, 8.0)
    image[90:150, int(left_px) : int(left_px) + 40] += 60.0 - 45.0 * ((left_px - 140.0) / 140.0) ** 2
    return image.clip(0, 255).astype(np.uint8)


def main(out: Path, size: str = "full") -> None:
    """Measure beta of the detector, and draw what an empty look does to what was heard."""
    rng, lefts = np.random.default_rng(1), np.linspace(0.0, 280.0, 60 if size == "small" else 400)
    boxes = [np.array([[left, 90.0, left + 40.0, 150.0]]) for left in lefts]
    truth = DetectionLog.at_rate([DetectionFrame(box, np.ones(1), ("car",)) for box in boxes], 10.0)
    images = SimpleNamespace(frames=lambda: (street(left, rng) for left in lefts), count=len(lefts))
    scene = LabelledVideo(images, truth, PinholeCamera.ovad(width_px=320, height_px=200))
    rates = measure_absence([scene], BrightColumns, rng, AbsenceSettings(families=("noise",)))
    save_miss_rates(out / "my_detector.json", rates)  # for `worldstate run --miss-rates my_detector.json`
    with figure_file(out / "03_own_detector.png", 8.0, 3.6) as figure:
        beta, worth = figure.subplots(1, 2, sharex=True)
        for degrees in (0.0, 20.0, 30.0):
            missed = [rates.table(np.radians(degrees), d) for d in LEVELS]
            beta.plot(LEVELS, missed, label=f"{degrees:.0f} degrees off the axis")
            worth.plot(LEVELS, [abduce(EVEN, HEARD, Absent(one)).hidden_total for one in missed])
            print(f"{degrees:.0f} degrees: misses {missed[0]:.2f} of clear looks, {missed[-1]:.2f} at d = 1")
        worth.axhline(abduce(EVEN, HEARD, Unqueried("")).hidden_total, color="k", label="no look")
        beta.set(ylim=(0, 1), xlabel="degradation d (noise)", ylabel="miss rate")
        worth.set(ylim=(0, 1), xlabel="degradation d (noise)", ylabel="P(hidden) after an empty look")
        _ = beta.legend(), worth.legend()


if __name__ == "__main__":
    main(*tutorial_options(__doc__))
