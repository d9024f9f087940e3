"""`worldstate hear`: write tables of the approaches in many recordings.

Process every recording of a corpus and write its approaches as Parquet: time, side, lead, probability, and
whether a vehicle was seen. A second run processes only missing recordings, also after a kill. The tables have
the same bytes for any number of processes or machines.

CORPUS is a folder of sound files, bags of ROS 2, recording folders in the OVAD layout and logs of snapshots
(JSON lines, MCAP), or a manifest: a CSV file with the column path, relative to its own folder, and optionally
site, detections and odometry. Otherwise the first folder of a path below CORPUS is its site.

DIR receives the folders recordings, approaches and hours with one Parquet file per recording. The name of a
file follows from the content, the array, the model, the options and the version. A recording that cannot be
read has a row with the failure in recordings. One call reads all files of a table, for example
pandas.read_parquet("DIR/approaches").

--cascade uses four microphones first, and all of them only around seconds with unusual level or coherence.
One recording in twenty is processed completely; this gives the recall.

--shadow takes every recording of DIR as hazard-free and counts every advisory as false: hours with and
without usable sound, onsets per hour with exact intervals by site, day and state of the sensors, and the
further hours that would prove the budget.

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

from worldstate.cli.common import inputs, output, progress
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.extras import check_extra

if TYPE_CHECKING:
    from worldstate.operations.corpus.corpus_run import HeardShard

NEEDS = ("pyarrow",)
_CONNECT_S = 10.0


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("corpus", type=Path, metavar="CORPUS", help="folder of recordings, or a manifest (CSV)")
    add("--out", type=Path, required=True, metavar="DIR", help="folder of the tables")
    inputs.add_array_options(parser)
    inputs.add_car_options(parser)
    inputs.add_listen_options(parser)
    add("--hops", action="store_true", help="write a row per hop as well, with its snapshot")
    quick = "process only seconds that are louder or more coherent than usual; prints the recall"
    add("--cascade", action="store_true", help=quick)
    told = "count every advisory as false: onsets per hour by site and sensor state, DIR/shadow.html"
    add("--shadow", action="store_true", help=told)
    add("--shard", default="1/1", metavar="I/N", help="process share I of N, such as of a SLURM array")
    dask = "Dask scheduler whose workers replace the processes; they need the same files (extra dask)"
    add("--scheduler", metavar="ADDRESS", help=dask)
    add("--jobs", type=int, default=1, metavar="N", help="number of processes (default: 1)")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.operations.corpus.corpus_inputs import find_corpus, share_of
    from worldstate.operations.corpus.corpus_run import hear

    shard, taken = _share(arguments.shard), ("array", "car", "camera", "hops", "cascade")
    parts = inputs.listen_parts(arguments) | {name: vars(arguments)[name] for name in taken}
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
    """Return the recall of the cascade in the recordings that were processed completely."""
    from worldstate.operations.corpus.corpus_tables import HeardApproach, corpus_rows
    from worldstate.operations.metrics.approach_table import share_interval

    kept = [one.kept for one in corpus_rows(out, HeardApproach) if one.kept is not None]
    interval = "[{:.2f}, {:.2f}]".format(*share_interval(sum(kept), len(kept))) if kept else "not known"
    return f"{sum(kept)} of {len(kept)} onsets, {interval}, in the recordings that were heard whole"


def _shadow(out: Path, found: dict[str, Any]) -> output.CommandResult:
    """Write the page of hours and onsets of the whole corpus; return them."""
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
