"""`worldstate demo`: simulate one hidden vehicle, process its sound and draw the result.

A delivery van approaches a blind junction. The command simulates the sound, runs the library on it and prints
how early the van was announced. It writes states.jsonl, the page log.html for a browser, summary.json
and, if matplotlib is installed, the figure timeline.png to the output folder.

example: worldstate demo --out out/demo --seed 7
"""

import argparse
from dataclasses import replace
from pathlib import Path

from worldstate import adapters, simulation
from worldstate.cli.common import inputs, output, progress
from worldstate.ground.extras import has_extra

# Louder than a car, so that the first result of a newcomer is a clear case.
VAN_OVER_CAR_DB = 6.0


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("--out", type=Path, default=Path("out/demo"), help="output folder (default: %(default)s)")
    add("--seed", type=int, default=1, help="number that determines the recording (default: 1)")
    inputs.add_budget_options(parser)


def simulate_approach(root: Path, seed: int) -> Path:
    """Write a recording of one van, with a site and a side drawn with `seed`; return its folder."""
    import numpy as np

    from worldstate.simulation.dataset.dataset import write_log

    rng = np.random.default_rng(seed)
    # An easy approach: 20 to 29 km/h, without braking.
    site, side = str(rng.choice(simulation.SITES)), str(rng.choice(("left", "right")))
    drawn = simulation.draw_settings(site, side, rng)
    louder = replace(drawn.preset, vehicle_level_db=drawn.preset.vehicle_level_db + VAN_OVER_CAR_DB)
    settings = replace(drawn, speed_mps=rng.uniform(5.5, 8.0), braking_mps2=0.0, preset=louder)
    root.mkdir(parents=True, exist_ok=True)
    with progress.progress_bar(f"simulating {settings.duration_s:g} s at {settings.site.name}", None):
        row = simulation.write_recording(root, simulation.simulate_recording(settings, rng))
    write_log(root, [row])
    return root / row.folder


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.adapters.datasets.ovad import read_true_tracks
    from worldstate.adapters.state_log import read_log
    from worldstate.operations.recordings.recording_report import announcement
    from worldstate.operations.viewing.log_page import page_data, write_log_page
    from worldstate.operations.viewing.state_figure import drawn_run

    out = output.output_folder(arguments.out, "timeline.png", "states.jsonl", "log.html", "summary.json")
    folder = simulate_approach(out / "recording", arguments.seed)
    source = adapters.open_source(folder, budget=arguments.budget, alpha=arguments.alpha)
    title = f"{folder.parent.parent.name}, vehicle from the {folder.parent.name}"
    figure = out / "timeline.png" if has_extra("matplotlib") else None
    with drawn_run(figure, source, title) as draw:
        report = progress.listen_with_progress(source, states_path=out / "states.jsonl", on_hop=draw)
    states = [state for _, state in read_log(out / "states.jsonl")]
    truth = read_true_tracks(folder)
    write_log_page(out / "log.html", page_data(states, title=title, t0_s=source.t0_s, truth=truth))
    output.write_report(out / "summary.json", report.to_dict())
    told = announcement(states, truth, "a van")
    return output.CommandResult(report.to_dict(), lines=["", f"see {figure or out / 'log.html'}", told])
