"""Bounds from the microphone positions: moment, aperture, alias frequency and bearing bound."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.bounds import cramer_rao

# Sample rate of a one-second tone; the bound depends only on the duration and on SNR times number of samples.
TONE_RATE_HZ = 48_000.0


@dataclass(frozen=True, slots=True)
class ArrayBounds:
    """Limits of one array at one frequency.

    Parameters
    ----------
    microphones : int
        Number of microphones M.
    horizontal_moment_m2 : float
        S_xx of eq. (4).
    aperture_m : tuple of float
        Extent along x, y and z, metres.
    mean_spacing_m, alias_hz : float
        Mean distance d to the nearest neighbour, and the alias frequency c / (2 d).
    ambiguity : str
        Azimuths that the array cannot distinguish: see `MicrophoneArray.ambiguity`.
    broadside_deg : float
        Azimuth with the smallest bearing bound, degrees.
    frequency_hz : float
        Frequency of the bounds.
    sigma_deg : dict of float to (float or None)
        By azimuth in degrees: smallest standard deviation of a bearing times sqrt(2 N SNR), degrees; None if
        the array cannot estimate the azimuth.

    Examples
    --------
    >>> two = array_bounds(MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]]), 500.0, [0.0, 90.0])
    >>> round(two.alias_hz, 1), two.sigma_deg[0.0].__round__(1), two.sigma_deg[90.0]
    (857.5, 44.2, None)
    """

    microphones: int
    horizontal_moment_m2: float
    aperture_m: tuple[float, float, float]
    mean_spacing_m: float
    alias_hz: float
    ambiguity: str
    broadside_deg: float
    frequency_hz: float
    sigma_deg: dict[float, float | None]

    def at(self, azimuth_deg: float, snr_db: float, snapshots: int) -> float | None:
        """Return the smallest standard deviation of a bearing, degrees; None if there is no bound.

        Parameters
        ----------
        azimuth_deg : float
            One of the azimuths of `sigma_deg`.
        snr_db : float
            SNR per microphone and snapshot, dB.
        snapshots : int
            Number of snapshots N.

        Returns
        -------
        float or None
            The standard deviation in degrees.

        Examples
        --------
        >>> two = array_bounds(MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]]), 500.0, [0.0])
        >>> round(two.at(0.0, snr_db=10.0, snapshots=20), 2)
        2.21
        """
        constant = self.sigma_deg[azimuth_deg]
        snr = 10.0 ** (snr_db / 10.0)
        return None if constant is None else constant / float(np.sqrt(2.0 * snapshots * snr))

    def radial_speed_std_m_s(self, snr_db: float) -> float:
        """Return the bound of a radial speed from one second of a tone, with one microphone.

        Parameters
        ----------
        snr_db : float
            SNR of the tone's samples, dB.

        Returns
        -------
        float
            A standard deviation, m/s, for a known frequency at rest.

        Examples
        --------
        >>> two = array_bounds(MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]]), 500.0, [0.0])
        >>> round(two.radial_speed_std_m_s(10.0), 5)
        0.00055
        """
        variance = cramer_rao.tone_crb_hz2(10.0 ** (snr_db / 10.0), int(TONE_RATE_HZ), TONE_RATE_HZ)
        return float(np.sqrt(cramer_rao.radial_speed_crb_m2_s2(variance, self.frequency_hz)))

    def to_dict(self) -> dict[str, object]:
        """Return the fields as values for JSON, with azimuths as text.

        Examples
        --------
        >>> array_bounds(MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]]), 500.0, [90.0]).to_dict()["sigma_deg"]
        {'90': None}
        """
        constants = {f"{azimuth:g}": sigma for azimuth, sigma in self.sigma_deg.items()}
        return asdict(self) | {"aperture_m": list(self.aperture_m), "sigma_deg": constants}


def array_bounds(array: MicrophoneArray, frequency_hz: float, azimuths_deg: Sequence[float]) -> ArrayBounds:
    """Compute the bounds of an array at a frequency.

    Parameters
    ----------
    array : MicrophoneArray
        Microphones.
    frequency_hz : float
        Frequency of a far-field source.
    azimuths_deg : sequence of float
        Azimuths of the source, left positive, degrees.

    Returns
    -------
    ArrayBounds
        The bounds for elevation zero.

    Raises
    ------
    InvalidArgumentError
        If the frequency is negative, a number is not finite, or the array has no horizontal extent.

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import roof_array_56
    >>> limits = array_bounds(roof_array_56(), 1000.0, [0.0])
    >>> round(limits.horizontal_moment_m2, 2), round(limits.sigma_deg[0.0], 1), round(limits.alias_hz, -2)
    (3.03, 1.8, 1900.0)
    """
    x, y, z = array.aperture_m.tolist()
    return ArrayBounds(
        microphones=array.n_microphones,
        horizontal_moment_m2=array.horizontal_moment_m2,
        aperture_m=(x, y, z),
        mean_spacing_m=array.mean_spacing_m,
        alias_hz=array.alias_hz(),
        ambiguity=array.ambiguity,
        broadside_deg=float(np.degrees(cramer_rao.broadside_rad(array.positions_m))),
        frequency_hz=frequency_hz,
        sigma_deg={azimuth: _constant_deg(array, frequency_hz, azimuth) for azimuth in azimuths_deg},
    )


def _constant_deg(array: MicrophoneArray, frequency_hz: float, azimuth_deg: float) -> float | None:
    """Return the bound for 2 N SNR = 1; None above a million degrees, a division by zero."""
    variance = cramer_rao.bearing_crb_rad2(array.positions_m, np.radians(azimuth_deg), frequency_hz, 0.5, 1)
    sigma = float(np.degrees(np.sqrt(variance)))
    return sigma if sigma < 1e6 else None
