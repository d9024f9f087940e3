"""Learning of a site in the running chain: option, checkpoints, forgetting."""

from dataclasses import replace

import numpy as np
import pytest

from worldstate.abduction.signature.site_estimate import SiteEstimate, SiteEstimateSettings, SiteSignature
from worldstate.adapters import Checkpoint, ListenSettings, open_source, read_model
from worldstate.ground.errors import InvalidArgumentError

MODEL, SLOPE = read_model().signature, np.tile(np.linspace(-1.0, 1.0, 30), 2)


def test_site_adaptation_has_a_switch_and_may_start_from_a_known_site(approach):
    settings = (ListenSettings(site_adaptation=flag) for flag in (True, False))
    on, off = (replace(open_source(approach.folder, settings=one), model=MODEL) for one in settings)
    first, second, published, window = on.signature(), on.signature(), object(), np.exp(MODEL.empty)
    assert isinstance(first, SiteSignature) and off.signature() is MODEL
    assert replace(on, model=published).signature() is published
    assert ListenSettings(forgetting_s=7.0).site() == SiteEstimateSettings(7.0)
    unknown = first.evidence(window)
    assert second.estimate.heard_s == 0.0, "every pass over a source starts without a site"

    def known(site):
        return replace(on, before=Checkpoint(on.world(), site)).signature()

    assert known(SiteEstimate(MODEL.empty + SLOPE, heard_s=300.0)).evidence(window) != unknown
    with pytest.raises(InvalidArgumentError, match="estimate"):
        known(SiteEstimate.start(59))
