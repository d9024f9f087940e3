"""A stream that was listened to as measurements of the filter: signature, sequence, bearing, camera."""

from collections.abc import Iterator

import numpy as np

from worldstate.abduction.co_evidence import Unqueried
from worldstate.abduction.sequence.sequence_inputs import HopEvidence
from worldstate.abduction.sequence.sequence_model import SequenceModel
from worldstate.abduction.sequence.sequence_reader import LEAST_HOPS, TOO_FEW, SequenceReading
from worldstate.abduction.sequence.street_hearing import StreetListener
from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.abduction.signature.site_signature import SiteSignature
from worldstate.adapters.acoustic import asked_again
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.ground.values import NotUsable, nanoseconds
from worldstate.measurement.measurement import Approach, Bearing, CoEvidenceChannel, Measurement


def measurements(
    heard: HeardStream,
    model: EnsembleModel,
    sequence: SequenceModel,
    evidence: HopEvidence,
    vision: CoEvidenceChannel | None,
    street: StreetListener | None = None,
) -> Iterator[Measurement]:
    """Yield one measurement a hop, as the acoustic adapter makes them of the sound.

    `street` tells the sides; where whoever filters tells it who came, it learns on the way.
    """
    hops, signature, groups = heard.hops, SiteSignature(model), sequence.posterior(evidence).groups
    for i in range(len(hops)):
        if street is not None and i + 1 >= LEAST_HOPS:
            told = street.turned(groups[i], hops.feature[i])
        else:
            told = groups[i]
        reading = SequenceReading(told, sequence.share, sequence.margin_s, sequence.alarm)
        measurement = Measurement(
            stamp_ns=nanoseconds(float(hops.time_s[i])),
            signature=signature.evidence(hops.feature[i]),
            co_evidence=Unqueried("no camera"),
            bearing=_bearing(heard, i),
            approach=_approach(heard, i),
            sequence=reading if i + 1 >= LEAST_HOPS else TOO_FEW,
        )
        yield asked_again(measurement, vision)


def _bearing(heard: HeardStream, i: int) -> Bearing | NotUsable:
    hops = heard.hops
    if not np.isfinite(hops.bearing_rad[i]):
        return NotUsable("no peak above noise")
    return Bearing(float(hops.bearing_rad[i]), float(hops.bearing_std_rad[i]), float(hops.prominence[i]))


def _approach(heard: HeardStream, i: int) -> Approach | NotUsable:
    rate_hz, std_hz = float(heard.hops.looming_hz[i]), float(heard.hops.looming_std_hz[i])
    return Approach(rate_hz, std_hz) if np.isfinite(rate_hz) else NotUsable("no looming above noise")
