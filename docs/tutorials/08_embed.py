"""A loop in a stack: measurements that come late and twice, a checkpoint half way, and snapshots as JSON."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from tutorial_options import tutorial_options

from worldstate import Measurement, WorldState
from worldstate.adapters import Checkpoint, measure_steps, open_source, read_checkpoint, save_checkpoint
from worldstate.operations.figure_style import figure_file
from worldstate.simulation import DatasetSettings, write_dataset


def deliveries(measured: list[Measurement], rng: np.random.Generator) -> list[tuple[float, Measurement]]:
    """Return measurements with the second of their arrival: .1 to 1.2 s late, one in ten delivered twice."""
    late = [(one.stamp_ns / 1e9 + rng.uniform(0.1, 1.2), one) for one in measured]
    again = [(at + 0.3, one) for at, one in late if rng.random() < 0.1]
    return sorted(late + again, key=lambda arrival: arrival[0])


def chance(state: WorldState) -> float:
    """Return the larger chance of both sides that a vehicle comes into view within three seconds."""
    return max(np.nan if cue.within is None else cue.within["3"] for cue in state.cues)


def main(out: Path, size: str = "full") -> None:
    """Draw what is known at every time, in order and as delivered, and check that both end the same."""
    settings = DatasetSettings(1, seed=1, bandwidth_hz=2000.0, duration_s=6.0 if size == "small" else 10.0)
    with TemporaryDirectory() as root:
        source = open_source(Path(root) / write_dataset(root, settings)[0].folder)
        measured = [one for _, one in measure_steps(source)]
    in_order, straight = source.world(), []
    for one in measured:
        in_order = in_order.update(one)
        straight.append((one.stamp_ns / 1e9, in_order.state))
    world, live = source.world(), []
    arrivals = deliveries(measured, np.random.default_rng(1))
    for number, (arrives_s, one) in enumerate(arrivals):
        world = world.update(one)
        live.append((arrives_s, world.state))
        if number == len(arrivals) // 2:  # the process ends here, and another one goes on
            save_checkpoint(out / "checkpoint.json", Checkpoint(world))
            world = read_checkpoint(out / "checkpoint.json").world
    (out / "states.jsonl").write_text("".join(state.to_json() + "\n" for _, state in live))
    again = [WorldState.from_json(line) for line in (out / "states.jsonl").read_text().splitlines()]
    same = world.state.entities == in_order.state.entities and world.state.cues == in_order.state.cues
    print(f"last state as if in order: {same}; snapshots read back: {again == [one for _, one in live]}")
    print(world.state.delivery)
    with figure_file(out / "08_embed.png", 8.0, 3.4) as figure:
        axes = figure.subplots()
        for name, told in (("in order, no delay", straight), ("as delivered", live)):
            axes.step([at for at, _ in told], [chance(s) for _, s in told], where="post", label=name)
        axes.axvline(live[len(live) // 2][0], color="black", linestyle=":", label="checkpoint")
        axes.set(ylim=(0.0, 1.0), xlabel="clock, s", ylabel="chance to come into view within 3 s")
        axes.legend(loc="upper left")


if __name__ == "__main__":
    main(*tutorial_options(__doc__))
