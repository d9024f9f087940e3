"""The evidence of one hop for a sequence model, and whether the model may be used at all."""

import logging
from dataclasses import replace

import numpy as np

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.abduction.sequence.sequence_inputs import SIDES, HopEvidence
from worldstate.abduction.sequence.sequence_model import SequenceModel
from worldstate.abduction.sequence.sequence_reader import SequenceReader, SequenceReading
from worldstate.abduction.sequence.street_sides import SidePatterns, StreetHearing, StreetListener
from worldstate.abduction.signature.model_domain import ModelDomain
from worldstate.adapters.files.acoustic_domain import UNFIT, heard_with
from worldstate.adapters.files.model_file import Model
from worldstate.frontend.frame import AcousticFrame
from worldstate.ground.values import NotUsable
from worldstate.state import WorldState

# Loudness is the mean of these bands: of others it would not be what a sequence was trained on.
LEVEL_BAND_HZ = (50.0, 2700.0)

_LOG = logging.getLogger(__name__)


def sequence_of(model: Model, moving_ego: bool, uncalibrated: bool) -> SequenceModel | NotUsable:
    """Return the sequence model of a file where it was made for what is heard, else why it is not used."""
    if model.sequence is None:
        return NotUsable("the model states no times: `worldstate model make` makes one that does")
    if uncalibrated:
        return NotUsable("uncalibrated: times are stated of the array that the model was made for")
    if not model.provenance.fit_for_use:
        return NotUsable(UNFIT)
    if model.domain is None:
        return NotUsable("the model names no array that it was made for")
    motion = "moving" if moving_ego else "standing"
    if model.domain.ego_motion not in (motion, "any"):
        return NotUsable(f"the model was made for a {model.domain.ego_motion} ego, this one is {motion}")
    return model.sequence


def street_listener(
    domain: ModelDomain | None, known: SidePatterns | None, before: StreetHearing | None
) -> StreetListener | None:
    """Return what learns a street while it is heard: from what was heard before, else from what is known.

    What another array heard is left out, and a warning says so.
    """
    if domain is None:
        return None
    heard_by = heard_with(domain)
    given = known if before is None else before.known
    if given is not None and given.heard_by not in ("", heard_by):
        _LOG.warning("the street's sides were heard by another array (%s) and are left out", given.heard_by)
        before = known = None
    return StreetListener(before or StreetHearing(replace(known or SidePatterns(), heard_by=heard_by)))


def learn_passes(street: StreetListener | None, state: WorldState) -> None:
    """Tell a street who has just come into view out of which of its arms."""
    if street is None:
        return
    arms = {one.id: one.direction for one in state.entities}
    came = {arms.get(event.entity_id) for event in state.events if event.kind == "handed_over"}
    for arm in SIDES:
        if arm in came:
            street.passed(arm)


def read_hop(
    reader: SequenceReader, signature: SignatureEvidence, frame: AcousticFrame
) -> SequenceReading | NotUsable:
    """Return what a sequence says after one more hop, from what its window model and the front-end say."""
    sides = signature.sides
    if sides is None:
        return NotUsable("the model says nothing of single sides")
    looming = frame.looming
    rate_hz = std_hz = np.nan
    if not isinstance(looming, NotUsable):
        rate_hz, std_hz = looming.inverse_tta_hz, looming.std_hz
    evidence = HopEvidence.heard(
        np.array([sides.log_ratios]),
        np.array([sides.visible]),
        feature=frame.feature[None],
        band_log_energy=frame.band_log_energy[None],
        prominence=np.array([frame.prominence]),
        looming_hz=np.array([rate_hz]),
        looming_std_hz=np.array([std_hz]),
        bearing_rad=np.array([frame.bearing_rad]),
    )
    return reader.read(evidence, frame.feature)
