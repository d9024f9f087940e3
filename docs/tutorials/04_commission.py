"""A model for an array and an alarm budget of your own, learned from streets that are simulated for it."""

from dataclasses import replace
from pathlib import Path

from tutorial_options import tutorial_options

from worldstate import MicrophoneArray
from worldstate.adapters import save_model
from worldstate.commissioning.commission import commission, exam_of
from worldstate.commissioning.heard_stream import CommissionSettings, quick_settings
from worldstate.commissioning.stream_exam import exam_figures, write_exam_figure

CORNERS = [(x, y, 0.0) for x in (0.1, -0.1) for y in (0.1, -0.1)]
# The whole plan for 4 microphones is: worldstate model make --array mics.csv --out my_model.json --onsets 20
BUDGET = CommissionSettings(onsets_per_hour=20.0)


def main(out: Path, size: str = "full") -> None:
    """Learn from minutes of sound: every step is there, and the model is unfit for use."""
    array, settings = MicrophoneArray(CORNERS), quick_settings(BUDGET)
    if size == "small":
        settings = replace(settings, approach_minutes=0.9, exam_minutes=1.6)
    streams = out / ("streams_small" if size == "small" else "streams")  # what was heard once is kept here
    model = commission(array, settings, streams)
    save_model(out / "my_model.json", model)
    examined = exam_of(array, model, settings, streams)
    write_exam_figure(examined, out / "04_commission.png")
    told = exam_figures(examined)
    alarm = None if model.sequence is None else model.sequence.alarm
    print(f"fit for use: {model.provenance.fit_for_use}; alarm from {alarm}")
    for name in ("approaches", "detected", "auroc_last_second", "hazard_free_hours", "onsets_high"):
        print(f"  {name}: {told[name]}")


if __name__ == "__main__":
    main(*tutorial_options(__doc__))
