"""Grounded acoustic evidence: classifier scores combined with bearing, approach and engine line, eq. (5)."""

from dataclasses import dataclass, field

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.abduction.grounding.grounded_likelihood import (
    Descriptor,
    GroundedAnswer,
    GroundedObservation,
    GroundedSettings,
    Observable,
    car,
    ground,
    motorcycle,
)
from worldstate.frontend.frame import AcousticFrame
from worldstate.ground.values import NotUsable
from worldstate.measurement.measurement import Approach, Bearing

LINE_SPACING = "line_spacing_hz"


@dataclass(frozen=True, slots=True)
class Grounding:
    """Which road users are reckoned with, and which ties between their sound and their motion.

    Parameters
    ----------
    descriptors : tuple of Descriptor
        Classes of road users, at least one.
    settings : GroundedSettings
        Sectors, and couplings that are switched off.

    Examples
    --------
    >>> scores = SignatureEvidence(("left", "right"), (1.0, -1.0), 0.0, 0.0)
    >>> observation = GroundedObservation(inverse_tta_hz=Observable(0.4, 0.05))
    >>> answer = Grounding().answer(scores, observation)
    >>> answer.best.entity_class, answer.evidence.hidden[0] > 1.0
    ('motor_vehicle', True)
    """

    descriptors: tuple[Descriptor, ...] = (car(), motorcycle())
    settings: GroundedSettings = field(default_factory=GroundedSettings)

    def answer(self, signature: SignatureEvidence, observation: GroundedObservation) -> GroundedAnswer:
        """Return likelihoods of the explanations and the hidden state that explains the observation best.

        Parameters
        ----------
        signature : SignatureEvidence
            From calibrated scores.
        observation : GroundedObservation
            From `observe`.
        """
        return ground(signature, observation, self.descriptors, self.settings)


def observe(
    frame: AcousticFrame, bearing: Bearing | NotUsable, approach: Approach | NotUsable
) -> GroundedObservation:
    """Return what a frame says beside its feature; spreads are those of the estimators' own bounds."""
    # Where the front-end looks for an engine line (`FrontEndSettings.tone_band_hz`), it is the spacing of the
    # harmonics: two firings a turn leave the first of them the strongest.
    tone, lines = frame.tone, {}
    if not isinstance(tone, NotUsable):
        lines[LINE_SPACING] = Observable(tone.frequency_hz, tone.frequency_std_hz)
    return GroundedObservation(
        bearing_rad=bearing
        if isinstance(bearing, NotUsable)
        else Observable(bearing.azimuth_rad, bearing.std_rad),
        inverse_tta_hz=approach
        if isinstance(approach, NotUsable)
        else Observable(approach.inverse_tta_hz, approach.std_hz),
        signature=lines,
    )
