"""CATER-hard, the paper's second world: what does a caption of two actions lead to?

    python experiments/cater.py                # 60 held-out scenes
    python experiments/cater.py --quick        # a first look
    python experiments/cater.py --model savi=runs/cater/savi/checkpoint --model MAGE=runs/cater/mage/checkpoint

Each scene is imagined from its first frame and its caption, and compared with what the simulator draws: PSNR, SSIM,
LPIPS (AlexNet) over 9, 19 and all frames, overlap of masks. Then the same scenes are imagined under other captions
(other things act, do something else, end elsewhere) and judged from masks by the simulator's rules. Last, a cone that
was put over something is told to slide away: does what is inside go with it? The clips are our own renders of CATER's
world, so the paper's figures are of other pictures.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any, cast

import numpy as np

from envs.cater import Clip as Actions
from experiments.report.gif import gif
from experiments.report.page import CardSpec, Clip, Clips, Section
from experiments.report.results import Results
from experiments.report.rows import Key, Row, figure_rows
from experiments.report.tables import Column, Paper, TableSpec, quoted
from experiments.study.any_size import Film, Seen, compare, drawn, fitted, imagine, length_columns
from experiments.study.attention import glow
from experiments.study.cater import SIDE, CaterScene, Judged, cater_scenes, judge, slide_away, slots_of_things
from experiments.study.clips import extreme_clips
from experiments.study.frame_metrics import METRICS, Measures, Scorer, available_measures
from experiments.study.methods import Model, lines, with_paper
from experiments.study.pool import Unit, Worker
from experiments.study.predictions import hold_last, reach, to_tensor, to_uint8
from experiments.study.run import Found, Part, Run, ScenesArgs, Study, start
from textocvp.data.episodes import Episode, EpisodeObject
from textocvp.pictures import captioned, enlarge
from textocvp.slots import SlotState

SPLIT = "test"
LENGTHS = {"9 frames": 9, "19 frames": 19, "clip": 29}
VARIANTS = 3  # other captions of a scene
FOLLOWED = 5.0  # pixels of 64 between the slots of a cone and of what is in it, at most


def _paper(label: str, **figures: tuple[float, float]) -> Paper:
    return Paper(f"paper, {label}", quoted(SPLIT, LENGTHS, **figures), "CATER-hard at 64x64, its own renders")


PAPERS = {
    "ours": _paper("TextOCVP-SAVi", psnr=(32.98, 31.29), ssim=(0.922, 0.902), lpips=(0.036, 0.044)),
    "OCVP-Seq": _paper("OCVP-Seq", psnr=(29.08, 28.11), ssim=(0.874, 0.854), lpips=(0.078, 0.101)),
    "Non-OC": _paper("Non-OC", psnr=(29.68, 28.39), ssim=(0.874, 0.849), lpips=(0.092, 0.112)),
    "MAGE": _paper("MAGE", psnr=(34.91, 34.76), ssim=(0.877, 0.871), lpips=(0.108, 0.111)),
    "SEER": _paper("SEER", psnr=(22.05, 16.05), ssim=(0.723, 0.535), lpips=(0.245, 0.299)),
}
WORDS = ("ours, few updates", "plain attention", "colour lexicon")  # the ablation of how words find their slots
MEASURED = lines(("ours", *WORDS, "savi", "OCVP-Seq", "Non-OC", "MAGE", "true frames", "wrong text", "copy frame"))
LINES = with_paper(MEASURED, PAPERS)
CONTROL = {
    "object": "right thing moves",
    "action": "right action",
    "place": "named cell ± 1",
    "rests": "what turns stays",
}


@dataclass
class Args(ScenesArgs):
    """Arguments of the study on CATER."""

    checkpoint: str = "cater"
    """Bundled name, folder, or id on the Hugging Face hub."""


@dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    scenes: int
    variants: int  # other captions of each
    clips: int  # how many best and how many worst cases are shown


# --- units of work ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CaterUnit:
    """A unit of work: one scene, imagined by every model and every control, under every caption."""

    scene: CaterScene
    variants: int
    models: tuple[Model, ...]
    measures: Measures
    seed: int

    def run(self, worker: Worker) -> dict[tuple[str, str, str], Any]:
        """Imagine, compare, judge: (method, variant, metric) -> figure, of truths a list."""
        ours, clip = worker.world_model, self.scene.clip()
        others = [replace(self.scene, variant=k + 1) for k in range(self.variants)]
        films = {one.clip(): one.watch(SIDE) for one in (self.scene, *others)}
        truth = as_episode(clip, *films[clip])
        first, T = truth.frames[0], len(truth.frames)
        real_T3HW = to_tensor(truth.frames)
        scorer = Scorer(real_T3HW, self.measures, upper=False)
        figures: dict[tuple[str, str, str], Any] = {}
        happened = {asked: judge(labels, asked, labels[0]) for asked, (_, labels) in films.items()}
        models: dict[str, Any] = {"ours": ours, **{m.key: worker.model(m.load) for m in self.models}}
        still = Seen(real_T3HW[:1], drawn(ours.parse(truth.frames[:1], seed=self.seed), SIDE).labels)

        def measure(method: str, seen: Seen) -> None:
            figures.update(compare(scorer, method, seen, truth, LENGTHS))

        def control(method: str, shown: Mapping[Actions, Seen]) -> None:
            judged: list[Judged] = []
            for asked, seen in shown.items():
                its = judge(hold_last(seen.labels, T), asked, films[asked][1][0])
                judged += [one.where(true) for one, true in zip(its, happened[asked], strict=True)]
            for metric in (*CONTROL, "vanishes"):
                found = [getattr(one, metric) for one in judged]
                if known := [one for one in found if one is not None]:
                    figures[method, "control", metric] = float(np.mean(known))

        for name, model in models.items():
            shown = {one: imagine(worker, model, first, one.instruction, T - 1, self.seed) for one in films}
            measure(name, shown[clip])
            control(name, shown)
            if name == "ours" and len(films) > 1:
                wrong = dict(zip(films, [*list(shown.values())[1:], shown[clip]], strict=True))
                measure("wrong text", wrong[clip])
                control("wrong text", wrong)
            if hasattr(model, "rollout") and (went := follows(model, clip, truth, self.seed)) is not None:
                figures[name, "control", "hidden_follows"] = went
                figures["copy frame", "control", "hidden_follows"] = 0.0
        own = {one: drawn(ours.parse(frames, seed=self.seed), SIDE) for one, (frames, _) in films.items()}
        measure("true frames", own[clip])
        control("true frames", own)
        measure("copy frame", still)
        control("copy frame", dict.fromkeys(films, still))
        return figures


def watched(scene: CaterScene, worker: Worker | None = None) -> Episode:
    """What the simulator shows of a scene."""
    return as_episode(scene.clip(), *scene.watch(SIDE))


def as_episode(clip: Actions, frames: np.ndarray, labels: np.ndarray) -> Episode:
    """Frames (T, H, W, 3) and labels (T, H, W) of a clip."""
    objects = tuple(EpisodeObject(k, 1 + k, thing.shape, thing.color) for k, thing in enumerate(clip.things))
    return Episode(frames=frames, instruction=clip.instruction, segmentation=labels, objects=objects)


def follows(model: Any, clip: Actions, truth: Episode, seed: int) -> float | None:
    """Whether what a cone was put over goes with it when it is told to slide away, 1 or 0.

    None where no cone was put over anything that has a slot, nothing can be asked of it, or it has a twin.
    """
    act = next((act for act in clip.acts if act.into is not None), None)
    if act is None or act.to is None or not model.model.parser.layout.explicit:
        return None
    ends = {one.thing: one.to for one in clip.acts if one.to is not None}
    now = [replace(thing, place=ends.get(k, thing.place)) for k, thing in enumerate(clip.things)]
    cone, rest = now[act.thing], [thing for k, thing in enumerate(now) if k not in (act.thing, act.into)]
    acts = slide_away((cone, *rest))
    if acts is None or cone.name in {thing.name for thing in rest}:
        return None
    frame, horizon = fitted(truth.frames[0], model), reach(model, len(truth.frames) - 1)
    first = model.rollout(frame, [clip.instruction], horizon=horizon, seed=seed)
    slots = slots_of_things(first, cast(np.ndarray, truth.segmentation)[0])
    if act.thing not in slots or act.into not in slots:
        return None
    after = Actions((cone, *rest), acts)
    went = model.rollout(first.last, [after.instruction], horizon=horizon, seed=seed).positions[0]
    cone_T2, inside_T2 = went[:, slots[act.thing]], went[:, slots[act.into]]
    moved = float((cone_T2[-1] - cone_T2[0]).norm()) > FOLLOWED
    return float(moved and float((cone_T2[-1] - inside_T2[-1]).norm()) <= FOLLOWED)


COLUMNS = ("size", "colour", "material", "shape", "action", "cell x", "cell y")


@dataclass(frozen=True)
class Attention:
    """A unit of work: ours imagined, a row an action, with each slot as bright as its share of attention to a word."""

    scene: CaterScene
    seed: int

    def run(self, worker: Worker) -> Clip:
        """Imagine it once more; a word that a sentence lacks is a dark panel."""
        text, model = self.scene.clip().instruction, worker.world_model
        first = fitted(self.scene.watch(SIDE)[0][0], model)
        horizon = reach(model, LENGTHS["clip"])
        rollout = model.rollout(first, [text], horizon=horizon, seed=self.seed, attention=True)
        assert rollout.attention is not None
        frames, masks = to_uint8(rollout.frames[0]), rollout.masks[0].cpu().numpy()
        things_1K1 = SlotState.split(rollout.slots[:, 0], rollout.layout).is_thing  # the floor's slot stays dark
        shares_TKW = (rollout.attention[0].double().mean((1, 2)) * things_1K1).cpu().numpy()
        words, dark, rows = model.words(text), np.zeros_like(frames), []
        for places in shown_words(words):
            glowing = [dark if k is None else glow(frames, masks, shares_TKW[..., k]) for k in places]
            said = ["imagined", *("-" if k is None else words[k] for k in places)]
            rows.append([labelled(*panel) for panel in zip([frames, *glowing], said, strict=True)])
        panels, name = ("imagined", *COLUMNS), f"cater-attention-{self.scene.seed}.gif"
        return Clip(name, gif(rows, scale=1), panels, text, f"seed {self.scene.seed}")


def labelled(frames_THW3: np.ndarray, word: str) -> np.ndarray:
    """The frames twice as large, with a word below each."""
    return np.stack([captioned(enlarge(frame, 2), word) for frame in frames_THW3])


def shown_words(words: Sequence[str]) -> list[list[int | None]]:
    """For each sentence of a caption, the places of the words of `COLUMNS`."""
    starts = [k - 5 for k, word in enumerate(words) if word == "is"]
    rows: list[list[int | None]] = []
    for begin, end in zip(starts, [*starts[1:], len(words)], strict=True):
        said = words[begin:end]
        acts = [k for k, word in enumerate(said) if word in ("rotating", "sliding", "placed", "containing")]
        numbers = [k for k, word in enumerate(said) if word.lstrip("-").isdigit()]
        places = [1, 2, 3, 4, *acts[:1], *numbers, None, None]
        rows.append([None if place is None else begin + place for place in places[: len(COLUMNS)]])
    return rows


def models(run: Run) -> tuple[Model, ...]:
    """Those that somebody has named: the bundled ones were trained in another world."""
    return tuple(model for model in run.models if any(one.startswith(f"{model.key}=") for one in run.args.model))


def units(run: Run) -> dict[str, Part]:
    """The scenes."""
    work = [
        CaterUnit(scene, run.sizes.variants, models(run), run.measures, run.args.seed)
        for scene in cater_scenes(run.sizes.scenes, run.args.seed)
    ]
    films = Part(seconds=2.0, count=2 * run.sizes.clips)
    return {"scenes": Part(work, 8.0), "films": films, "attention": Part(seconds=2.0, count=run.sizes.clips)}


def cases(run: Run, found: Found) -> dict[str, Sequence[Unit]]:
    """Films of the scenes that look best and worst."""
    metric, scenes = run.measures.main, cater_scenes(run.sizes.scenes, run.args.seed)
    values = [figures["ours", "clip", metric] for figures in found["scenes"]]
    films = [
        Film("cater", partial(watched, scene), run.args.seed, f"{METRICS[metric]} {value:.3f}; seed {scene.seed}")
        for scene, value in zip(scenes, values, strict=True)
    ]
    attention = [Attention(scene, run.args.seed) for scene in scenes[: run.sizes.clips]]
    return {
        "films": extreme_clips(films, [*map(run.measures.badness, values)], run.sizes.clips),
        "attention": attention,
    }


def headline(run: Run) -> dict[str, Key]:
    """As asked for in the study's description; `_copy` for the first frame repeated, `_savi` for published slots."""
    named: dict[str, Key] = {}
    for method, ending in {"ours": "", "copy frame": "_copy", "savi": "_savi"}.items():
        for metric, n in product(("ssim", "lpips"), (9, 19)):
            named[f"{metric}_{n}{ending}"] = (method, SPLIT, f"{n} frames", metric)
        named[f"iou_9{ending}"] = (method, SPLIT, "9 frames", "iou")
        for metric in CONTROL:
            named[f"control_{metric}{ending}"] = (method, SPLIT, "control", metric)
        named[f"hidden_follows{ending}"] = (method, SPLIT, "control", "hidden_follows")
    return named


# --- tables and page --------------------------------------------------------------------------------------------------


FRAMES = TableSpec(
    "Frames",
    length_columns(SPLIT, LENGTHS, ("psnr", "ssim", "lpips")),
    list(LINES.values()),
    "PSNR, SSIM: higher is better; LPIPS (AlexNet): lower. A scene in which two small things act is nearly still.",
)
CONTROLS = TableSpec(
    "Masks, and what the caption leads to",
    [
        Column("mask IoU 9", SPLIT, "9 frames", "iou", 3),
        *(Column(title, SPLIT, "control", metric) for metric, title in CONTROL.items()),
        Column("inside vanishes", SPLIT, "control", "vanishes"),
        Column("it follows", SPLIT, "control", "hidden_follows"),
    ],
    list(MEASURED),
    "Each scene under its own caption and others, judged from masks, wherever the simulator's own masks show it.",
)


def page(run: Run, results: Results, found: Found) -> list[Section]:
    """The sections of the report."""
    frames, control = run.tables(list(results.rows))
    ranked = f"The best and the worst by {METRICS[run.measures.main]}."
    others = [model.key for model in run.models if model not in models(run)]  # in the table's order
    absent = [*run.remarks, *(f"{key} is absent: name one of this world, --model {key}=FOLDER." for key in others)]
    return [
        Section(
            "As in the paper's table",
            "Imagined from the first frame and the caption. The clips are our own renders of CATER's world: compare "
            "orders and distances with the paper's figures, not heights.",
            [frames],
        ),
        Section(
            "Other captions",
            "A thing moves when the middle of its mask gets further than 3 pixels; two things of one name are alike, "
            "and either may act. What it does is read off its way in the picture; where it ends, through the camera: "
            "in the named cell or in one that touches it. Masks show of what is told to turn only that it stays. What "
            "is inside a cone can be asked of models whose slots have places.",
            [control],
        ),
        Section("Films", ranked, [Clips(found["films"])]),
        Section(
            "What the words point at",
            "Each thing as bright as its share of attention to a word, a mean over layers and heads; a row an action.",
            [Clips(found["attention"])],
        ),
        Section("What is absent", " ".join(absent) or "Nothing."),
    ]


def rows(run: Run, found: Found) -> list[Row]:
    """Every figure, a mean over scenes."""
    return figure_rows((SPLIT, figures) for figures in found["scenes"])


STUDY = Study(
    name="cater",
    title="CATER-hard",
    question="Two things act at once, and two may look alike: does the caption lead to what then happens?",
    args=Args,
    sizes=lambda args: Sizes(args.scenes or 4, 1, 1) if args.quick else Sizes(args.scenes or 60, VARIANTS, 4),
    methods=[line.key for line in MEASURED],
    measures=lambda args: available_measures(["lpips"]),
    units=units,
    cases=cases,
    rows=rows,
    tables=(FRAMES, CONTROLS),
    page=page,
    cards=[
        CardSpec(f"{column.title}, {key}", LINES[key], column, bar=False)
        for key, column in (
            *product(["ours"], (*FRAMES.columns[1:3], *CONTROLS.columns[1:4])),
            ("copy frame", FRAMES.columns[2]),
        )
    ],
    headline=headline,
    first=("ssim_19", "lpips_19", "control_object", "control_place"),
)

if __name__ == "__main__":
    start(STUDY)
