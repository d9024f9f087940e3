"""A model for your array and your budget, trained with streets that are simulated for it."""

from pathlib import Path

from worldstate import MicrophoneArray
from worldstate.commissioning.commission import commission, exam_of
from worldstate.commissioning.heard_stream import CommissionSettings, quick_settings
from worldstate.commissioning.stream_exam import exam_figures, write_exam_figure

array = MicrophoneArray([(x, y, 0.0) for x in (0.1, -0.1) for y in (0.1, -0.1)])
settings = quick_settings(CommissionSettings(onsets_per_hour=20.0))
model = commission(array, settings, Path("out/tutorials/streams"))  # finished parts are kept there
examined = exam_of(array, model, settings, Path("out/tutorials/streams"))
print(f"fit for use: {model.provenance.fit_for_use}")
for name in ("auroc_last_second", "approaches", "detected", "onsets_high"):
    print(f"{name}: {exam_figures(examined)[name]:.2f}")

# The figure: the exam at a junction that the model did not learn.
write_exam_figure(examined, Path("out/tutorials/04_commission.svg"))
