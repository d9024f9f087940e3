"""An artificial folder in the layout of the real corners: vehicles come from either side and pass."""

import csv
import json

import numpy as np
import soundfile

from worldstate.adapters.camera.pinhole import PinholeCamera

SECONDS, T0_S, RATE_HZ, FPS, SIZE_PX = 4.0, 3.0, 48_000, 10.0, (1936, 1216)
JUNCTIONS = ("SA1", "SB1")
# Before line of sight, the sound comes from a wall of the side's arm, like most of it at the real corners.
WALL_RAD = np.radians(50.0)
# The microphones are 0.68 m apart; a vehicle's sound reaches the farther one with this delay in samples.
SPACING_M, SOUND_M_S = 0.68, 343.0
COLUMNS = ("id", "junction", "side", "t0_s", "seconds", "entry_exit")
PARKED = [1500.0, 800.0, 1620.0, 880.0, 0.8, "car"]


def write_corner(folder, rng, approaches=2, hazard_free=2):
    """Write recordings of 4 s with T0 at 3 s, approaches first, alternately from the left and the right.

    Every second recording is from the other junction, which has a parked car. Return the folder.
    """
    sides = [("left", "right")[i % 2] for i in range(approaches)] + ["none"] * hazard_free
    for part in ("sound", "boxes"):
        (folder / part).mkdir(parents=True)
    # Consecutive recordings are from different junctions: each has approaches and hazard-free recordings.
    rows = [(f"{i}_{side}", JUNCTIONS[i % 2], side, T0_S, SECONDS, "") for i, side in enumerate(sides)]
    with (folder / "truth.csv").open("w", newline="") as file:
        csv.writer(file).writerows([COLUMNS, *rows])
    np.savez(folder / "srp.npz", **{name: _spectra(side, rng) for name, _, side, *_ in rows})
    for name, junction, side, *_ in rows:
        soundfile.write(folder / "sound" / f"{name}.flac", _sound(side, rng), RATE_HZ)
        document = {"frames": _boxes(side, junction), "size": SIZE_PX, "fps": FPS}
        (folder / "boxes" / f"{name}.json").write_text(json.dumps(document))
    return folder


def loudness(time_s, side):
    """Return the amplitude of the vehicle relative to the street: it doubles each half second up to T0."""
    rise = 4.0 * 2.0 ** (-2.0 * np.maximum(T0_S - time_s, 0.0))
    return rise if side != "none" else np.zeros_like(time_s)


def azimuth_rad(time_s, side):
    """Return the direction of the vehicle's sound, left positive: a wall, and from T0 on the vehicle
    itself."""
    seen = PinholeCamera.ovad().azimuth(_middle_px(time_s, side))
    return np.where(time_s < T0_S, WALL_RAD if side == "left" else -WALL_RAD, seen)


def _middle_px(time_s, side):
    way = 300.0 + 900.0 * np.maximum(time_s - T0_S, 0.0)
    return way if side == "left" else SIZE_PX[0] - way


def _spectra(side, rng):
    """Return spectra every 0.1 s over 180 azimuths, which are positive to the right."""
    time_s, azimuths = np.arange(1, 40) / FPS, np.radians(np.linspace(-90.0, 90.0, 180))
    away = azimuths + azimuth_rad(time_s, side)[:, None]
    peak = 0.06 * loudness(time_s, side)[:, None] * np.exp(-0.5 * (away / 0.1) ** 2)
    return (0.17 + peak + rng.normal(0.0, 0.004, away.shape)).astype(np.float32)


def _sound(side, rng):
    n = round(SECONDS * RATE_HZ)
    time_s = np.arange(n) / RATE_HZ
    source = rng.normal(size=n) * loudness(time_s, side)
    late = round(SPACING_M * np.sin(WALL_RAD) / SOUND_M_S * RATE_HZ)
    farther = np.roll(source, late)
    pair = (source, farther) if side == "left" else (farther, source)
    return 0.02 * (np.stack(pair, axis=1) + rng.normal(size=(n, 2)))


def _boxes(side, junction):
    still = [PARKED] if junction == JUNCTIONS[1] else []
    return [[*still, *_passing(i / FPS, side)] for i in range(round(SECONDS * FPS))]


def _passing(time_s, side):
    if side == "none" or time_s < T0_S:
        return []
    middle = float(_middle_px(time_s, side))
    return [[middle - 150.0, 760.0, middle + 150.0, 960.0, 0.7, "car"]]
