"""`worldstate hear`: many recordings in, tables of approaches out.

Hear every recording of a corpus and write its approaches as Parquet: time, side, lead, chance, and whether a
vehicle was seen. A second run hears only what is missing, after a kill as well, and the tables are the same
bytes for any number of processes or machines.

CORPUS is a folder of sound files, bags of ROS 2, recording folders in the OVAD layout and logs of snapshots
(JSON lines, MCAP), or a manifest: CSV with the column path, relative to its own folder, and optionally site,
detections (of the camera) and odometry. Below a folder the first folder of a path is its site.

DIR receives the folders recordings, approaches and hours, with one Parquet file a recording, named by its
content, the array, the model, the options and the version. What cannot be heard is a row of recordings with
its failure. Every file of a table can be read at once, as by pandas.read_parquet("DIR/approaches").

--cascade hears four microphones first, and all of them only around seconds whose level or coherence exceeds
the usual of the recording. One recording in twenty is heard whole, by which the recall is stated.

--shadow counts every recording of DIR as free of hazards: hours heard and unheard, onsets an hour with their
exact interval by site, day and state of the sensors, and how many more hours would show that the alarm keeps
its budget.

Examples
--------
  worldstate hear drives --array mics.csv --model mine.json --out heard --jobs 8
  worldstate hear drives.csv --array uma-8 --out heard --hops
  worldstate hear drives --array uma-8 --out heard --scheduler tcp://10.0.0.5:8786
  worldstate hear drives --array uma-8 --out heard --shard $SLURM_ARRAY_TASK_ID/64
"""

import argparse
import re
import time
from collections import Counter
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from worldstate.cli.common import inputs, listening, output, progress, sensors
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.extras import check_extra

if TYPE_CHECKING:
    from worldstate.operations.corpus.corpus_run import HeardShard

NEEDS = ("pyarrow",)
_CONNECT_S = 10.0
FIRST_OPTIONS = (
    *("--out", "--array", "--model", "--budget", "--alpha", "--uncalibrated"),
    *("--hops", "--cascade", "--shadow", "--jobs", "--scheduler", "--shard"),
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("corpus", type=Path, metavar="CORPUS", help="folder of recordings, or a manifest (CSV)")
    add("--out", type=Path, required=True, metavar="DIR", help="folder of the tables")
    inputs.add_array_options(parser)
    inputs.add_channel_option(parser)
    sensors.add_car_option(parser)
    sensors.add_lens_options(parser, parser.add_argument_group("camera"))
    # The manifest names what each recording has of these.
    parser.set_defaults(detections=[], images=None, image_rate=None, detector=None)
    inputs.add_search_options(parser)
    listening.add_listen_options(parser)
    add("--mask-dead", action="store_true", help="leave silent channels out instead of failing")
    add("--hops", action="store_true", help="write a row for each hop as well, its snapshot included")
    quick = "hear only seconds that are louder or more coherent than usual; states its recall"
    add("--cascade", action="store_true", help=quick)
    told = "count every advisory as false: onsets an hour by site and state of the sensors, DIR/shadow.html"
    add("--shadow", action="store_true", help=told)
    add("--shard", default="1/1", metavar="I/N", help="the I-th of N shares, as of a SLURM array (from 1)")
    dask = "Dask: its workers hear in place of processes, and see the same files (extra dask)"
    add("--scheduler", metavar="ADDRESS", help=dask)
    add("--jobs", type=int, default=1, metavar="N", help="processes (default: 1)")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return what it found."""
    from worldstate.operations.corpus.corpus_inputs import find_corpus, share_of
    from worldstate.operations.corpus.corpus_run import hear

    given, shard = sensors.given_sensors(arguments), _share(arguments.shard)
    parts: dict[str, Any] = listening.place_and_settings(arguments, given.setup.boxes, arguments.mask_dead)
    parts |= {"array": given.car.array, "model": given.model}
    parts |= {"camera": given.camera, "miss_rates": given.miss_rates}
    parts |= {"hops": arguments.hops, "cascade": arguments.cascade}
    begun_s, count = time.perf_counter(), len(share_of(find_corpus(arguments.corpus), *shard))
    with _executor(arguments.scheduler) as executor, progress.progress_bar("hearing", count) as bar:

        def told(found: "HeardShard") -> None:
            if found.failure is not None:
                output.say(f"not heard: {found.failure}")
            bar.advance()

        work: dict[str, Any] = {"jobs": arguments.jobs, "executor": executor, "shard": shard}
        heard = hear(arguments.corpus, arguments.out, on_recording=told, **work, **parts)
    statuses, sound_s = Counter(one.status for one in heard), sum(one.sound_s for one in heard)
    found: dict[str, Any] = {status: statuses[status] for status in ("heard", "there", "failed")}
    found |= {"sound_s": sound_s, "realtime_factor": sound_s / (time.perf_counter() - begun_s)}
    if arguments.cascade:
        found["cascade_recall"] = _recall(arguments.out)
    return _shadow(arguments.out, found) if arguments.shadow else output.CommandResult(found)


def _recall(out: Path) -> str:
    """Return the share of onsets that the cascade kept, of recordings that were heard whole as well."""
    from worldstate.operations.corpus.corpus_tables import HeardApproach, corpus_rows
    from worldstate.operations.metrics.approach_table import share_interval

    kept = [one.kept for one in corpus_rows(out, HeardApproach) if one.kept is not None]
    interval = "[{:.2f}, {:.2f}]".format(*share_interval(sum(kept), len(kept))) if kept else "not known"
    return f"{sum(kept)} of {len(kept)} onsets, {interval}, in the recordings that were heard whole"


def _shadow(out: Path, found: dict[str, Any]) -> output.CommandResult:
    """Return hours and onsets of the whole corpus, and write their page."""
    from worldstate.operations.corpus import corpus_tables, shadow

    recordings = corpus_tables.corpus_rows(out, corpus_tables.HeardRecording)
    budget = next((one.budget for one in recordings if one.budget is not None), None)
    week = shadow.shadow_hours(corpus_tables.corpus_rows(out, corpus_tables.StateHours), budget)
    shadow.write_shadow_page(out / "shadow.html", week, f"Shadow hours of {out.name}")
    more = week["all"][0].more_hours if week["all"] else None
    told = {"page": str(out / "shadow.html"), "budget": budget, "more_hours_for_budget": more}
    everything = {group: [asdict(row) for row in rows] for group, rows in week.items()}
    lines = [str(row) for rows in week.values() for row in rows]
    return output.CommandResult(found | told | {"hours": everything}, table=found | told, lines=lines)


def _executor(address: str | None) -> AbstractContextManager[Any]:
    """Return the workers of a Dask scheduler, None without an address."""
    if address is None:
        return nullcontext()
    check_extra("distributed")
    from distributed import Client

    try:
        workers: AbstractContextManager[Any] = Client(address, timeout=_CONNECT_S).get_executor()
    except (OSError, ValueError) as error:
        raise InvalidArgumentError(f"--scheduler: expected a Dask scheduler, {address}: {error}") from error
    return workers


def _share(text: str) -> tuple[int, int]:
    if (found := re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)) is None:
        raise InvalidArgumentError(f"--shard: expected such as 3/8, got {text!r:.40}")
    return int(found[1]), int(found[2])
