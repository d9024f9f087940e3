"""The whole chain over a recording: sound in, one world-state a hop out."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from worldstate.abduction.cueing.cueing_policy import CueingPolicy
from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.abduction.signature.signature_io import AnySignature
from worldstate.abduction.signature.site_estimate import SiteEstimate, SiteEstimateSettings
from worldstate.abduction.signature.site_signature import SiteSignature
from worldstate.adapters.audio.sound_file import open_audio
from worldstate.adapters.camera.camera_channel import video_degradation
from worldstate.adapters.camera.detections import DetectionLog, read_detections
from worldstate.adapters.camera.miss_rates import MissRates, load_miss_rates
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.video import VIDEO_NAME, open_video
from worldstate.adapters.camera.vision_query import VisionQuery
from worldstate.adapters.datasets.array_choice import choose_array
from worldstate.adapters.datasets.ovad import Recording
from worldstate.adapters.files.array_file import read_array_xml
from worldstate.adapters.files.model_file import load_model
from worldstate.core.filter import WorldFilter
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.ego_noise.ego_noise import EgoNoiseSettings
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.stream import AcousticFrame
from worldstate.measurement.measurement import Measurement
from worldstate.measurement.sector import Sector
from worldstate.state import Context, WorldState

from .acoustic import AcousticAdapter, Signature
from .acoustic_grounding import Grounding

BLOCKS_PER_SECOND = 20


@dataclass(frozen=True, slots=True)
class Source:
    """A recording with all that is needed to listen to it.

    Parameters
    ----------
    audio_path : Path
        Multichannel sound file.
    array : MicrophoneArray
        One microphone a channel, in the order of the channels.
    detections : DetectionLog or None
        What the camera reported; None counts as not asked.
    model : SignatureModel or EnsembleModel
        From features to likelihoods.
    policy : CueingPolicy
        Threshold, sustained rule and risk map.
    context : Context
        Rates, occluders, ego motion.
    t0_s : float or None
        Line-of-sight entry where the recording knows it, seconds from its start.
    mask_dead : bool
        Listen without silent channels instead of refusing them.
    miss_rates : MissRates or None
        Measured for the camera's detector; the defaults of `VisionQuery` without.
    degradation : float or callable
        d of the camera, or a function from the stamp to it.
    site_settings : SiteEstimateSettings or None
        How the site is learned while listening; None for not at all, and without effect on a model that does
        not compare windows with their site.
    site : SiteEstimate or None
        What is known of the site beforehand, from a checkpoint.
    grounding : Grounding or None
        Weighs the model's scores with bearing, approach and engine line, eq. (5).
    ego_noise : EgoNoiseSettings or None
        Learn the own vehicle's noise while the filter believes that nothing is there, and hear past it.
    """

    audio_path: Path
    array: MicrophoneArray
    detections: DetectionLog | None
    model: AnySignature
    policy: CueingPolicy
    context: Context
    t0_s: float | None = None
    mask_dead: bool = False
    miss_rates: MissRates | None = None
    degradation: float | Callable[[int], float] = 0.0
    site_settings: SiteEstimateSettings | None = None
    site: SiteEstimate | None = None
    grounding: Grounding | None = None
    ego_noise: EgoNoiseSettings | None = None

    def signature(self) -> Signature:
        """Return the model as it is at the start of the recording; one that learns its site learns anew."""
        if self.site_settings is None or not isinstance(self.model, EnsembleModel):
            return self.model
        return SiteSignature(self.model, self.site_settings, estimate=self.site)


@dataclass(frozen=True, slots=True)
class Step:
    """One hop: what was heard, what was measured, what is believed."""

    frame: AcousticFrame
    measurement: Measurement
    state: WorldState


def open_source(
    path: Path | str,
    *,
    array: Path | str | MicrophoneArray | None = None,
    detections: Path | str | DetectionLog | None = None,
    model: Path | str | None = None,
    alpha: float | None = 0.02,
    context: Context | None = None,
    mask_dead: bool = False,
    miss_rates: Path | str | MissRates | None = None,
    site_adaptation: bool = True,
    forgetting_s: float | None = None,
    site: SiteEstimate | None = None,
    grounding: Grounding | None = None,
    ego_noise: bool | EgoNoiseSettings = False,
) -> Source:
    """Find everything that belongs to a sound file or to a recording folder.

    Parameters
    ----------
    path : path
        Multichannel sound file, or a recording folder in the OVAD layout.
    array : path or MicrophoneArray, optional
        Acoular XML; that of the data set where not given, OVAD's where it names none.
    detections : path or DetectionLog, optional
        Camera detections per frame; those of the recording folder where not given.
    model : path, optional
        Model file; the one that ships where not given.
    alpha : float or None
        False-positive budget that the threshold was set for; the model file says which it holds. None takes
        the first one, for those who only measure.
    context : Context, optional
        Rates, occluders and ego motion; defaults where not given.
    mask_dead : bool
        Listen without silent channels, as long as half of them are left, instead of refusing them.
    miss_rates : path or MissRates, optional
        What `worldstate measure-absence` wrote. Where it holds the camera's scale of health and the recording
        folder has a video, the degradation is read from that.
    site_adaptation : bool
        Learn what the site is like while listening, where the model compares windows with their site.
    forgetting_s : float, optional
        Time constant of that, seconds; see `SiteEstimateSettings`.
    site : SiteEstimate, optional
        What is known of the site beforehand, from a checkpoint.
    grounding : Grounding, optional
        Weighs the model's scores with bearing, approach and engine line, eq. (5); off where not given.
    ego_noise : bool or EgoNoiseSettings
        Learn the own vehicle's noise while the filter believes that nothing is there, and hear past it:
        spatial spectrum, bearing and prominence. The signature hears what it was trained with.

    Raises
    ------
    InputFileError
        If a file is missing or damaged; the message names it.
    InvalidArgumentError
        If the model holds no threshold for `alpha` or the time constant is not positive.
    """
    path = Path(path)
    recording = Recording.open(path) if path.is_dir() else None
    signature, policies = load_model(model)
    rates = load_miss_rates(miss_rates) if isinstance(miss_rates, Path | str) else miss_rates
    found = detections if detections is not None else recording and recording.detections_path
    return Source(
        audio_path=recording.audio_path if recording else path,
        array=choose_array(path, _array(array), name=array),
        detections=found if found is None or isinstance(found, DetectionLog) else read_detections(found),
        model=signature,
        policy=policies.policies[0] if alpha is None else policies.for_alpha(alpha),
        context=context or Context(),
        t0_s=recording.t0_s if recording and recording.label != "none" else None,
        mask_dead=mask_dead,
        miss_rates=rates,
        degradation=_degradation(recording, rates),
        site_settings=_site_settings(forgetting_s) if site_adaptation else None,
        site=site,
        grounding=grounding,
        ego_noise=(EgoNoiseSettings() if ego_noise else None) if isinstance(ego_noise, bool) else ego_noise,
    )


def _site_settings(forgetting_s: float | None) -> SiteEstimateSettings:
    return SiteEstimateSettings() if forgetting_s is None else SiteEstimateSettings(forgetting_s=forgetting_s)


def _degradation(recording: Recording | None, rates: MissRates | None) -> float | Callable[[int], float]:
    """Return d as the recording's own video shows it, 0 where there is none to look at."""
    if recording is None or rates is None or rates.health is None:
        return 0.0
    path = recording.path / VIDEO_NAME
    return video_degradation(open_video(path), rates) if path.is_file() else 0.0


def _array(array: Path | str | MicrophoneArray | None) -> MicrophoneArray | None:
    if array is None or isinstance(array, MicrophoneArray):
        return array
    return read_array_xml(array)


def listen(path: Path | str, **options: object) -> Iterator[WorldState]:
    """Yield one world-state a hop (0.1 s) from a sound file or recording folder.

    Takes the options of `open_source`.

    Examples
    --------
    >>> for state in listen("some.wav", array="mics.xml", detections="d.json"):  # doctest: +SKIP
    ...     print(state.stamp_ns, state.risk)
    """
    for step in listen_steps(open_source(path, **options)):  # type: ignore[arg-type]
        yield step.state


def listen_steps(source: Source) -> Iterator[Step]:
    """Yield every hop of `source` with what was heard and measured.

    Raises
    ------
    InputFileError
        If the sound file is damaged or does not fit the array.
    """
    world = WorldFilter(context=source.context, policy=source.policy)
    measured = measure_steps(source, lambda: world.explanation.none)
    for frame, measurement in measured:
        world = world.predict_to(measurement.stamp_ns).update(measurement)
        yield Step(frame, measurement, world.state)


def measure_steps(
    source: Source, none_probability: Callable[[], float] | None = None
) -> Iterator[tuple[AcousticFrame, Measurement]]:
    """Yield every hop of `source` as it was heard and measured, nothing filtered: what calibration needs.

    Parameters
    ----------
    source : Source
        What to listen to.
    none_probability : callable, optional
        Asked after every hop for the belief that nothing is there, which gates the learning of ego-noise;
        without it none is learned.

    Raises
    ------
    InputFileError
        If the sound file is damaged or does not fit the array.
    """
    strict, n_microphones = not source.mask_dead, source.array.n_microphones
    with open_audio(source.audio_path, expect_channels=n_microphones, strict=strict) as audio:
        sight = unoccluded_sector(source.context)
        rates = source.miss_rates
        vision = VisionQuery(
            PinholeCamera(),
            source.detections,
            rates.table if rates is not None else None,
            source.degradation,
            line_of_sight=sight,
            clutter=rates.clutter_rate if rates is not None else None,
        )
        adapter = AcousticAdapter(
            source.array,
            audio.sample_rate_hz,
            source.signature(),
            vision=vision,
            grounding=source.grounding,
            front_end_settings=FrontEndSettings(ego_noise=source.ego_noise),
        )
        for block in audio.blocks(max(int(audio.sample_rate_hz / BLOCKS_PER_SECOND), 1)):
            for frame in adapter.front_end.process(block):
                yield frame, adapter.interpret(frame)
                if none_probability is not None:
                    adapter.set_no_source_probability(none_probability())


def unoccluded_sector(context: Context) -> Sector:
    """Return the directions that no occluder of the context hides.

    Examples
    --------
    >>> sector = unoccluded_sector(Context())
    >>> bool(sector.touches(0.5)), bool(sector.touches(0.7))
    (True, False)
    """
    edges = [occluder.edge_azimuth_rad for occluder in context.occluders]
    left = min((edge for edge in edges if edge > 0), default=math.pi / 2)
    right = max((edge for edge in edges if edge < 0), default=-math.pi / 2)
    return Sector.between(right, left)
