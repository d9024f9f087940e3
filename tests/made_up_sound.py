"""Made-up sound at the microphones of an array, and models that fit an array."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from plane_waves import noise_from

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.adapters.files.acoustic_domain import domain_of
from worldstate.adapters.files.model_file import Model, read_model
from worldstate.frontend.array.microphone_array import MicrophoneArray

THREE = MicrophoneArray([[0.0, 0.2, 0.0], [0.1, 0.0, 0.0], [0.0, -0.3, 0.0]], "three")


def plane_wave(
    array: MicrophoneArray, rate_hz: float, azimuth_rad: float, seconds: float, seed: int = 3
) -> np.ndarray:
    """Return broadband sound from far away with a little noise of every microphone's own, shape (n, M)."""
    return 0.05 * noise_from(array, azimuth_rad, rate_hz, seconds, seed, noise=0.05)


class Fixed:
    """A signature model with one result for every window."""

    def __init__(self, *hidden: float, visible: float = 0.0, none: float = 0.0) -> None:
        self.said = SignatureEvidence(("left", "right"), hidden or (0.0, 0.0), visible, none)

    def evidence(self, feature: ArrayLike, /) -> SignatureEvidence:
        return self.said


def model_of(array: MicrophoneArray, rate_hz: float = 6000.0) -> Model:
    """Return the shipped model as if it were made for an array."""
    shipped, domain = read_model(), domain_of(array, [rate_hz], ["SA1"])
    return replace(shipped, signature=replace(shipped.signature, domain=domain))
