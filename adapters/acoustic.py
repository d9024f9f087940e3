"""The acoustic adapter turns blocks of samples into measurements."""

import math
from collections import Counter
from collections.abc import Mapping
from operator import itemgetter
from typing import Any, Protocol

import numpy as np

from worldstate.abduction.co_evidence import Unqueried
from worldstate.abduction.evidence import SignatureEvidence, with_bearing_vote
from worldstate.abduction.grounding.grounded_likelihood import LINE_SPACING, GroundedObservation, Observable
from worldstate.abduction.grounding.grounded_likelihood import Grounding as Grounding
from worldstate.abduction.road_users import (
    ClassShares,
    DomainGuard,
    Foreign,
    RoadUserModel,
    expected_labels,
    heard_kinds,
    neutral,
)
from worldstate.abduction.sequence.sequence_inputs import SIDES, hop_columns
from worldstate.abduction.sequence.sequence_reader import SequenceReader, SequenceReading
from worldstate.abduction.signature.published_signature import ModelDomain
from worldstate.adapters.camera.vision_query import SeveralCameras
from worldstate.adapters.files.acoustic_domain import feature_order
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.direction.bearing import direct_probability
from worldstate.frontend.direction.feature import feature_nfft
from worldstate.frontend.given_spectra import GivenSpectra, SpectrumFrontEnd
from worldstate.frontend.health.common_sound import ARRAY_FAULTS
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.spectra.sound_character import BANDS, MEASURES
from worldstate.frontend.stream import AcousticFrame, FrontEnd
from worldstate.ground import LEAST_HEARD, NotUsable, OutOfDomainError, falling, replaced, wrap_angle
from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.measurement import Approach, Bearing, CoEvidenceChannel, Heard, Measurement
from worldstate.measurement.measurement import MeasurementAdapter

# Loudness is the mean level of these bands. The sequence models were trained with this definition.
LEVEL_BAND_HZ = (50.0, 2700.0)
# Shares of dead channels and of clipped samples. In six simulated demos the evidence per side had an error of
# 0.2 nats with 28 of 56 channels dead, 1.2 with 42 and 2.1 with 50. The error was 0.06 nats with 10 % of the
# samples clipped and 0.7 with 40 %. For comparison, the evidence changes by 0.46 nats within 1 s.
_DEAD, _CLIPPED = (0.5, 0.85), (0.1, 0.5)
# A source in view masks others if its level is this far above the quiet street. Masking is never complete,
# because a second, louder source behind it can still be detected.
_LOUD_DB, _MOST_MASKED = (6.0, 15.0), 0.75
# Above this share no reason is given.
_SAID = 0.95
# Reason for a low audibility beside a sound that the guard rejects as foreign.
FOREIGN = "a sound that the models do not know"
# If the standard deviation of the bearing is larger, the whole side is searched for co-evidence, not a
# sector. Below it, the sector contains nine of ten simulated vehicles in view.
_COARSE_STD_RAD = math.radians(25.0)


class Signature(Protocol):
    """Interface of a signature model such as `abduction.signature.published_signature.SignatureModel`.

    Examples
    --------
    >>> class Flat:
    ...     def evidence(self, feature): return SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)
    >>> model: Signature = Flat()
    >>> model.evidence([0.0]).none
    0.0
    """

    def evidence(self, feature: FloatArray, /) -> SignatureEvidence:
        """Return log-likelihoods of one feature vector."""


class AcousticAdapter(MeasurementAdapter[Float32Array]):
    """Measures hidden and visible road users by their sound, with co-evidence from a camera.

    Parameters
    ----------
    array : MicrophoneArray
        One microphone per channel.
    sample_rate_hz : float
        Sample rate of the blocks.
    model : Signature or None
        Maps the feature of a window to log-likelihoods. Without a model only bearings are measured.
    vision : CoEvidenceChannel, optional
        Camera, searched once per hop. Without it the co-evidence is `Unqueried`.
    start_ns : int
        Stamp of the first sample on the stream's clock.
    front_end_settings : FrontEndSettings, optional
        Settings of the front-end.
    grounding : Grounding, optional
        Combines the model's scores with bearing, approach rate and engine line by eq. (5). Without it the
        scores are used unchanged.
    guard : DomainGuard, optional
        Detects foreign sounds and warning signals. The evidence of a foreign sound is reduced by the guard's
        margin.
    road_users : RoadUserModel, optional
        Classifies road users by their sound; the camera is searched for these classes.
    sequence : SequenceReader or NotUsable, optional
        Estimates the sides from which a vehicle comes, and when, from seconds of evidence; or the reason why
        no sequence is used.
    uncalibrated : bool
        Accept another array, sample rate or band than the model was made for. Then give the filter a policy
        with alpha 0, because the false-alarm budget is not guaranteed.
    kinds : mapping of str to float, optional
        Share of each kind of road user that the model detected in its evaluation.

    Attributes
    ----------
    source : str
        ``"acoustic"``.
    front_end : FrontEnd
        Turns blocks into frames. Use it with `interpret` if you need both frames and measurements.
    last_frame : AcousticFrame or None
        Frame of the last hop, for plots.

    Raises
    ------
    InvalidArgumentError
        If the array, the rate or a setting does not fit; see `FrontEnd`.
    OutOfDomainError
        If the model has a `domain` and was made for another array, rate or feature, or if the guard or the
        road user model was made for other measures.

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import roof_array_56
    >>> class Flat:
    ...     def evidence(self, feature): return SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)
    >>> adapter = AcousticAdapter(roof_array_56(), 48_000, Flat())
    >>> import numpy as np
    >>> noise = np.random.default_rng(0).standard_normal((52_800, 56)).astype(np.float32)
    >>> [(m.stamp_ns, m.co_evidence.reason) for m in adapter.measure(noise)]
    [(1000000000, 'no camera'), (1100000000, 'no camera')]
    """

    def __init__(
        self,
        array: MicrophoneArray,
        sample_rate_hz: float,
        model: Signature | None,
        vision: CoEvidenceChannel | None = None,
        *,
        start_ns: int = 0,
        front_end_settings: FrontEndSettings | None = None,
        grounding: Grounding | None = None,
        guard: DomainGuard | None = None,
        road_users: RoadUserModel | None = None,
        sequence: SequenceReader | NotUsable | None = None,
        uncalibrated: bool = False,
        kinds: Mapping[str, float] | None = None,
    ) -> None:
        domain: ModelDomain | None = getattr(model, "domain", None)
        settings, asked = front_end_settings, dict[str, Any]()
        if settings is None:
            # A model without a domain receives the sound at its recorded rate.
            own = FrontEndSettings(nfft=feature_nfft(sample_rate_hz))
            settings = own if domain is None else FrontEndSettings.heard_at(sample_rate_hz)
        if domain is not None and not uncalibrated:
            asked["feature_order"] = feature_order(domain, array, sample_rate_hz, settings)
        if model is None:  # A bearing is wanted as soon as a sound begins, so rises in level are kept
            asked["mask_rises"] = False
        if guard is not None and guard.measures != MEASURES:
            raise OutOfDomainError(f"guard: expected one of {len(MEASURES)} measures of this version")
        if road_users is not None and road_users.measures != (*MEASURES, *BANDS):
            expected = f"one of {len(MEASURES) + len(BANDS)} measures of this version"
            raise OutOfDomainError(f"road users: expected {expected}, got {len(road_users.measures)} others")
        if guard is not None or road_users is not None:
            asked["character"] = True
        if isinstance(sequence, SequenceReader):
            asked["level_band_hz"] = LEVEL_BAND_HZ
        settings = replaced(settings, **asked)
        self.source = "acoustic"
        self.front_end: FrontEnd | SpectrumFrontEnd
        self.front_end = FrontEnd(array, sample_rate_hz, settings, start_ns=start_ns)
        self.last_frame: AcousticFrame | None = None
        self._model, self._vision, self._grounding = model, vision, grounding
        self._guard, self._road_users = guard, road_users
        self._sequence, self._kinds = sequence, kinds
        self._directions: tuple[str, ...] = SIDES

    def measure(self, block: Float32Array, /) -> list[Measurement]:
        """Take the next samples; return a measurement for each hop that ends in them.

        Parameters
        ----------
        block : ndarray
            Shape (n, M), any n; floats of full scale 1, int16 or int32.

        Returns
        -------
        list of Measurement
            The first after one second, then one every 0.1 s.

        Raises
        ------
        InvalidArgumentError
            If the number of channels is wrong, or a sample is NaN or infinite.
        """
        return [self.interpret(frame) for frame in self.front_end.process(block)]

    def take_spectra(self, spectra: GivenSpectra, start_ns: int) -> None:
        """Use spectra that were computed elsewhere, and one channel of sound."""
        rate, settings = self.front_end.sample_rate_hz, self.front_end.settings
        self.front_end = SpectrumFrontEnd(spectra, rate, settings, start_ns=start_ns)

    def interpret(self, frame: AcousticFrame, outside: str | None = None) -> Measurement:
        """Turn a frame into a measurement that includes the result of the camera.

        The bearing of direct sound is evidence for its side. The bearing of reflected sound, or a coarse one,
        gives only the half of the street in which the peak is, so the signature determines the side. If
        `outside` gives a reason why the hop is out of the models' domain, the models are not applied.
        """
        # Without a model, a loud sound cannot be taken for a vehicle in view that masks others.
        loud = replaced(frame, peaks=()) if self._model is None else frame
        self.last_frame, heard = frame, Heard(0.0, outside) if outside else heard_of(loud, self._kinds)
        told: dict[str, Any] = {"stamp_ns": frame.stamp_ns, "kinds": (), "heard": heard}
        told |= self._read(frame, heard) if heard.usable else self._unheard(heard)
        told |= _asked(told, self._vision)
        # Built at once, so that it is validated only once.
        return Measurement(**told, source=self.source, fault=_array_fault(frame))

    def _unheard(self, heard: Heard) -> dict[str, Any]:
        """Return the parts of the measurement of an unusable hop, with even likelihoods."""
        refused, reader = NotUsable(heard.reason or "not heard"), self._sequence
        if isinstance(reader, SequenceReader):
            reader.miss()
        return {
            "signature": SignatureEvidence(self._directions, (0.0,) * len(self._directions), 0.0, 0.0),
            "bearing": refused,
            "approach": refused,
            "sequence": refused if isinstance(reader, SequenceReader) else reader,
        }

    def _read(self, frame: AcousticFrame, share: Heard) -> dict[str, Any]:
        """Return the parts of the measurement that the models infer from a hop."""
        if self._model is None:
            return self._unheard(share) | {"bearing": _bearing(frame), "approach": _approach(frame)}
        heard = signature = self._model.evidence(frame.feature)
        self._directions = signature.directions
        bearing, approach = _bearing(frame), _approach(frame)
        if isinstance(bearing, Bearing):
            direct = direct_probability(frame.peaks)
            signature = with_bearing_vote(signature, bearing.azimuth_rad, bearing.std_rad, direct)
        if self._grounding is not None:
            signature = self._grounding.answer(signature, observe(frame, bearing, approach)).evidence
        domain, character = None, frame.character
        kinds: ClassShares = ()
        if not isinstance(character, NotUsable):
            domain = None if self._guard is None else self._guard.judge(character[: len(MEASURES)])
            kinds = () if self._road_users is None else heard_kinds(self._road_users, character, domain)
        if isinstance(domain, Foreign) and self._guard is not None:
            signature, heard = (neutral(one, self._guard.margin) for one in (signature, heard))
            share = beside_foreign(domain, share)
        # The sequence receives the model's evidence alone, because bearing and looming are separate inputs.
        reader = self._sequence
        sequence = read_hop(reader, heard, frame) if isinstance(reader, SequenceReader) else reader
        read = {"heard": share, "signature": signature, "bearing": bearing, "approach": approach}
        return read | {"domain": domain, "kinds": kinds, "sequence": sequence}


def read_hop(
    reader: SequenceReader, signature: SignatureEvidence, frame: AcousticFrame
) -> SequenceReading | NotUsable:
    """Return the result of a sequence after one more hop of evidence and front-end measures."""
    sides, looming = signature.sides, frame.looming
    if sides is None:
        return NotUsable("the model has no evidence per side")
    known = None if isinstance(looming, NotUsable) else looming
    hop = {
        "feature": frame.feature,
        "band_log_energy": frame.band_log_energy,
        "prominence": frame.prominence,
        "looming_hz": np.nan if known is None else known.inverse_tta_hz,
        "looming_std_hz": np.nan if known is None else known.std_hz,
        "bearing_rad": frame.bearing_rad,
    }
    rows = {name: np.array([value]) for name, value in hop.items()}
    columns = hop_columns(np.array([sides.log_ratios]), np.array([sides.visible]), **rows)
    return reader.read(columns, frame.feature)


def heard_of(frame: AcousticFrame, kinds: Mapping[str, float] | None = None) -> Heard:
    """Return the probability that a hidden vehicle would have been detected in the sound of a hop.

    It is the minimum over lost samples, noise, excluded channels, clipping and a loud source in view. `kinds`
    is the share of each kind of road user that the model detected in its evaluation.
    """
    if frame.heard is None:
        return Heard(measured=False)
    if (frame.feature <= 0.0).any():
        # Fewer than two microphones are usable.
        return Heard(0.0, frame.unheard or "dead channels")
    in_view = direct_probability(frame.peaks) * (1.0 - falling(frame.excess_db, _LOUD_DB))
    left = [(frame.heard, frame.unheard), (1.0 - _MOST_MASKED * in_view, "loud source in view")]
    health = frame.health
    if not isinstance(health, NotUsable):
        dead = 1.0 - health.mask.n_kept / len(health.mask.keep)
        left += [(falling(dead, _DEAD), "dead channels"), (falling(health.clipped, _CLIPPED), "clipped")]
    share, reason = min(left, key=itemgetter(0))
    return Heard(share, reason if share < _SAID else None, frame.excess_db, kinds=kinds)


def beside_foreign(foreign: Foreign, heard: Heard) -> Heard:
    """Return the probability that a hidden vehicle would have been detected beside a foreign sound.

    The share is multiplied by the probability that the sound is not foreign. A model that was not trained on
    a sound can infer neither a vehicle nor silence from it, so the earlier belief is kept.
    """
    return replaced(heard, share=heard.share / (1.0 + math.exp(min(foreign.log_odds, 700.0))), reason=FOREIGN)


def asked_again(measurement: Measurement, vision: CoEvidenceChannel | None) -> Measurement:
    """Return a measurement with new results of a camera, or of none. The acoustic part is unchanged."""
    told = {name: getattr(measurement, name) for name in ("stamp_ns", "bearing", "kinds", "signature")}
    return replaced(measurement, **_asked(told, vision))


def _asked(told: Mapping[str, Any], vision: CoEvidenceChannel | None) -> dict[str, Any]:
    """Return the results of a camera for the sound of a measurement, `Unqueried` without a camera."""
    if vision is None:
        return {"co_evidence": Unqueried("no camera"), "sightings": (), "look": None, "further": ()}
    stamp_ns, bearing, labels = told["stamp_ns"], told["bearing"], expected_labels(told["kinds"])
    if isinstance(bearing, Bearing) and bearing.std_rad <= _COARSE_STD_RAD:
        answer = vision.ask(stamp_ns, bearing, labels)
    else:
        answer = vision.ask(stamp_ns, NotUsable("coarse bearing"), labels, told["signature"].likelier_side)
    found = {"co_evidence": answer, "sightings": vision.sightings(stamp_ns)}
    further = vision.looks(stamp_ns)[1:] if isinstance(vision, SeveralCameras) else ()
    return found | {"look": vision.last_look(stamp_ns), "further": further}


def _bearing(frame: AcousticFrame) -> Bearing | NotUsable:
    if not math.isfinite(frame.bearing_rad):
        return NotUsable("no peak in the spatial spectrum")
    if frame.prominence <= frame.least_prominence:
        ratio = f"{frame.prominence:.2f}, not above {frame.least_prominence:.2f}"
        return NotUsable(f"peak-to-median ratio {ratio}")
    return Bearing(wrap_angle(frame.bearing_rad), frame.bearing_std_rad, frame.prominence, frame.at_edge)


def _approach(frame: AcousticFrame) -> Approach | NotUsable:
    looming = frame.looming
    return looming if isinstance(looming, NotUsable) else Approach(looming.inverse_tta_hz, looming.std_hz)


def _array_fault(frame: AcousticFrame) -> str | None:
    """Return why no microphone is usable, or the number of microphones per fault; None without a fault."""
    health = frame.health
    if frame.heard is not None and frame.heard < LEAST_HEARD and frame.unheard in ARRAY_FAULTS:
        return frame.unheard
    if isinstance(health, NotUsable) or not health.faults:
        return None
    counts = Counter(one.fault.value for one in health.faults)
    return "microphones: " + ", ".join(f"{count} {fault}" for fault, count in sorted(counts.items()))


def observe(
    frame: AcousticFrame, bearing: Bearing | NotUsable, rate: Approach | NotUsable
) -> GroundedObservation:
    """Return the observables of a frame other than its feature, with the estimators' standard deviations."""
    # An engine line within `FrontEndSettings.tone_band_hz` is the spacing of the harmonics: with two firings
    # per revolution the first harmonic is the strongest.
    tone, lines = frame.tone, {}
    if not isinstance(tone, NotUsable):
        lines[LINE_SPACING] = Observable(tone.frequency_hz, tone.frequency_std_hz)
    heard = bearing if isinstance(bearing, NotUsable) else Observable(bearing.azimuth_rad, bearing.std_rad)
    near = rate if isinstance(rate, NotUsable) else Observable(rate.inverse_tta_hz, rate.std_hz)
    return GroundedObservation(bearing_rad=heard, inverse_tta_hz=near, signature=lines)
