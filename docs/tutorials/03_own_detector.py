"""Your own detector: the evidence of an image without a vehicle, and the miss rate of the detector."""

import numpy as np

from worldstate import Absent, SignatureEvidence, Unqueried
from worldstate.abduction import abduce

# The sound fits a hidden vehicle on the left as well as a visible one: log-likelihoods in nats.
sound, prior = SignatureEvidence(("left", "right"), (2.0, 0.0), visible=2.0, none=0.0), np.zeros(4)
print(f"no image: P(hidden) {abduce(prior, sound, Unqueried('no image')).hidden_total:.2f}")
for miss_rate in (0.6, 0.15, 0.02):
    hidden = abduce(prior, sound, Absent(miss_rate)).hidden_total
    print(f"no vehicle found, miss rate {miss_rate:.2f}: P(hidden) {hidden:.2f}")

# The figure: the miss rate of a detector, measured on images with a known position of the vehicle.
from types import SimpleNamespace

from tutorial_figures import tutorial_figure

from worldstate import DetectionFrame, PinholeCamera
from worldstate.adapters import DetectionLog, save_miss_rates
from worldstate.operations import AbsenceSettings, measure_absence
from worldstate.operations.detectors.miss_rate_measurement import LabelledVideo
from worldstate.operations.figure_style import HEARD

rng, lefts, levels = np.random.default_rng(1), np.linspace(0.0, 280.0, 400), np.linspace(0.0, 1.0, 21)


class BrightColumns:
    """A detector without training: one box around all columns that are brighter than the road."""

    def detect(self, image: np.ndarray) -> DetectionFrame:
        """Return the boxes of one image of shape (height, width, 3)."""
        bright = np.flatnonzero((road := image[90:150].mean(axis=(0, 2))) > 1.25 * np.median(road))
        boxes = [[bright[0], 90, bright[-1] + 1, 150]] if bright.size > 8 else np.empty((0, 4))
        return DetectionFrame(np.array(boxes, float), np.full(len(boxes), 0.9), ("car",) * len(boxes))


def image(left_px: float) -> np.ndarray:
    """Return an image of a car on a road that is darker towards the edges."""
    drawn = rng.normal(60.0, 8.0, (200, 320, 3)) + rng.uniform(-8.0, 8.0)
    drawn[90:150, int(left_px) : int(left_px) + 40] += 60.0 - 45.0 * ((left_px - 140.0) / 140.0) ** 2
    return drawn.clip(0, 255).astype(np.uint8)


boxes = [np.array([[left, 90.0, left + 40.0, 150.0]]) for left in lefts]
truth = DetectionLog.at_rate([DetectionFrame(box, np.ones(1), ("car",)) for box in boxes], 10.0)
images = SimpleNamespace(frames=lambda: map(image, lefts), count=len(lefts))
video = LabelledVideo(images, truth, PinholeCamera.ovad(width_px=320, height_px=200))
rates = measure_absence([video], BrightColumns, rng, AbsenceSettings(families=("noise",)))
with tutorial_figure(__file__, 8.0, 3.6) as figure:
    save_miss_rates("out/tutorials/my_detector.json", rates)  # for the key `miss_rates` of a camera
    beta, worth = figure.subplots(1, 2, sharex=True, sharey=True)
    for degrees in (0.0, 20.0, 30.0):
        missed = [rates.table(np.radians(degrees), level) for level in levels]
        beta.plot(levels, missed, label=f"{degrees:.0f} degrees off the axis")
        worth.plot(levels, [abduce(prior, sound, Absent(one)).hidden_total for one in missed])
    worth.axhline(abduce(prior, sound, Unqueried("")).hidden_total, color=HEARD, label="no image")
    beta.set(ylim=(0, 1), title="miss rate", xlabel="noise in the image, d")
    worth.set(title="P(hidden) if no vehicle is found", xlabel="noise in the image, d")
    _ = beta.legend(loc="upper left"), worth.legend(loc="lower left")
