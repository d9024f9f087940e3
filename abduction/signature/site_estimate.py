r"""Estimate of a site's reference during operation: an unlabelled running mean with a forgetting time.

Most of a stream has no vehicle, unlike the training windows. The mean of a stream is therefore lower than the
references of the training sites and would make every window look like a hazard. Instead, the estimate uses
the difference between this mean and the mean empty window of the training sites,

.. math:: d = \bar x - x_{empty}, \qquad
          r = r_{home} + w \big( \tfrac{1}{4} \langle d \rangle + d - \langle d \rangle \big),

which separates the mean over directions, the level, from the pattern. An approaching vehicle is less audible
in a louder street, so its level rises by less than the street's. Therefore, the reference receives a quarter
of the level and all of the pattern. On streams from real windows, 95 % of them hazard-free, all of the level
costs a tenth of the detections at unknown junctions with a standing ego. A quarter costs none and is
sufficient for a moving ego.

The model sets the duration after which the stream has more weight than the training sites: the variance of
empty windows at one site divided by that between sites. This duration is one second for a moving ego, whose
sites differ much, and four seconds for a standing one.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.abduction.sequence.sequence_inputs import HOP_S
from worldstate.ground import FloatArray, InvalidArgumentError, finite_array, in_range, mean
from worldstate.ground.serialisation import Check

from .ensemble import KINDS, EnsembleModel, log_levels
from .window_classes import window_evidence

# Share of the level difference that enters the reference; the pattern enters completely.
_LEVEL_GAIN = 0.25


@dataclass(frozen=True, slots=True)
class SiteEstimateSettings:
    """Forgetting time of the site estimate.

    Parameters
    ----------
    forgetting_s : float
        Time constant of the running mean, seconds.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    Examples
    --------
    >>> SiteEstimateSettings().forgetting_s
    300.0
    """

    forgetting_s: float = 300.0

    def __post_init__(self) -> None:
        in_range("forgetting_s", self.forgetting_s, 0.0, math.inf, open_low=True)


@dataclass(frozen=True, slots=True, eq=False)
class SiteEstimate:
    """Running mean of log-levels and its effective duration.

    Parameters
    ----------
    level : ndarray, shape (features,)
        Mean of the natural logarithm of the levels.
    heard_s : float
        Duration without the forgotten part, seconds; at most the forgetting time plus one hop.

    Examples
    --------
    >>> estimate = SiteEstimate.start(2).updated([1.0, np.e], 0.1, SiteEstimateSettings())
    >>> estimate.level, estimate.heard_s
    (array([0., 1.]), 0.1)
    """

    level: FloatArray
    heard_s: Annotated[float, Check("a time that is not negative", lambda heard_s: heard_s >= 0.0)] = 0.0

    @classmethod
    def start(cls, n_features: int) -> "SiteEstimate":
        """Return the estimate before the first window.

        Parameters
        ----------
        n_features : int
            Number of features of a window.
        """
        return cls(np.zeros(n_features))

    def updated(self, feature: ArrayLike, dt_s: float, settings: SiteEstimateSettings) -> "SiteEstimate":
        r"""Return the estimate after a window that follows `dt_s` seconds after the last one.

        .. math:: h \leftarrow h\, e^{-\Delta t / \tau} + \Delta t, \qquad
                  m \leftarrow m + \frac{\Delta t}{h}\, (\ln X - m)

        Parameters
        ----------
        feature : array_like, shape (features,)
            Levels, not logarithms; they are not checked here but in `SiteSignature`.
        dt_s : float
            Seconds, > 0.
        settings : SiteEstimateSettings
            Forgetting time.
        """
        levels = log_levels(feature)
        heard_s = self.heard_s * math.exp(-dt_s / settings.forgetting_s) + dt_s
        return SiteEstimate(self.level + dt_s / heard_s * (levels - self.level), heard_s)

    def reference(self, model: EnsembleModel) -> FloatArray:
        r"""Return the reference of the site; before the first window, that of the training sites.

        .. math:: r = r_{home} + \frac{h}{h + h_0} \big( \tfrac{1}{4} \langle d \rangle
                  + d - \langle d \rangle \big), \qquad d = m - x_{empty}

        Parameters
        ----------
        model : EnsembleModel
            The model with the training sites.

        Raises
        ------
        InvalidArgumentError
            If the model has another number of features.

        References
        ----------
        Derived here: see the module `worldstate.abduction.signature.site_estimate`; gains by experiment. The
        weight is that of C. Morris, "Parametric empirical Bayes inference", J. Am. Stat. Assoc. 78, 1983.
        """
        return self.beside(model.home, model.empty, model.prior_s)

    def beside(self, home: FloatArray, empty: FloatArray, prior_s: float) -> FloatArray:
        """Return the result of `reference` for training sites that have no model yet.

        Shapes: home (3 * features,), empty (features,).
        """
        if self.level.shape != empty.shape:
            raise InvalidArgumentError(f"model: expected {self.level.size} features, got {empty.size}")
        if not self.heard_s:
            return home
        difference = self.level - empty
        level = mean(difference)
        offset = _LEVEL_GAIN * level + (difference - level)
        moved = self.heard_s / (self.heard_s + prior_s) * offset
        return np.asarray(home + np.concatenate([moved] * len(KINDS)))


class SiteSignature:
    """Signature model that compares each window with the previous ones of its site.

    Parameters
    ----------
    model : EnsembleModel
        Model that classifies the windows.
    settings : SiteEstimateSettings, optional
        Forgetting time.
    estimate : SiteEstimate, optional
        Estimate from a checkpoint; a new one by default.

    Raises
    ------
    InvalidArgumentError
        If the estimate has another number of features.

    Attributes
    ----------
    estimate : SiteEstimate
        The whole state; `Checkpoint` writes it to disk.
    domain, reference_prior
        Attributes of the model.

    Examples
    --------
    >>> from worldstate.abduction.signature.ensemble import Expert
    >>> expert = Expert("mean", np.zeros(6), np.ones(6), np.zeros((4, 6)), np.zeros(4))
    >>> model = EnsembleModel((expert,), np.full(4, 0.25), np.zeros(18), np.zeros(6))
    >>> signature = SiteSignature(model)
    >>> signature.evidence(np.ones(6)).none, signature.estimate.heard_s
    (0.0, 0.1)
    """

    def __init__(
        self,
        model: EnsembleModel,
        settings: SiteEstimateSettings | None = None,
        *,
        estimate: SiteEstimate | None = None,
    ) -> None:
        self._model, self.domain, self.reference_prior = model, model.domain, model.reference_prior
        self._settings = settings or SiteEstimateSettings()
        self.estimate = estimate or SiteEstimate.start(model.n_features)
        finite_array("estimate", self.estimate.level, (model.n_features,))

    def evidence(self, feature: ArrayLike) -> SignatureEvidence:
        """Return the log-likelihoods of the next window, then learn from it.

        Raises
        ------
        InvalidArgumentError
            On another shape, NaN or infinity; the estimate then remains unchanged.
        """
        window = finite_array("feature", feature, (self._model.n_features,))
        reference = self.estimate.reference(self._model)
        self.estimate = self.estimate.updated(window, HOP_S, self._settings)
        posteriors = self._model.posteriors(log_levels(window)[None], reference[None])
        return window_evidence(posteriors, self._model.classes, self._model.class_prior)
