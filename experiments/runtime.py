"""Runtime: where the time goes, what the cache saves, and how many plans a second a robot can think through.

    python experiments/runtime.py              # default: about 10 minutes on 2 cores
    python experiments/runtime.py --quick      # a first look, on all cores only
    python experiments/runtime.py --checkpoint runs/polish/checkpoint

Milliseconds for 1, 9 and 24 imagined frames, for one scene and for 16, encode, predict and decode apart, on one
thread and on all: the shipped model, the same in the published form (a window computed again at every step), the
baselines that are there, and the paper's own sizes with random weights, which is good for timing and nothing else.
Competitors take turns in every round, so ratios hold on a busy machine too; they are the figures that travel between
machines. Writes `results.json`, `report.html` and a plot into `--out`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import cast

import numpy as np
import torch

from experiments.protocol.arguments import StudyArgs, start
from experiments.protocol.contenders import BASELINES, Absent, LoadVideo, find_contenders
from experiments.protocol.running import StudyRun
from experiments.protocol.runtime_report import build_report, phase_table, ratio_table
from experiments.protocol.runtime_rows import (
    OURS,
    PAPER_CACHE,
    PAPER_WINDOW,
    UNTRAINED,
    WINDOW,
    cell_rows,
    headline,
    query_rows,
    ratio_rows,
)
from experiments.protocol.runtime_subjects import (
    Cell,
    Phase,
    Scenes,
    Subject,
    Work,
    mage_subject,
    paper_models,
    planning_query,
    published_form,
    slot_subject,
    untrained_mage,
    whole_subject,
)
from experiments.protocol.scenes import draw, test_scenes
from experiments.protocol.timing import machine_in_words, other_load, race
from experiments.protocol.workers import available_cores
from experiments.reporting import Results, StudyProgress
from planning import AppearanceGrounder, Instruction, PinholeCamera
from textocvp.baselines.mage import MageVideoModel
from textocvp.world_model import WorldModel

MAGE = "MAGE"
EVERY_PHASE: tuple[Phase, ...] = ("encode", "predict", "decode", "all")


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        frames, batches: of the measurements.
        repeats: rounds of each measurement. seconds: for all models together; what has used its share of them is
            measured 3 times only.
        drawn: at the paper's sizes, at most so many frames (of all scenes together) are drawn, as that takes half a
            second each.
        heavy: frames of all scenes together, at most, for what is slower than the shipped model by far.
        threads: of PyTorch; by default one, and as many as there are cores.
    """

    frames: tuple[int, ...]
    batches: tuple[int, ...]
    repeats: int
    seconds: float
    drawn: int
    heavy: int = 1_000_000
    threads: tuple[int, ...] = tuple(sorted({1, available_cores()}))


QUICK = Sizes(
    frames=(1, 9),
    batches=(1, 16),
    repeats=7,
    seconds=1.0,
    drawn=1,
    heavy=16,
    threads=(available_cores(),),
)
DEFAULT = Sizes(frames=(1, 9, 24), batches=(1, 16), repeats=15, seconds=6.0, drawn=24)


@dataclass
class Args(StudyArgs):
    """Time the models."""

    out: Path = Path("results/runtime")
    """Folder for results.json, report.html and a plot."""
    seed: int = 0
    """Chooses the scenes that are looked at."""
    quick: bool = False
    """A first look with fewer repeats, at most 3 minutes on 2 cores."""
    workers: int = 0
    """Only here because every study has it: timing uses one process, so that nothing disturbs it."""


def main(args: Args, sizes: Sizes | None = None, paper: bool = True) -> Results:
    """Run the study and write its folder.

    Args:
        args: the command line.
        sizes: how much is measured; by default what `args` ask for.
        paper: whether to time the paper's sizes too, which takes most of the time.

    Raises:
        OSError: if the folder cannot be written, before any work is done.
        CheckpointError: if there is no such checkpoint, before any work is done.
    """
    run, sizes = StudyRun.open("runtime", args), sizes or (QUICK if args.quick else DEFAULT)
    # A checkpoint's, so that it is more than what the other studies ask for.
    world_model, busy = cast(WorldModel, run.world_model), other_load()
    scenes = look(args.seed, max(sizes.batches))
    subjects, absent = all_subjects(world_model, scenes, sizes.drawn if paper else 0)
    threads = sizes.threads
    cells = all_cells(sizes)
    seconds: dict[tuple[str, Cell], np.ndarray] = {}
    before = torch.get_num_threads()
    try:
        with StudyProgress({"phases": (len(cells), 3.0), "planning": (len(threads), 10.0)}) as progress:
            for cell in progress.track("phases", cells):
                torch.set_num_threads(cell.threads)
                works = {
                    one.name: work
                    for one in subjects
                    if not (one.heavy and cell.frames * cell.batch > sizes.heavy)
                    and (work := one.work(cell)) is not None
                }
                timed = race(works, sizes.repeats, sizes.seconds)
                seconds |= {(name, cell): taken for name, taken in timed.items()}
                progress.show(phase_table(cell_rows(seconds), cell.threads, cell.batch, sizes.frames))
            queries = {}
            for count in progress.track("planning", threads):
                torch.set_num_threads(count)
                queries[count] = race(plan_works(world_model, args.seed), sizes.repeats, 2 * sizes.seconds)
    finally:
        torch.set_num_threads(before)
    rows = cell_rows(seconds) + query_rows(queries) + ratio_rows(seconds, queries)
    seeds = {
        "study": [args.seed],
        "scenes": [scene.seed for scene in test_scenes("test", len(scenes.texts), args.seed)],
    }
    results = run.results(rows, headline(rows, max(threads)), seeds, {"machine": machine_in_words()})
    notes = {subject.name: subject.note for subject in subjects}
    run.write(build_report(results, notes, absent, sizes.drawn, busy, run.command))
    run.close(progress, results, [phase_table(rows, max(threads), 1, sizes.frames), ratio_table(rows)])
    return results


def look(seed: int, count: int) -> Scenes:
    """The first observations of `count` scenes of the test split."""
    images, texts = [], []
    scenes = test_scenes("test", count, seed)
    env = scenes[0].make()
    for scene in scenes:
        drawn = draw(env, scene)
        images.append(drawn.observation["rgb"])
        texts.append(drawn.texts[0])
    env.close()
    return Scenes(np.stack(images), tuple(texts))


def all_subjects(world_model: WorldModel, scenes: Scenes, drawn: int) -> tuple[list[Subject], list[Absent]]:
    """Everything that is timed, and the baselines that are not there.

    Args:
        drawn: see `Sizes`; with 0 the paper's sizes are left out.
    """
    subjects = [
        slot_subject(
            OURS, "as it ships: frame-causal, keys and values cached", world_model, scenes, EVERY_PHASE
        ),
        slot_subject(
            WINDOW,
            f"the same sizes, the last 10 frames computed again at every step; {UNTRAINED}",
            published_form(world_model),
            scenes,
            ("predict", "all"),
        ),
    ]
    loads = {baseline.method: LoadVideo(baseline.checkpoint) for baseline in BASELINES}
    found, absent = find_contenders(loads)
    notes = {baseline.method: baseline.note for baseline in BASELINES}
    for contender in found:
        name, model = contender.method, contender.load()
        if tuple(model.image_size) != tuple(world_model.image_size):
            absent.append(Absent(name, f"it looks at frames of {model.image_size} pixels"))
        elif isinstance(model, WorldModel):
            subjects.append(slot_subject(name, notes[name], model, scenes, EVERY_PHASE))
        elif isinstance(model, MageVideoModel):
            subjects.append(mage_subject(name, notes[name], model, scenes))
        else:
            subjects.append(whole_subject(name, notes[name], model, scenes))
    if MAGE in {one.method for one in absent}:
        # How long it takes does not depend on what it has learned.
        note = f"{notes[MAGE]}, preset mage-small; {UNTRAINED}"
        subjects.append(mage_subject(MAGE, note, untrained_mage(), scenes))
        absent = [one for one in absent if one.method != MAGE]
    if drawn:
        window, cache = paper_models()
        note = f"8 layers of 512, 8 slots of 128; {UNTRAINED}"
        subjects.append(slot_subject(PAPER_WINDOW, note, window, scenes, EVERY_PHASE, drawn))
        subjects.append(
            slot_subject(PAPER_CACHE, f"the same; {UNTRAINED}", cache, scenes, ("predict", "all"), drawn)
        )
    return subjects, absent


def all_cells(sizes: Sizes) -> list[Cell]:
    """Every measurement, small before large."""
    cells = []
    for count, batch in product(sizes.threads, sizes.batches):
        cells.append(Cell("encode", 1, batch, count))
        cells += [
            Cell(phase, frames, batch, count) for phase, frames in product(EVERY_PHASE[1:], sizes.frames)
        ]
    return cells


def plan_works(world_model: WorldModel, seed: int) -> dict[str, Work]:
    """A planning query with the cache, and with the published window."""
    (scene,) = test_scenes("test", 1, seed)
    env = scene.make()
    drawn = draw(env, scene)
    env.close()
    ground = AppearanceGrounder(PinholeCamera.from_info(drawn.info["camera"]))
    pair = Instruction.parse(drawn.texts[0])
    image = drawn.observation["rgb"]
    grounding = ground(world_model.parse(image[None])).told([pair.block_thing, pair.bowl_thing])
    texts = tuple(instruction.text for instruction in grounding.instructions)
    return {
        name: planning_query(
            model, image, lambda parsed: ground(parsed).told([pair.block_thing, pair.bowl_thing]), pair, texts
        )
        for name, model in ((OURS, world_model), (WINDOW, published_form(world_model)))
    }


if __name__ == "__main__":
    start(main, Args)
