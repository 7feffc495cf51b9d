"""Runtime: where the time goes, what the cache saves, and how many plans a second a robot can think through.

    python experiments/runtime.py              # default: about 10 minutes on 2 cores
    python experiments/runtime.py --quick      # a first look, on all cores only
    python experiments/runtime.py --checkpoint runs/polish/checkpoint

Milliseconds for 1, 9 and 24 imagined frames, for one scene and for 16, encode, predict and decode apart, on one
thread and on all: the shipped model, the same without its cache and in the published form (a window computed again at
every step), the baselines that are there, and the paper's own sizes with random weights, which is good for timing and
nothing else. Competitors take turns in every round, so ratios hold on a busy machine too; they are the figures that
travel between machines. Writes `results.json`, `report.html` and a plot into `--out`.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
import torch
from scipy.stats import binom

from experiments.report.page import Card, CardSpec, Section
from experiments.report.plots import plot_table
from experiments.report.results import Results
from experiments.report.rows import Key, Row, interval_row
from experiments.report.tables import Column, Line, Table, TableSpec
from experiments.study.methods import BASELINES, Missing, lines
from experiments.study.pool import Worker, available_cores
from experiments.study.run import Found, Part, Run, Study, UsageError, start
from experiments.study.scenes import SampledScene, StudyScene, sample_scene, study_scenes
from planning import AppearanceGrounder, Instruction, measure_rollout, watched_frames
from planning.scores import DEFAULT_CRITERION, DEFAULT_SCORE
from textocvp.baselines.mage import Mage, MageVideoModel, mage_preset
from textocvp.config import ModelConfig
from textocvp.metrics.intervals import Interval
from textocvp.model import TextOCVP
from textocvp.presets import preset
from textocvp.protocols import VideoModel
from textocvp.rollout import Rollout
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
CORES = available_cores()
FEWEST = 3  # rounds that are always made, however long they take

Phase = Literal["encode", "predict", "decode", "all", "query", "imagine", "masks"]
PHASES: tuple[Phase, ...] = ("encode", "predict", "decode", "all")
PLANNING: tuple[Phase, ...] = ("query", "imagine", "masks")
Work = Callable[[], object]
Name = TypeVar("Name")


@dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    frames: tuple[int, ...]  # numbers of imagined frames
    batches: tuple[int, ...]  # numbers of scenes at once
    repeats: int  # rounds of each measurement
    seconds: float  # for all models together; what has used its share of them is measured 3 times only
    # Frames of all scenes together, at most: that are drawn at the paper's sizes, as each takes half a second (0 leaves
    # these sizes out), and that what is slower than the shipped model by far is asked for.
    drawn: int
    heavy: int = 1_000_000
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


Seconds = Mapping[tuple[str, Timing], np.ndarray]
"""(name of who was timed, what was timed) -> (rounds,) seconds."""


def threads_word(count: int) -> str:
    """As `2 threads`."""
    return f"{count} thread" + ("s" if count > 1 else "")


def all_timings(frames: Sequence[int], batches: Sequence[int], threads: Sequence[int]) -> list[Timing]:
    """Every measurement, small before large, and planning last."""
    shapes = [("encode", 1), *product(PHASES[1:], frames)]
    made = [Timing(phase, t, b, n) for n, b, (phase, t) in product(threads, batches, shapes)]
    return made + [Timing(phase, STEPS, CANDIDATES, n) for n, phase in product(threads, PLANNING)]


# --- how time is taken ------------------------------------------------------------------------------------------------


def race(
    works: Mapping[Name, Work], repeats: int, seconds: float, clock: Callable[[], float] = time.perf_counter
) -> dict[Name, np.ndarray]:
    """(rounds,) seconds of each piece of work, after one round that does not count.

    In every round each has its turn, starting with another one, so that whatever else the machine does meets all of
    them alike and the ratio of two of them in one round means something. What has used its equal share of `seconds`
    takes no part after the third of `repeats` rounds, so that it does not cut short what is quick.
    """
    for work in works.values():
        work()
    taken: dict[Name, list[float]] = {name: [] for name in works}
    for number in range(repeats):
        running = [
            name
            for name, rounds in taken.items()
            if len(rounds) == number and (number < FEWEST or sum(rounds) < seconds / len(works))
        ]
        turn = number % max(1, len(running))
        for name in running[turn:] + running[:turn]:
            began = clock()
            works[name]()
            taken[name].append(clock() - began)
    return {name: np.array(rounds) for name, rounds in taken.items()}


def median_interval(values: np.ndarray, confidence: float = 0.95) -> Interval:
    """A median and its distribution-free interval: from one order statistic to another.

    With fewer than 6 values no such interval reaches 95 %; it is then their range.

    Raises:
        ValueError: if there is no value.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    n = len(ordered)
    if n == 0:
        raise ValueError("no values to take a median of")
    # P(the median lies between the k-th smallest and the k-th largest) = 1 - 2 P(Binomial(n, 1/2) < k)
    k = max(1, int(binom.ppf((1 - confidence) / 2, n, 0.5)))
    return Interval(float(np.median(ordered)), float(ordered[k - 1]), float(ordered[n - k]), n)


def machine_in_words() -> str:
    """What figures in seconds depend on, without the machine's name."""
    told = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").is_file() else ""
    named = [line.partition(":")[2].strip() for line in told.splitlines() if line.startswith("model name")]
    processor = named[0] if named else platform.machine() or "unknown processor"
    return (
        f"{CORES} core{'s' if CORES != 1 else ''} ({processor}), PyTorch {torch.__version__} in float32, "
        f"Python {platform.python_version()}, {platform.system()}"
    )


# --- what is timed ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Subject:
    """A model in its phases. What comes before a phase is computed once and not timed."""

    name: str  # of its rows
    model: VideoModel
    phases: tuple[Phase, ...] = PHASES  # that are asked for
    drawn: int | None = None  # the most frames of all scenes together that it is asked to draw
    heavy: bool = False  # whether it takes so long that a first look leaves out its large measurements
    cached: bool = True  # whether keys and values are kept

    def work(self, what: Timing, sampled: Sequence[SampledScene]) -> Work | None:
        """The work of a measurement; None for what the model cannot do or is not asked."""
        longest, count = self.model.longest_horizon, what.frames * what.batch
        too_many = what.phase in ("decode", "all") and self.drawn is not None and count > self.drawn
        if what.phase not in self.phases or (longest is not None and what.frames > longest) or too_many:
            return None
        if what.phase in PLANNING:
            return planning_work(self.model, what.phase, sampled[0])
        images_BHW3 = np.stack([one.observation["rgb"] for one in sampled[: what.batch]])
        texts = [one.texts[0] for one in sampled[: what.batch]]
        if what.phase == "all":
            return lambda: self.model.imagine(images_BHW3, texts, horizon=what.frames)
        cut = self._codes if isinstance(self.model, MageVideoModel) else self._slots
        with torch.no_grad():
            return torch.no_grad()(cut(what, images_BHW3, texts))

    def _slots(self, what: Timing, images_BHW3: np.ndarray, texts: list[str]) -> Work:
        assert isinstance(self.model, WorldModel)
        world_model, model = self.model, self.model.model
        if what.phase == "encode":
            return lambda: world_model.parse(images_BHW3[:, None])
        parsed = world_model.parse(images_BHW3[:, None])
        seed_B1KD = parsed.slots
        if what.phase == "predict":
            options = {"use_cache": self.cached}
            return lambda: model.predictor.rollout(seed_B1KD, model.text(texts), what.frames, **options)
        # Slots of the observation will do: what slots hold does not change what drawing them costs.
        slots_BTKD = seed_B1KD.expand(-1, what.frames, -1, -1)
        rest = tuple(texts), parsed.image_size, model.parser.layout, model.renderer, None, parsed.seen
        return lambda: Rollout(slots_BTKD, *rest).frames

    def _codes(self, what: Timing, images_BHW3: np.ndarray, texts: list[str]) -> Work:
        assert isinstance(self.model, MageVideoModel)
        model = self.model.model
        frames_B3HW = torch.from_numpy(images_BHW3).permute(0, 3, 1, 2).float() / 127.5 - 1
        if what.phase == "encode":
            return lambda: model.vqvae.encode(frames_B3HW)
        seen_B1hw = model.vqvae.encode(frames_B3HW)[:, None]
        if what.phase == "predict":
            return lambda: model.axial.imagine(seen_B1hw, model.text(texts), what.frames)
        codes_Nhw = seen_B1hw.expand(-1, what.frames, -1, -1).flatten(0, 1)
        return lambda: model.vqvae.decode(codes_Nhw)


def subjects_of(run: Run) -> list[Subject]:
    """Ours in its forms, the baselines that are there, and the paper's sizes."""
    ours, missing, drawn = run.world_model, list(run.missing), run.sizes.drawn
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
            missing.append(Missing(one.key, f"it looks at frames of {model.image_size} pixels"))
        else:
            phases = PHASES if isinstance(model, (WorldModel, MageVideoModel)) else ("all",)
            subjects.append(Subject(one.key, model, phases, heavy=isinstance(model, MageVideoModel)))
    torch.manual_seed(0)
    if "MAGE" in {
        absent.key for absent in missing
    }:  # how long it takes does not depend on what it has learned
        missing.append(Missing("MAGE (trained)", "it was timed with random weights"))
        subjects.append(Subject("MAGE", MageVideoModel(Mage(mage_preset("mage-small"))), heavy=True))
    run.missing = tuple(missing)
    if drawn:
        config = preset("savi-cater")
        paper = TextOCVP(config)
        causal = replace(config, predictor=replace(config.predictor, attention="causal", window=STEPS))
        subjects.append(Subject(PAPER_WINDOW, WorldModel(paper), drawn=drawn, heavy=True))
        subjects.append(Subject(PAPER_CACHE, reshaped(paper, causal), ("predict", "all"), drawn, heavy=True))
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
    """What a planner asks for once, or one of its costly parts.

    Parse the picture, find the things in it, imagine 30 candidates for 24 frames, draw the masks that the scorer looks
    at, score and judge.

    Raises:
        GroundingError: if the goal's things are not seen.
    """
    assert isinstance(model, WorldModel)
    image_1HW3, ground = sampled.observation["rgb"][None], AppearanceGrounder.from_info(sampled.info)
    goal, parsed = Instruction.parse(sampled.texts[0]), model.parse(image_1HW3)
    frames = watched_frames(STEPS + 1, DEFAULT_CRITERION.thresholds.settle_frames, STRIDE)
    allowed = ground(parsed).with_kinds(goal.things).instructions(goal.relation)
    texts = [allowed[i % len(allowed)].text for i in range(CANDIDATES)]

    def query() -> object:
        parsed = model.parse(image_1HW3)
        grounding = ground(parsed).with_kinds(goal.things)
        rollout = model.rollout(parsed, texts, horizon=STEPS)
        trace = measure_rollout(rollout, grounding, goal, frames=frames)
        return DEFAULT_SCORE(trace), DEFAULT_CRITERION(trace)

    if phase == "query":
        return query
    if phase == "imagine":
        return lambda: model.rollout(parsed, texts, horizon=STEPS)
    rollout = model.rollout(parsed, texts, horizon=STEPS)
    # A selection of it each time: what a rollout has drawn it does not draw again.
    return lambda: rollout.select(slice(None)).decode_masks(frames)


# --- units of work ----------------------------------------------------------------------------------------------------


def prepare(run: Run) -> tuple[list[Subject], list[SampledScene], float]:
    """Who is timed, what they look at, and how busy the cores were before: 0 idle, 1 all busy, more if work queued."""
    busy = os.getloadavg()[0] / CORES if hasattr(os, "getloadavg") else 0.0
    scenes = study_scenes("test", max(run.sizes.batches), run.args.seed)
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
        works = {
            (one.name, what): work
            for one in subjects
            if not (one.heavy and what.frames * what.batch > sizes.heavy)
            and (work := one.work(what, sampled)) is not None
        }
        taken = race(works, sizes.repeats, sizes.seconds * (2 if what.phase in PLANNING else 1))
        torch.set_num_threads(1)  # as for every unit of a study
        return taken


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
                value, low, high = (
                    x / y / factor for x, y in ((a.value, b.value), (a.low, b.high), (a.high, b.low))
                )
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
    ("milliseconds_9_frames", OURS, "all, 9 x 1", "milliseconds", "9 frames, one scene", "all phases"),
)  # fmt: skip


def headline(run: Run) -> dict[str, Key]:
    """The figures that are asked for by name, on all threads."""
    split = threads_word(max(run.sizes.threads))
    return {name: (method, split, variant, metric) for name, method, variant, metric, *_ in FIGURES}


# --- tables and page --------------------------------------------------------------------------------------------------

_PAIRS = [*AGAINST.items(), *((key, OURS) for key in (*BASELINES, PAPER_CACHE))]
RATIOS = [
    Line(key=f"{name} / {other}", kind="ours" if name == WINDOW else "control") for name, other in _PAIRS
]
RATIOS += [
    Line(key=f"{line.key}: {label}", kind="control") for label in (DECODE, BATCH, THREADS) for line in LINES
]


def phase_spec(metric: str, threads: int, batch: int, frames: Sequence[int] = DEFAULT.frames) -> TableSpec:
    """Milliseconds or ratios of every phase for one number of threads and one batch."""
    made = [
        t
        for t in all_timings(frames, [batch], [threads])
        if t.phase in PHASES or (batch == 1 and (metric, t.phase) != ("milliseconds", "query"))
    ]
    titles = [
        f"{t.phase} {t.frames} x {t.batch}" if t.phase in PLANNING else f"{t.phase} {t.frames}" for t in made
    ]
    return TableSpec(
        f"{'Ratios' if metric == 'ratio' else 'Milliseconds'}, {threads_word(threads)}, batch {batch}",
        [Column(title, *t.place, metric, None) for title, t in zip(titles, made, strict=True)],
        RATIOS if metric == "ratio" else LINES,
    )


def planning_spec(threads: int) -> TableSpec:
    """Planning queries and candidates a second."""
    place = Timing("query", STEPS, CANDIDATES, threads).place
    words = {"queries a second": "queries_per_second", "candidates a second": "candidates_per_second"}
    made = [Column(title, *place, metric, None) for title, metric in words.items()]
    return TableSpec(f"Planning, {threads_word(threads)}", made, LINES[:2], f"{QUERY.capitalize()}.")


def page(run: Run, results: Results, found: Found) -> list[Section]:
    """The sections of the report."""
    figures, sizes, (*_, busy) = list(results.rows), run.sizes, run.prepared
    machine = f"Measured on {results.versions['machine']}."
    if busy > 0.5:
        machine += (
            f" The machine was busy with other work when the study began (load {busy:.1f} a core): milliseconds and "
            "queries a second are too slow by about that; ratios are taken within a round and hold."
        )

    def tables(metric: str) -> list[Table]:
        """Without the lines in which nothing was measured."""
        made = []
        for threads, batch in product(reversed(sizes.threads), sizes.batches):
            spec = phase_spec(metric, threads, batch, sizes.frames)
            measured = [line for line in spec.lines if any(spec.points(figures, line))]
            made.append(replace(spec, lines=measured).table(figures))
        return made

    count, most = 9 if 9 in sizes.frames else sizes.frames[-1], max(sizes.threads)
    drawn = phase_spec("milliseconds", most, 1, (count,))
    # The paper's sizes take many times longer: on one axis with them nothing else could be told apart.
    small = [line for line in LINES if line.key not in (PAPER_WINDOW, PAPER_CACHE)]
    caption = f"{count} frames of one scene, {threads_word(most)}; the paper's sizes are in the tables."
    shown = replace(drawn, columns=drawn.columns[: len(PHASES)], lines=small)
    plot = plot_table("phases.png", shown, figures, label="milliseconds", limits=None, caption=caption)
    return [
        Section(
            "Where the time goes",
            f"{machine} Medians of repeats with their 95 % intervals (their range where there are fewer than 6). "
            "Encode: one observed frame to slots or codes. Predict: read the sentences, imagine. Decode: draw colours "
            "and masks. All: from observed frames to imagined ones. A dash: there is no such phase; or, at the "
            f"paper's sizes, more than {sizes.drawn} frames to draw; a quick run also leaves out large batches of what "
            "is slow. " + " ".join(run.remarks),
            [*tables("milliseconds"), plot],
        ),
        Section(
            "Figures that travel between machines",
            "How many times longer. Milliseconds depend on the machine, ratios much less. Where two models are "
            "compared, the ratio is taken in each round, in which both had their turn, and the median counts. "
            "Untrained models are good for timing only.",
            tables("ratio"),
        ),
        Section(
            "Thinking before acting",
            "One query parses the picture, finds the things in it, imagines every candidate, draws the masks that the "
            "scorer looks at, scores and judges. A planner needs masks at few frames, and colours at none.",
            [planning_spec(threads).table(figures) for threads in reversed(sizes.threads)],
        ),
    ]


def cards(run: Run, results: Results) -> list[Card]:
    """What the cache saves, what drawing costs, and how fast a robot thinks."""
    made, units = [], {"ratio": " x", "milliseconds": " ms"}
    for _, method, variant, metric, label, compare in FIGURES:
        column = Column("", threads_word(max(run.sizes.threads)), variant, metric, None)
        card = CardSpec(label, Line(key=method), column, compare, bar=False, each="repeats").fill(results)
        if label:
            made.append(replace(card, value=card.value + (units.get(metric, "") if card.detail else "")))
    return made


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
    tables=[
        phase_spec("milliseconds", CORES, 1), phase_spec("ratio", CORES, 1), phase_spec("ratio", CORES, 16),
        planning_spec(CORES),
    ],
    page=page,
    cards=cards,
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
