"""The benchmark prints what it promises; how fast is for people to read, not for tests to assert."""

import json

from worldstate.cli.main import main


def test_keys_and_consistency(capsys):
    assert main(["bench", "--rounds", "1", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["threads"] == 1
    assert report["blas"]
    parts = sum(report["stages"][name]["median_ms"] for name in report["stages"] if name in STAGES)
    assert 0.0 < parts < 3.0 * report["total_ms"]
    for name in ("published_chain", "pyroomacoustics_srp"):
        assert report["ratios"][name] > 0.0
        assert report["peers"][name] > 0.0


STAGES = ("stft", "phat", "srp181_new_frames", "srp181_running_second", "feature")
