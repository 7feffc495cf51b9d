"""Runtime: where the time goes, what the cache saves, and how many plans a second a robot can think through.

    python experiments/runtime.py              # default: about 10 minutes on 2 cores
    python experiments/runtime.py --quick      # a first look, on all cores only
    python experiments/runtime.py --checkpoint runs/polish/checkpoint

Milliseconds for 1, 9 and 24 imagined frames, for one scene and for 16, encode, predict and decode apart, on one
thread and on all: the shipped model, the same without its cache and in the published form (a window computed again at
every step), the baselines that are there, and the paper's own sizes with random weights, which is good for timing and
nothing else. Competitors take turns in every round, so ratios hold on a busy machine too; they are the figures that
travel between machines. Writes `results.json` and `report.html` into `--out`.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
import torch

from experiments.report.page import CardSpec, Section
from experiments.report.results import Results
from experiments.report.rows import Key, Row, interval_row
from experiments.report.tables import Column, Line, Table, TableSpec
from experiments.study.methods import BASELINES, lines
from experiments.study.pool import Worker
from experiments.study.run import Found, Part, Run, Study, UsageError, start
from experiments.study.scenes import SampledScene, StudyScene, sample_scene, study_scenes
from experiments.study.timing import CORES, Work, machine_in_words, median_interval, race
from planning import THRESHOLDS, AppearanceGrounder, Instruction, measure_rollout, score, succeeds, watched_frames
from textocvp.baselines.mage import MageVideoModel
from textocvp.config import ModelConfig
from textocvp.metrics.intervals import Interval
from textocvp.model import TextOCVP
from textocvp.presets import preset
from textocvp.protocols import VideoModel
from textocvp.world_model import WorldModel

UNTRAINED = "untrained, timing only"
OURS, WINDOW, UNCACHED = "TextOCVP", "TextOCVP, published window", "TextOCVP, no cache"
PAPER_WINDOW, PAPER_CACHE = "paper's sizes, published window", "paper's sizes, cache"
LINES = [
    Line(key=OURS, note="as it ships: frame-causal, keys and values cached"),
    Line(key=WINDOW, kind="control", hue=1,
         note=f"the same sizes, the last 10 frames computed again at every step; {UNTRAINED}"),
    Line(key=UNCACHED, kind="control", hue=2, note="as it ships, the past computed again at every step"),
    *lines(BASELINES),
    Line(key=PAPER_WINDOW, kind="control", note=f"8 layers of 512, 8 slots of 128; {UNTRAINED}"),
    Line(key=PAPER_CACHE, kind="control", note=f"the same; {UNTRAINED}"),
]  # fmt: skip
AGAINST = {WINDOW: OURS, UNCACHED: OURS, PAPER_WINDOW: PAPER_CACHE}
"""What each is compared with in every phase. What is not here is compared with ours, all phases together."""
CANDIDATES, STEPS, STRIDE = 30, 24, 3  # of a planning query
QUERY = f"planning query, {CANDIDATES} candidates x {STEPS} frames"

Phase = Literal["encode", "predict", "decode", "all", "query", "imagine", "masks"]
PHASES: tuple[Phase, ...] = ("encode", "predict", "decode", "all")
PLANNING: tuple[Phase, ...] = ("query", "imagine", "masks")


@dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    frames: tuple[int, ...]  # numbers of imagined frames
    batches: tuple[int, ...]  # numbers of scenes at once
    repeats: int  # rounds of each measurement
    seconds: float  # for all models together; what has used its share of them is measured 3 times only
    # Frames of all scenes together, at most, that are drawn at the paper's sizes, as each takes half a second (0 leaves
    # these sizes out), and that are asked of what is slower than the shipped model by far.
    drawn: int
    heavy: int | None = None
    threads: tuple[int, ...] = tuple(sorted({1, CORES}))  # of PyTorch


QUICK = Sizes((1, 9), (1, 16), repeats=7, seconds=1.0, drawn=1, heavy=16, threads=(CORES,))
DEFAULT = Sizes((1, 9, 24), (1, 16), repeats=15, seconds=6.0, drawn=24)


@dataclass(frozen=True)
class Timing:
    """What is timed."""

    # `encode`: one observed frame; `predict`: read the sentences and imagine slots or codes; `decode`: draw them;
    # `all`: from observed frames to imagined ones; `query`: of a planner, and in it `imagine` and draw `masks`
    phase: Phase
    frames: int  # how many are imagined (1 for `encode`)
    batch: int  # scenes at once, or candidates
    threads: int  # of PyTorch

    @property
    def place(self) -> tuple[str, str]:
        """Split and variant of its rows."""
        variant = QUERY if self.phase == "query" else f"{self.phase}, {self.frames} x {self.batch}"
        return threads_word(self.threads), variant


Seconds = Mapping[tuple[str, Timing], np.ndarray]  # (name of who was timed, what was timed) -> (rounds,) seconds


def threads_word(count: int) -> str:
    """As `2 threads`."""
    return f"{count} thread" + ("s" if count > 1 else "")


def all_timings(frames: Sequence[int], batches: Sequence[int], threads: Sequence[int]) -> list[Timing]:
    """Every measurement, small before large, and planning last."""
    shapes = [("encode", 1), *product(PHASES[1:], frames)]
    made = [Timing(phase, t, b, n) for n, b, (phase, t) in product(threads, batches, shapes)]
    return made + [Timing(phase, STEPS, CANDIDATES, n) for n, phase in product(threads, PLANNING)]


# --- what is timed ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Subject:
    """A model in its phases. What comes before a phase is computed once and not timed."""

    name: str  # of its rows
    model: VideoModel
    phases: tuple[Phase, ...] = PHASES  # that are asked for
    drawn: int | None = None  # the most frames of all scenes together that it is asked to draw
    most: int | None = None  # the same, of any phase
    cached: bool = True  # whether keys and values are kept

    def work(self, what: Timing, sampled: Sequence[SampledScene]) -> Work | None:
        """The work of a measurement; None for what the model cannot do or is not asked."""
        count = what.frames * what.batch
        limits = [(what.frames, self.model.longest_horizon), (count, self.most)]
        limits += [(count, self.drawn)] if what.phase in ("decode", "all") else []
        if what.phase not in self.phases or any(limit is not None and n > limit for n, limit in limits):
            return None
        if what.phase in PLANNING:
            return planning_work(self.model, what.phase, sampled[0])
        images_BHW3 = np.stack([one.observation["rgb"] for one in sampled[: what.batch]])
        texts = [one.texts[0] for one in sampled[: what.batch]]
        if what.phase == "all":
            return lambda: self.model.imagine(images_BHW3, texts, horizon=what.frames)
        cut = self._codes if isinstance(self.model, MageVideoModel) else self._slots
        with torch.no_grad():
            return torch.no_grad()(cut(what, images_BHW3, texts)[what.phase])

    def _slots(self, what: Timing, images_BHW3: np.ndarray, texts: list[str]) -> Mapping[Phase, Work]:
        assert isinstance(self.model, WorldModel)
        world_model, model, cached = self.model, self.model.model, self.cached
        parsed = world_model.parse(images_BHW3[:, None])
        slots = parsed.slots
        # Slots of the observation will do: what slots hold does not change what drawing them costs.
        seen = replace(parsed, slots=parsed.slots.expand(-1, what.frames, -1, -1))
        return {
            "encode": lambda: world_model.parse(images_BHW3[:, None]),
            "predict": lambda: model.predictor.rollout(slots, model.text(texts), what.frames, use_cache=cached),
            # A selection of it each time: what a rollout has drawn it does not draw again.
            "decode": lambda: seen.select(slice(None)).frames,
        }

    def _codes(self, what: Timing, images_BHW3: np.ndarray, texts: list[str]) -> Mapping[Phase, Work]:
        assert isinstance(self.model, MageVideoModel)
        model = self.model.model
        frames_B3HW = torch.from_numpy(images_BHW3).permute(0, 3, 1, 2).float() / 127.5 - 1
        seen_B1hw = model.vqvae.encode(frames_B3HW)[:, None]
        codes_Nhw = seen_B1hw.expand(-1, what.frames, -1, -1).flatten(0, 1)
        return {
            "encode": lambda: model.vqvae.encode(frames_B3HW),
            "predict": lambda: model.axial.imagine(seen_B1hw, model.text(texts), what.frames),
            "decode": lambda: model.vqvae.decode(codes_Nhw),
        }


def subjects_of(run: Run) -> list[Subject]:
    """Ours in its forms, the baselines that are there, and the paper's sizes."""
    ours, drawn, heavy = run.world_model, run.sizes.drawn, run.sizes.heavy
    if not isinstance(ours, WorldModel):
        raise UsageError(f"{run.args.checkpoint} is no world model whose phases are known")
    subjects = [
        Subject(OURS, ours, (*PHASES, *PLANNING)),
        Subject(WINDOW, published_form(ours), ("predict", "all", "query", "imagine")),
        Subject(UNCACHED, ours, ("predict",), cached=False),
    ]
    for one in run.models:
        model = one.load()
        if tuple(model.image_size) != tuple(ours.image_size):
            run.remarks.append(f"{one.key} is absent: it looks at frames of {model.image_size} pixels.")
            continue
        phases = PHASES if isinstance(model, (WorldModel, MageVideoModel)) else ("all",)
        most = heavy if isinstance(model, MageVideoModel) else None
        subjects.append(Subject(one.key, model, phases, most=most))
    if drawn:
        torch.manual_seed(0)
        config = preset("savi-cater")
        causal = replace(config, predictor=replace(config.predictor, attention="causal", window=STEPS))
        paper = TextOCVP(config)
        subjects.append(Subject(PAPER_WINDOW, WorldModel(paper), PHASES, drawn, heavy))
        subjects.append(Subject(PAPER_CACHE, reshaped(paper, causal), ("predict", "all"), drawn, heavy))
    return subjects


def published_form(world_model: WorldModel) -> WorldModel:
    """The same sizes with the published predictor: a window of 10 frames, computed again at every step."""
    config = world_model.model.config
    window = replace(config.predictor, attention="window", window=10, age_encoding="learned")
    return reshaped(world_model.model, replace(config, predictor=window))


def reshaped(model: TextOCVP, config: ModelConfig) -> WorldModel:
    """A model in another form of its predictor, with its weights as far as they fit: good for timing only."""
    other = TextOCVP(config)
    weights = {name: tensor for name, tensor in model.state_dict().items() if name != "predictor.ages"}
    other.load_state_dict(weights, strict=False)
    return WorldModel(other)


def planning_work(model: VideoModel, phase: Phase, sampled: SampledScene) -> Work:
    """What a planner asks for once, or one of its costly parts; a GroundingError if the goal's things are not seen."""
    assert isinstance(model, WorldModel)
    image_1HW3, ground = sampled.observation["rgb"][None], AppearanceGrounder.from_info(sampled.info)
    goal, parsed = Instruction.parse(sampled.texts[0]), model.parse(image_1HW3)
    frames = watched_frames(STEPS + 1, THRESHOLDS.settle_frames, STRIDE)
    allowed = ground(parsed).with_kinds(goal.things).instructions(goal.relation)
    texts = [allowed[i % len(allowed)].text for i in range(CANDIDATES)]

    def query() -> object:
        """Parse, find the things, imagine every candidate, draw the masks that the scorer looks at, score and judge."""
        parsed = model.parse(image_1HW3)
        grounding = ground(parsed).with_kinds(goal.things)
        rollout = model.rollout(parsed, texts, horizon=STEPS)
        trace = measure_rollout(rollout, grounding, goal, frames=frames)
        return score(trace), succeeds(trace)

    rollout = model.rollout(parsed, texts, horizon=STEPS)
    return {
        "query": query,
        "imagine": lambda: model.rollout(parsed, texts, horizon=STEPS),
        "masks": lambda: rollout.select(slice(None)).decode_masks(frames),
    }[phase]


# --- units of work ----------------------------------------------------------------------------------------------------


def prepare(run: Run) -> tuple[list[Subject], list[SampledScene], float]:
    """Who is timed, what they look at, and how busy the cores were before: 0 idle, 1 all busy, more if work queued."""
    busy = os.getloadavg()[0] / CORES if hasattr(os, "getloadavg") else 0.0
    side = run.world_model.image_size[0]
    scenes = study_scenes("test", max(run.sizes.batches), run.args.seed, image_size=side)
    env = scenes[0].make()
    sampled = [sample_scene(env, scene) for scene in scenes]
    env.close()
    return subjects_of(run), sampled, busy


@dataclass(frozen=True)
class Race:
    """A unit of work: one phase of everybody."""

    what: Timing
    study: Run

    @property
    def scenes(self) -> list[StudyScene]:
        """What is looked at."""
        return [one.scene for one in self.study.prepared[1]]

    def run(self, worker: Worker) -> Seconds:
        """Time it."""
        what, sizes, (subjects, sampled, _) = self.what, self.study.sizes, self.study.prepared
        torch.set_num_threads(what.threads)
        works = {one.name: work for one in subjects if (work := one.work(what, sampled)) is not None}
        taken = race(works, sizes.repeats, sizes.seconds * (2 if what.phase in PLANNING else 1))
        torch.set_num_threads(1)  # as for every unit of a study
        return {(name, what): seconds for name, seconds in taken.items()}


def units(run: Run) -> dict[str, Part]:
    """Every phase, small before large."""
    timings = all_timings(run.sizes.frames, run.sizes.batches, run.sizes.threads)
    return {"phases": Part([Race(what, run) for what in timings], 3.0)}


# --- rows -------------------------------------------------------------------------------------------------------------


DECODE, BATCH, THREADS = "decode / predict", "a scene of a batch / a scene alone", "1 thread / all"


def rows(run: Run, found: Found) -> list[Row]:
    """Milliseconds, planning queries a second, and ratios; `n` counts rounds."""
    seconds: Seconds = {key: its for outcome in found["phases"] for key, its in outcome.items()}
    made = []
    for (name, what), taken in seconds.items():
        figures = {"milliseconds": 1000 * taken}
        if what.phase == "query":
            figures = {"queries_per_second": 1 / taken, "candidates_per_second": CANDIDATES / taken}
        against = AGAINST.get(name, OURS if what.phase == "all" and name != OURS else "")
        if (other := seconds.get((against, what))) is not None:
            both = min(len(taken), len(other))  # the rounds in which both took part
            made.append((f"{name} / {against}", what, "ratio", median_interval(taken[:both] / other[:both])))
        made += [(name, what, metric, median_interval(values)) for metric, values in figures.items()]
        # A subject against itself was measured at different moments, so the rounds are not paired: the medians are
        # divided, and the interval is that of the worst case.
        for label, meant, above, below, factor in (
            (DECODE, what.phase == "predict", replace(what, phase="decode"), what, 1),
            (BATCH, what.batch > 1, what, replace(what, batch=1), what.batch),
            (THREADS, what.threads > 1, replace(what, threads=1), what, 1),
        ):
            if meant and (name, above) in seconds and (name, below) in seconds:
                a, b = (median_interval(seconds[name, one]) for one in (above, below))
                value, low, high = (x / y / factor for x, y in ((a.value, b.value), (a.low, b.high), (a.high, b.low)))
                ratio = Interval(value, low, high, min(a.n, b.n))
                made.append((f"{name}: {label}", what, "ratio", ratio))
    return [interval_row(name, *what.place, metric, interval) for name, what, metric, interval in made]


_WINDOW, _PAPER, _MAGE = f"{WINDOW} / {OURS}", f"{PAPER_WINDOW} / {PAPER_CACHE}", f"MAGE / {OURS}"
# Name, method, variant, metric; of those that have a card its label, and what to read it against.
FIGURES = (
    ("window_over_cache_9_frames", _WINDOW, "predict, 9 x 1", "ratio",
     "Window over cache, 9 frames", "our prototype: 2.4 x"),
    ("window_over_cache_9_frames_batch_16", _WINDOW, "predict, 9 x 16", "ratio",
     "The same, 16 scenes", "our prototype: 4.0 x"),
    ("window_over_cache_24_frames", _WINDOW, "predict, 24 x 1", "ratio", "", ""),
    ("window_over_cache_planning", _WINDOW, QUERY, "ratio", "", ""),
    ("paper_window_over_cache_9_frames", _PAPER, "predict, 9 x 1", "ratio",
     "Window over cache, paper's sizes", "untrained"),
    ("paper_window_over_cache_9_frames_batch_16", _PAPER, "predict, 9 x 16", "ratio", "", ""),
    ("decode_over_predict_9_frames", f"{OURS}: {DECODE}", "predict, 9 x 1", "ratio",
     "Decode over predict, 9 frames", "paper's code: 10 x"),
    ("mage_over_textocvp_9_frames", _MAGE, "all, 9 x 1", "ratio", "MAGE over TextOCVP, 9 frames", "all phases"),
    ("mage_over_textocvp_9_frames_batch_16", _MAGE, "all, 9 x 16", "ratio", "", ""),
    ("batch_16_per_scene", f"{OURS}: {BATCH}", "all, 9 x 16", "ratio", "", ""),
    ("one_thread_over_all", f"{OURS}: {THREADS}", "all, 9 x 16", "ratio", "", ""),
    ("planning_queries_per_second", OURS, QUERY, "queries_per_second", "Planning queries a second", "bar: 1"),
    ("milliseconds_9_frames", OURS, "all, 9 x 1", "milliseconds", "Milliseconds, 9 frames", "one scene, all phases"),
)  # fmt: skip


def headline(run: Run) -> dict[str, Key]:
    """The figures that are asked for by name, on all threads."""
    split = threads_word(max(run.sizes.threads))
    return {name: (method, split, variant, metric) for name, method, variant, metric, *_ in FIGURES}


# --- tables and page --------------------------------------------------------------------------------------------------

_PAIRS = [*AGAINST.items(), *((key, OURS) for key in (*BASELINES, PAPER_CACHE))]
RATIOS = [Line(key=f"{name} / {other}", kind="ours" if name == WINDOW else "control") for name, other in _PAIRS]
RATIOS += [Line(key=f"{line.key}: {label}", kind="control") for label in (DECODE, BATCH, THREADS) for line in LINES]


def phase_spec(metric: str, threads: int, sizes: Sizes = DEFAULT) -> TableSpec:
    """Milliseconds or ratios of every phase on so many threads; of planning, queries a second."""
    timings = all_timings(sizes.frames, sizes.batches, [threads])
    columns = [Column(what.place[1], *what.place, metric, None) for what in timings]
    if metric == "milliseconds":
        columns.append(Column("queries a second", threads_word(threads), QUERY, "queries_per_second", None))
    return TableSpec(
        f"{metric.capitalize()}, {threads_word(threads)}",
        columns,
        RATIOS if metric == "ratio" else LINES,
        f"9 x 16: 9 frames of 16 scenes. {QUERY.capitalize()}.",
    )


def page(run: Run, results: Results, found: Found) -> list[Section]:
    """The sections of the report."""
    figures, sizes, (*_, busy) = list(results.rows), run.sizes, run.prepared
    machine = f"Measured on {results.versions['machine']}."
    if busy > 0.5:
        machine += (
            f" The machine was busy with other work when the study began (load {busy:.1f} a core): milliseconds and "
            "queries a second are too slow by about that; ratios are taken within a round and hold."
        )

    def table(spec: TableSpec) -> Table:
        """Without the lines and columns in which nothing was measured."""
        columns, measured = spec.table(figures).measured()
        columns_there = [spec.columns[c] for c in columns]
        return replace(spec, columns=columns_there, lines=[spec.lines[r] for r in measured]).table(figures)

    threads = sizes.threads[::-1]
    return [
        Section(
            "Where the time goes",
            f"{machine} Medians of repeats with their 95 % intervals (their range where there are fewer than 6). "
            "Encode: one observed frame to slots or codes. Predict: read the sentences, imagine. Decode: draw colours "
            "and masks. All: from observed frames to imagined ones. Query: what a planner asks before it acts; it "
            "needs masks at few frames, and colours at none. A dash: there is no such phase; or, at the paper's "
            f"sizes, more than {sizes.drawn} frames to draw; a quick run leaves out large batches of what is slow. "
            + " ".join(run.remarks),
            [table(phase_spec("milliseconds", n, sizes)) for n in threads],
        ),
        Section(
            "Figures that travel between machines",
            "How many times longer. Milliseconds depend on the machine, ratios much less. Where two models are "
            "compared, the ratio is taken in each round, in which both had their turn, and the median counts. "
            "Untrained models are good for timing only.",
            [table(phase_spec("ratio", n, sizes)) for n in threads],
        ),
    ]


STUDY = Study(
    name="runtime",
    title="Runtime",
    question="How long does a thought take, and which part of it?",
    sizes=lambda args: QUICK if args.quick else DEFAULT,
    methods=BASELINES,
    prepare=prepare,
    one_process=True,  # so that nothing disturbs it
    units=units,
    rows=rows,
    tables=[phase_spec("milliseconds", CORES), phase_spec("ratio", CORES)],
    page=page,
    cards=[
        CardSpec(
            label, Line(key=method), Column("", threads_word(CORES), variant, metric, None), against,
            bar=False, each="repeats",
        )
        for _, method, variant, metric, label, against in FIGURES
        if label
    ],
    headline=headline,
    first=(
        "window_over_cache_9_frames", "paper_window_over_cache_9_frames", "mage_over_textocvp_9_frames",
        "planning_queries_per_second",
    ),
    versions=lambda run: {"machine": machine_in_words()},
    again="The seed fixes what is looked at. Milliseconds differ from run to run and from machine to machine; ratios "
    "should come out alike.",
)  # fmt: skip

if __name__ == "__main__":
    start(STUDY)
