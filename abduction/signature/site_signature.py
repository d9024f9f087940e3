"""Signature model with a running estimate of its site."""

import numpy as np
from numpy.typing import ArrayLike

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.ground.checks import finite_array, in_range

from .ensemble import EnsembleModel
from .model_domain import ModelDomain
from .site_estimate import SiteEstimate, SiteEstimateSettings
from .site_reference import log_levels

HOP_S = 0.1


class SiteSignature:
    """Compares each window with what the site was like before it; takes the place of its model.

    Parameters
    ----------
    model : EnsembleModel
        The one that is asked.
    settings : SiteEstimateSettings, optional
        Forgetting time and gains.
    hop_s : float
        Seconds between two windows.
    estimate : SiteEstimate, optional
        From a checkpoint; a fresh one unless given.

    Raises
    ------
    InvalidArgumentError
        If the estimate is of another number of features.

    Attributes
    ----------
    estimate : SiteEstimate
        All that is carried from window to window; `Checkpoint` writes it to disk.

    Examples
    --------
    >>> from worldstate.abduction.signature.expert import Expert
    >>> from worldstate.abduction.signature.site_reference import SiteReference
    >>> expert = Expert("mean", np.zeros(6), np.ones(6), np.zeros((4, 6)), np.zeros(4))
    >>> model = EnsembleModel((expert,), np.full(4, 0.25), SiteReference(*np.zeros((3, 6))), np.zeros(6))
    >>> signature = SiteSignature(model)
    >>> signature.evidence(np.ones(6)).none, signature.estimate.heard_s
    (0.0, 0.1)
    """

    def __init__(
        self,
        model: EnsembleModel,
        settings: SiteEstimateSettings | None = None,
        *,
        hop_s: float = HOP_S,
        estimate: SiteEstimate | None = None,
    ) -> None:
        self._model = model
        self._settings = settings or SiteEstimateSettings()
        self._hop_s = in_range("hop_s", hop_s, 0.0, np.inf, open_low=True, open_high=True)
        self.estimate = estimate or SiteEstimate.start(model.n_features)
        finite_array("estimate", self.estimate.level, (model.n_features,))

    @property
    def reference_prior(self) -> tuple[float, ...]:
        """That of the model."""
        return self._model.reference_prior

    @property
    def domain(self) -> ModelDomain | None:
        """What the model was made for."""
        return self._model.domain

    def evidence(self, feature: ArrayLike) -> SignatureEvidence:
        """Return the log-likelihoods of the next window, then learn from it.

        Raises
        ------
        InvalidArgumentError
            On another shape, NaN or infinity; nothing is learned then.
        """
        window = finite_array("feature", feature, (self._model.n_features,))
        reference = self.estimate.reference(self._model, self._settings)
        self.estimate = self.estimate.updated(window, self._hop_s, self._settings)
        return self._model.answer(log_levels(window)[None], reference.row[None])
