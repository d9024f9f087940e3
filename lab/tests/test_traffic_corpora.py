"""Readers of roadside corpora, on small folders in their published layouts."""

import re
from itertools import product
from zlib import crc32

import numpy as np
import pytest
import soundfile
from worldstate_lab.signatures.traffic_clips import (
    BACKGROUND,
    CLIP_S,
    CLIPS_A_FILE,
    KINDS,
    VEHICLES,
    idmt_traffic,
    melaudis,
    read_clip,
)

from worldstate.ground.errors import InputFileError

CAR = "2019-10-22-08-40_Fraunhofer-IDMT_30Kmh_1272258_M_D_CR"
EMPTY = "2019-11-19-13-10_Langewiesener-Strasse_unknownKmh_10077440"
IDMT_NAMES = [f"{CAR}_ME_CH12", f"{CAR}_SE_CH34", f"{EMPTY}_SE_CH34-BG", f"{EMPTY}_ME_CH12-BG"]
PASSAGE = "2024-02-09_13-62-1.8-Fitzroy1_FF_1V-{}_L1_2Lanes_LR_stereo"


def write_sound(path, seconds=CLIP_S, rate_hz=8000):
    """Write noise that is louder if a vehicle passes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(crc32(path.name.encode()))
    most = 0.1 if "BG" in path.parent.name + path.name else 0.3
    soundfile.write(path, rng.uniform(-most, most, (round(seconds * rate_hz), 2)), rate_hz)


def write_idmt(root, names=IDMT_NAMES, test=IDMT_NAMES[2:], rate_hz=8000):
    (root / "annotation").mkdir(parents=True)
    lists = {"idmt_traffic_all": names, "eusipco_2021_test": test}
    lists["eusipco_2021_train"] = [name for name in names if name not in test]
    for name, lines in lists.items():
        (root / "annotation" / f"{name}.txt").write_text("".join(f"{line}.wav\n" for line in lines))
    for name in names:
        write_sound(root / "audio" / f"{name}.wav", rate_hz=rate_hz)
    return root


def write_melaudis(root):
    for token in KINDS:
        write_sound(root / "MELAUDIS_Vehicles" / "Final_Veh" / "Fit1" / f"{PASSAGE.format(token)}.wav")
    write_sound(root / "MELAUDIS_BG" / "night.wav", seconds=61.0)
    write_sound(root / "MELAUDIS_BG" / "2024-02-09_15-1-2.0-Fitzroy1_2L.wav", seconds=1.4)
    return root


def test_idmt_clips_have_the_labels_of_their_names(tmp_path):
    clips = idmt_traffic(write_idmt(tmp_path))
    labels = [clip.labels for clip in clips]
    assert [one.kind for one in labels] == ["car", "car", BACKGROUND, BACKGROUND]
    assert [one.microphone for one in labels] == ["mems", "studio", "studio", "mems"]
    assert [one.split for one in labels] == ["train", "train", "test", "test"]
    assert [one.site for one in labels[::2]] == ["Fraunhofer-IDMT", "Langewiesener-Strasse"]
    # Both microphones recorded one passage: a fold that separated them would test on training data.
    assert labels[0].recording == labels[1].recording != labels[2].recording == labels[3].recording
    samples, rate_hz = read_clip(clips[0])
    assert samples.shape == (16_000, 2)
    assert rate_hz == 8000.0


def test_every_name_of_the_documented_form_is_read(tmp_path):
    sites, limits = ("Schleusinger-Allee", "Hohenwarte", "Fraunhofer-IDMT"), ("30", "70", "unknown")
    form = "2019-11-12-15-30_{}_{}Kmh_650690_A_W_{}{}_ME_CH12".format
    wanted = {form(*one): one for one in product(sites, limits, VEHICLES, "LR")}
    clips = idmt_traffic(write_idmt(tmp_path, list(wanted), list(wanted)[:9]))
    assert len(clips) == len(wanted)
    for clip in clips:
        site, limit, vehicle, _ = wanted[clip.path.stem]
        assert (clip.labels.kind, clip.labels.site) == (VEHICLES[vehicle], site)
        assert clip.labels.recording.endswith(limit)


@pytest.mark.parametrize(
    ("write", "read", "lost"),
    [
        (write_idmt, idmt_traffic, "annotation/eusipco_2021_test.txt"),
        (write_idmt, idmt_traffic, "annotation/idmt_traffic_all.txt"),
        (write_idmt, idmt_traffic, f"audio/{IDMT_NAMES[1]}.wav"),
        (write_melaudis, melaudis, "MELAUDIS_Vehicles"),
        (write_melaudis, melaudis, "MELAUDIS_BG"),
    ],
)
def test_a_partial_folder_is_rejected_with_the_missing_files(tmp_path, write, read, lost):
    (write(tmp_path / "corpus") / lost).rename(tmp_path / "elsewhere")
    with pytest.raises(InputFileError, match=f"missing: {re.escape(lost)}"):
        read(tmp_path / "corpus")


@pytest.mark.parametrize("name", ["car_01", f"{CAR}_SE_CH34-BG", EMPTY + "_SE_CH34", "../../etc/passwd"])
def test_a_name_without_a_valid_label_is_rejected(tmp_path, name):
    (write_idmt(tmp_path) / "annotation" / "idmt_traffic_all.txt").write_text(f"{name}.wav\n")
    if "/" not in name:
        write_sound(tmp_path / "audio" / f"{name}.wav")
    with pytest.raises(InputFileError, match=re.escape(name)):
        idmt_traffic(tmp_path)


def test_melaudis_keeps_one_vehicle_in_free_flow_and_no_vehicle(tmp_path):
    folder = write_melaudis(tmp_path) / "MELAUDIS_Vehicles"
    others = ["FF_2V-TruckCar_LR", "TJN_1V-Car_Idling", "FF_NoV_LR"]
    for other in others:
        write_sound(folder / f"2023-08-04_10-0-0.4-Swanston6_{other}_mono.wav")
    clips = [clip for clip in melaudis(tmp_path) if clip.path.is_relative_to(folder)]
    assert sorted(clip.labels.kind for clip in clips) == sorted([*KINDS.values(), BACKGROUND])
    assert {clip.labels.recording for clip in clips} == {"2024-02-09_Fitzroy1", "2023-08-04_Swanston6"}


def test_melaudis_background_is_cut_into_clips_within_the_file(tmp_path):
    clips = [clip for clip in melaudis(write_melaudis(tmp_path)) if "MELAUDIS_BG" in clip.path.parts]
    night = [clip for clip in clips if clip.path.name == "night.wav"]
    assert len(night) == CLIPS_A_FILE
    assert {len(read_clip(clip)[0]) for clip in night} == {16_000}
    starts = np.array([clip.start_s for clip in night])
    assert np.diff(starts).min() >= CLIP_S, "clips of one recording do not overlap"
    (short,) = set(clips) - set(night)
    assert len(read_clip(short)[0]) == 11_200
    passage = next(clip for clip in melaudis(tmp_path) if clip.labels.kind == "car")
    assert short.labels.recording == passage.labels.recording, "the same day at the same spot"
    assert len({clip.labels.recording for clip in night}) == 1


def test_names_of_another_release_are_rejected_and_not_partly_used(tmp_path):
    write_melaudis(tmp_path)
    write_sound(tmp_path / "MELAUDIS_Vehicles" / "car_01.wav")
    with pytest.raises(InputFileError, match=r"1 of 7 others, the first 'car_01\.wav'"):
        melaudis(tmp_path)
