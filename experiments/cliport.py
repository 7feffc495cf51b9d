"""The paper's ground: CLIPort's own episodes, or our own scenes that look like them.

    python experiments/cliport.py --episodes FOLDER    # npz files as CLIPort's code plays them, or an episode file
    python experiments/cliport.py                      # our own scenes, and the closed loop in them
    python experiments/cliport.py --quick              # a first look

Every episode is imagined from its first frame and its sentence, and measured at the episode's own size over 9, 19 and
all frames: PSNR, SSIM, LPIPS (AlexNet), overlap of masks, foreground ARI. An imagined sentence succeeds when the named
block comes to lie within 5 cm of the place of the named bowl, CLIPort's own tolerance, seen through the camera.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, cast

import numpy as np

from envs.scenes import SCENES
from envs.tasks.base import CLIPORT_RADIUS
from experiments.report.page import CardSpec, Clips, Section
from experiments.report.results import Results
from experiments.report.rows import Key, Row, figure_rows
from experiments.report.tables import Column, Paper, TableSpec, quoted
from experiments.study.any_size import Film, Seen, compare, drawn, fitted, imagine, length_columns
from experiments.study.cliport import Recorded, Source, misses, other_sentences, read
from experiments.study.clips import extreme_clips
from experiments.study.closed_loop import LoopEpisode
from experiments.study.frame_metrics import METRICS, Measures, Scorer, available_measures
from experiments.study.methods import METHODS, Method, Model, lines, with_paper
from experiments.study.pool import Unit, Worker
from experiments.study.predictions import to_tensor
from experiments.study.run import Found, Part, Run, ScenesArgs, Study, UsageError, start
from experiments.study.scenes import StudyScene, study_scenes
from planning import THRESHOLDS, BeamPlanner, Goal, Imagines, Instruction, LiteralController, Planner, RandomPlanner
from textocvp.data import open_episodes
from textocvp.data.cliport import CliportEpisodes
from textocvp.data.episodes import Episode

SIDE = 336  # pixels of our own scenes, as in the paper
ALL = "all"  # the split of figures over all episodes
LENGTHS = {"9 frames": 9, "19 frames": 19}  # the paper's two
VARIANTS = (*LENGTHS, "episode")
SENTENCES = ("original", "other bowls")  # the episode's own, and those that name another bowl of the scene
OWN_SPLITS = {"test": "6 objects", "unseen_colors": "unseen colours", "more_objects": "8 objects"}
TAUGHT = "ours, taught by masks"
LITE0, LITE0_PARSER = "TextOCVP on EfficientNet-Lite0", "slot attention on EfficientNet-Lite0"
BUNDLED = (TAUGHT, LITE0, LITE0_PARSER)  # models whose bundled checkpoints know this scene


def _whole_films(model: Imagines, goal: Goal, rng: np.random.Generator, seed: int) -> Planner:
    """As far as the model looks ahead: these episodes are twice as long as those of the easy scene."""
    return BeamPlanner(model, seed=seed)


def _random(model: Imagines, goal: Goal, rng: np.random.Generator, seed: int) -> Planner:
    return RandomPlanner(model, rng, depth=1, seed=seed)


PLAYERS: dict[str, Method] = {
    one.key: one
    for one in (
        replace(
            METHODS["ours"],
            plan=_whole_films,
            controller=LiteralController,
            note="imagine the named block in every bowl, score, act, look; picks and places where things are seen",
        ),
        METHODS["no imagination"],
        replace(METHODS["random candidate"], plan=_random, controller=LiteralController),
        METHODS["expert"],
    )
}
"""Who acts in the closed loop."""


def _paper(label: str, success: Sequence[float] = (), **figures: tuple[float, float]) -> Paper:
    """The paper's figures at 9 and 19 frames; of success, of the original sentence and of other bowls."""
    found = quoted(ALL, LENGTHS, **figures) | quoted(ALL, SENTENCES, success=success)
    return Paper(f"paper, {label}", found, "CLIPort at 336x336, other episodes")


PAPERS = {
    "ours": _paper(
        "TextOCVP", psnr=(26.99, 23.88), ssim=(0.950, 0.931), lpips=(0.062, 0.078), iou=(0.573, 0.569),
        success=(0.83, 0.82),
    ),
    "Non-OC": _paper("Non-OC", psnr=(23.44, 20.14), ssim=(0.901, 0.872), lpips=(0.184, 0.210)),
    "MAGE": _paper("MAGE-DINO", psnr=(23.72, 22.27), ssim=(0.940, 0.931), lpips=(0.064, 0.075)),
    "SEER": _paper("SEER", psnr=(21.01, 11.30), ssim=(0.887, 0.622), lpips=(0.141, 0.331)),
    "true frames": _paper("parser on true frames", iou=(0.554, 0.553)),
    "copy frame": _paper("Copy-Seed", iou=(0.540, 0.525)),
}  # fmt: skip
MEASURED = lines(("ours", TAUGHT, LITE0, "Non-OC", "MAGE", "true frames", LITE0_PARSER, "wrong text", "copy frame"))
LINES = with_paper(MEASURED, PAPERS)


@dataclass
class Args(ScenesArgs):
    """Arguments of the study on CLIPort's ground."""

    checkpoint: str = "cliport"
    """Bundled name, folder, or id on the Hugging Face hub."""
    episodes: Path | None = None
    """Folder of CLIPort's npz files, one of them, or an episode file; without it our own scenes are played."""
    loops: int = 0
    """Scenes of each split for the closed loop; 0 for as many as are imagined."""


@dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    episodes: int | None  # of a folder; None for all
    scenes: int  # of each split of our own
    loop: int  # of each split, in the closed loop
    clips: int  # how many best and how many worst cases are shown

    @classmethod
    def of(cls, args: Args) -> Sizes:
        """How much a command line asks for."""
        base, n = cls(4, 2, 2, 1) if args.quick else cls(None, 30, 40, 4), args.scenes
        base = replace(base, episodes=n, scenes=n, loop=n) if n else base
        return replace(base, loop=args.loops or base.loop)


@dataclass(frozen=True)
class CliportLoop(LoopEpisode):
    """A unit of work: one of `PLAYERS`, one scene."""

    methods = PLAYERS


# --- episodes ---------------------------------------------------------------------------------------------------------


def own_scenes(run: Run, count: int, side: int) -> list[StudyScene]:
    """So many of each split, looking like CLIPort's."""
    seed = run.args.seed
    return [one for split in OWN_SPLITS for one in study_scenes(split, count, seed, "cliport", side)]


def prepare(run: Run) -> tuple[Sequence[Source], Sequence[str]]:
    """The episodes, and a line for each that is left out; a UsageError if none can be measured."""
    path = cast(Args, run.args).episodes
    if path is None:
        run.remarks += [f"Careful: {missing}."] if (missing := SCENES["cliport"].missing) else []
        return own_scenes(run, run.sizes.scenes, SIDE), ()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # the same lines are in `problems`
            opened = open_episodes(path)
    except ValueError as error:
        raise UsageError(str(error)) from error
    found, problems = [], list(getattr(opened, "problems", ()))
    for i, text in enumerate(opened.instructions):
        name, split = f"{path}, episode {i}", getattr(opened, "split", "")
        if isinstance(opened, CliportEpisodes):
            name, split = str(opened.files[i]), opened.metas[i].get("task", "")
        try:
            Instruction.parse(text)
            found.append(Recorded(opened, i, split or "episodes", Path(name).name))
        except ValueError:
            problems.append(f"{name}: its sentence cannot be read: {text!r}")
    for problem in problems:
        print(f"left out: {problem}", file=sys.stderr)
    if not found:
        raise UsageError(f"no episode of {path} can be measured; {[*problems, 'it is empty'][0]}")
    return found[: run.sizes.episodes], problems


def inputs(args: Args) -> list[Path]:
    """The files of the episodes."""
    path = args.episodes
    return [] if path is None else sorted(path.glob("*.npz")) if path.is_dir() else [path]


# --- measuring --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class EpisodeUnit:
    """A unit of work: one episode, imagined by every model and every control."""

    source: Source
    models: tuple[Model, ...]
    measures: Measures
    seed: int

    @property
    def scene(self) -> StudyScene | None:
        """For the list of seeds."""
        return self.source if isinstance(self.source, StudyScene) else None

    def run(self, worker: Worker) -> tuple[str, dict[tuple[str, str, str], float]]:
        """Imagine, compare, judge: the split, and (method, variant, metric) -> figure."""
        truth, ours = read(self.source, worker), worker.world_model
        asked = Instruction.parse(truth.instruction)
        others, wrong = other_sentences(truth, asked)
        real_T3HW = to_tensor(truth.frames)
        T, side = len(truth.frames), truth.frames.shape[1]
        scorer = Scorer(real_T3HW, self.measures, upper=False)
        figures: dict[tuple[str, str, str], float] = {}

        def imagined(model: Any, sentence: Instruction) -> Seen:
            return imagine(worker, model, truth.frames[0], sentence.text, T - 1, self.seed)

        def parsed(model: Any) -> Seen:
            return drawn(model.parse(fitted(truth.frames, model), seed=self.seed), side)

        def measure(method: str, seen: Seen, of_others: Iterable[Seen] = ()) -> None:
            """Figures of what is shown of the sentence, and of the others, as far as they are shown."""
            figures.update(compare(scorer, method, seen, truth, {**LENGTHS, "episode": T - 1}))
            off = misses(seen.labels, truth, asked)
            off_others = [misses(s.labels, truth, o) for o, s in zip(others, of_others, strict=False)]
            for variant, its in zip(SENTENCES, ([off], off_others), strict=True):
                if judged := [(one < CLIPORT_RADIUS).all() for one in its if one is not None]:
                    figures[method, variant, "success"] = float(np.mean(judged))

        seen = imagined(ours, asked)
        still = Seen(real_T3HW[:1], seen.labels[:1])
        measure("ours", seen, (imagined(ours, other) for other in others))
        for one in self.models:
            model = worker.model(one.load)
            if one.key == LITE0_PARSER:
                measure(one.key, parsed(model))
            else:
                measure(one.key, imagined(model, asked), (imagined(model, other) for other in others))
        measure("true frames", parsed(ours))
        if wrong != asked:
            measure("wrong text", imagined(ours, wrong))
        measure("copy frame", still, [still] * len(others))
        return self.source.split, figures


# --- work -------------------------------------------------------------------------------------------------------------


def block_ends(truth: Episode, seen: Seen) -> str:
    """How far off, for the caption of a film."""
    off = misses(seen.labels, truth, Instruction.parse(truth.instruction))
    return "" if off is None else f"; block ends {100 * off[-1]:.1f} cm off"


def models(run: Run) -> tuple[Model, ...]:
    """The other models that know this scene: those bundled for it, and those named on the command line."""
    return tuple(m for m in run.models if m.key in BUNDLED or m.checkpoint != METHODS[m.key].model)


def units(run: Run) -> dict[str, Part]:
    """The episodes; without a file also the closed loop."""
    seed, (episodes, _) = run.args.seed, run.prepared
    work = [EpisodeUnit(source, models(run), run.measures, seed) for source in episodes]
    parts = {"episodes": Part(work, 40.0), "films": Part(seconds=15.0, count=2 * run.sizes.clips)}
    if cast(Args, run.args).episodes is None:
        own = run.world_model.image_size[0]
        scenes = own_scenes(run, run.sizes.loop, SIDE if SIDE % own == 0 else own)
        loop = [CliportLoop(method, scene, seed=seed) for scene in scenes for method in PLAYERS]
        parts["closed loop"] = Part(loop, 10.0)
    return parts


def cases(run: Run, found: Found) -> dict[str, Sequence[Unit]]:
    """Films of the episodes that look best and worst over the whole episode."""
    metric, (episodes, _) = run.measures.main, run.prepared
    values = [figures["ours", "episode", metric] for _, figures in found["episodes"]]
    films = []
    for source, value in zip(episodes, values, strict=True):
        name = f"{source.split}, seed {source.seed}" if isinstance(source, StudyScene) else source.name
        caption = f"{METRICS[metric]} {value:.3f}; {name}"
        films.append(Film("cliport", partial(read, source), run.args.seed, caption, block_ends))
    return {"films": extreme_clips(films, [*map(run.measures.badness, values)], run.sizes.clips)}


# --- rows -------------------------------------------------------------------------------------------------------------


def rows(run: Run, found: Found) -> list[Row]:
    """Every figure over all episodes and over each split; how many there are; the closed loop."""
    made = figure_rows(
        [
            (place, {key: value})
            for split, figures in found["episodes"]
            for key, value in figures.items()
            for place in dict.fromkeys((ALL, split))
        ],
        rates={"success"},
    )
    if n := len(found["episodes"]):
        made.append(Row("episodes", ALL, ALL, "n", n, n, n, n))
    return made + figure_rows(
        (one.episode.scene.split, {(one.episode.method, "original", "closed_loop_success"): one.success})
        for one in found.get("closed loop", ())
    )


def headline(run: Run) -> dict[str, Key]:
    """As asked for in the study's description; `_copy` for the first frame repeated, `_true` for true frames."""
    named: dict[str, Key] = {"n": ("episodes", ALL, ALL, "n")}
    for method, ending in {"ours": "", "copy frame": "_copy", "true frames": "_true"}.items():
        for metric, (variant, n) in product(("psnr", "ssim", "lpips", "iou"), LENGTHS.items()):
            named[f"{metric}_{n}{ending}"] = (method, ALL, variant, metric)
        named[f"success_original{ending}"] = (method, ALL, "original", "success")
        named[f"success_variants{ending}"] = (method, ALL, "other bowls", "success")
    for split, (method, ending) in product(OWN_SPLITS, {"ours": "", "no imagination": "_no_imagination"}.items()):
        named[f"closed_loop_{split}{ending}"] = (method, split, "original", "closed_loop_success")
    return named


# --- tables and page --------------------------------------------------------------------------------------------------


SUCCESS = [Column(f"success, {sentence}", ALL, sentence, "success") for sentence in SENTENCES]
FRAMES = TableSpec(
    "Frames", length_columns(ALL, VARIANTS, ("psnr", "ssim", "lpips")), list(LINES.values()),
    "PSNR, SSIM: higher is better; LPIPS (AlexNet): lower.",
)  # fmt: skip
MASKS = TableSpec(
    "Masks, and predicted success", [*length_columns(ALL, VARIANTS, ("iou", "ari")), *SUCCESS], list(LINES.values()),
    "Masks: slots are matched to objects afresh in every frame (Hungarian); no visible object is left out.",
)  # fmt: skip
LOOP = TableSpec(
    "Closed loop in our own scenes",
    [Column(title, split, "original", "closed_loop_success") for split, title in OWN_SPLITS.items()],
    list(PLAYERS.values()),
    "Judged by the simulator.",
)


def page(run: Run, results: Results, found: Found) -> list[Section]:
    """The sections of the report."""
    figures, (episodes, problems), known = list(results.rows), run.prepared, models(run)
    frames, masks, loop = run.tables(figures)
    by_split = [
        replace(
            spec, title=f"{spec.title}: {split}", lines=MEASURED,
            columns=[replace(column, split=split) for column in spec.columns],
        ).table(figures, run.missing)
        for split, spec in product(dict.fromkeys(one.split for one in episodes), (FRAMES, MASKS))
    ]  # fmt: skip
    longest = {"ours": run.world_model.longest_horizon, **{model.key: model.longest for model in known}}
    limits = ", ".join(f"{key} {n} frames" for key, n in longest.items() if n)
    absent = [*run.remarks, *(f"Left out: {problem}." for problem in problems)]
    absent += [
        f"{key} is absent: none was trained in this scene; name one with --model {key}=FOLDER."
        for key in ("Non-OC", "MAGE")
        if key not in longest
    ]
    sections = [
        Section(
            "As in the paper's tables",
            f"Imagined from the first frame and the sentence, by {run.checkpoint.name}, which was trained on frames of "
            f"{run.world_model.image_size[0]} pixels. Models with slots get an episode's frames as they are where its "
            "side is a whole multiple of the model's; others are reduced by area, and what is drawn smaller than the "
            "episode is enlarged, so that all lines are measured alike. Beyond what a model looks ahead "
            f"({limits or 'all look as far as they must'}) its last frame is held. A sentence succeeds when the block "
            f"that it names lies within {100 * CLIPORT_RADIUS:g} cm of where the named bowl stood, in the last "
            f"{THRESHOLDS.settle_frames} frames: CLIPort's own tolerance. The block's slot is the one matched to it in "
            "the first frame; its way is measured through the camera. A wrong text is judged for the episode's own "
            "sentence. The paper's episodes are others.",
            [frames, masks],
        ),
        Section("By split", "The same figures by where the episodes come from.", by_split),
    ]
    if "closed loop" in found:
        text = "The planner imagines, a robot acts in PyBullet. These are our own scenes that look like CLIPort's."
        sections.append(Section("Closed loop", text, [loop]))
    ranked = f"The best and the worst by {METRICS[run.measures.main]}."
    sections.append(Section("Films", ranked, [Clips(found["films"])]))
    return [*sections, Section("What is absent", " ".join(absent) or "Nothing.")]


STUDY = Study(
    name="cliport",
    title="CLIPort's own episodes",
    question="On the ground where the paper was measured: does ours imagine what then happens?",
    args=Args,
    sizes=Sizes.of,
    methods=[line.key for line in MEASURED],
    measures=lambda args: available_measures(["lpips"]),  # ST-LPIPS would take minutes an episode here
    prepare=prepare,
    inputs=inputs,
    units=units,
    cases=cases,
    rows=rows,
    tables=(FRAMES, MASKS, LOOP),
    page=page,
    cards=[
        CardSpec(f"{column.title}, {key}", LINES[key], column, bar=False)
        for key, column in (
            *product(["ours"], (*FRAMES.columns[1:3], MASKS.columns[0], *SUCCESS)),
            ("copy frame", FRAMES.columns[2]),
        )
    ],
    headline=headline,
    first=("lpips_9", "ssim_9", "iou_9", "success_original", "success_variants"),
)

if __name__ == "__main__":
    start(STUDY)
