"""Interpretability: does the slot of the thing that a sentence names attend to the word that names it?

    python experiments/interpretability.py              # default: a few minutes on 2 cores
    python experiments/interpretability.py --quick      # a first look

Reads the text-to-slot attention of imagined rollouts (paper, section 4.5): which words each slot attends to, head by
head and over time, and one number, how often the slot of the named block (bowl) is the one that attends most to its
colour word. Scenes of three splits are imagined with their instruction: test, controllability (also with three other
target bowls) and unseen_colors, whose captions also use colour names that no training caption had. Beside it: chance,
the same slots under a sentence that names something else, and the model with its colour-matching term switched off,
because that term alone could decide. Writes `results.json`, `report.html`, plots and clips into `--out`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from envs.colors import SEEN
from experiments.report.gif import gif
from experiments.report.page import CardSpec, Clip, Clips, Figure, Section
from experiments.report.plots import curve_plot, heat_grid, heat_map
from experiments.report.results import Results
from experiments.report.rows import Key, figure_rows
from experiments.report.tables import Column, Line, TableSpec, columns
from experiments.study.attention import (
    COLOR_WORDS,
    GROUPS,
    TEMPLATE,
    AttentionReading,
    color_term,
    ends_in_bowl,
    glow,
    imagine,
    read_attention,
    without_color_term,
)
from experiments.study.clips import extremes_by_scene, tone
from experiments.study.judge import find_things
from experiments.study.mask_metrics import mean_known
from experiments.study.pool import Worker
from experiments.study.predictions import to_uint8
from experiments.study.run import Found, Part, Run, Study, UsageError, start
from experiments.study.scenes import StudyScene, sample_scene, study_scenes, wrong_text
from planning import RELATIONS, AppearanceGrounder, Grounding, Instruction, SegmentationGrounder
from textocvp import Rollout, WorldModel
from textocvp.metrics.intervals import bootstrap_interval

ROLES = ("block", "bowl")
VARIANTS = 3
VARIED = "controllability"  # the split whose scenes have enough bowls for other instructions
COLUMNS = {
    "test": ("test", "original"),
    "4 bowls, original": (VARIED, "original"),
    "4 bowls, other bowls": (VARIED, "variants mean"),
    "unseen colours": ("unseen_colors", "original"),
    "new names": ("unseen_colors", "new names"),
}
"""Column of the tables -> (split, variant in results.json)."""
OURS, BY_APPEARANCE = "ours", "ours, by looks"
NO_COLOR_TERM, COLOR_TERM = "colour term off", "colour term alone"
WRONG, CHANCE = "wrong sentence", "chance"
METRICS = tuple(f"attends_{role}" for role in ROLES)
ENDS = "ends_in_bowl"


@dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    scenes: int  # of each split
    clips: int  # how many best and how many worst cases are shown


# --- units of work ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class AttentionOutcome:
    """What was read of a scene with V texts: its own instruction and its variants."""

    scene: StudyScene
    # method -> what was read: V readings, one of `WRONG`, none of what the model does not have. Slots are named by the
    # simulator's segmentation of the first frame, for measuring only, except for `BY_APPEARANCE`.
    readings: Mapping[str, Sequence[AttentionReading]]
    figures: Mapping[tuple[str, str, str], Any]  # see `figure_rows`


@dataclass(frozen=True)
class AttentionScene:
    """A unit of work: one scene and its texts."""

    scene: StudyScene
    variants: int  # how many other target bowls are named as well
    seed: int  # of the slots

    def run(self, worker: Worker) -> AttentionOutcome:
        """Imagine, name the slots, read the attention."""
        model = worker.world_model
        sampled = sample_scene(worker.environment(self.scene), self.scene, self.variants)
        parsed = model.parse(sampled.observation["rgb"][None], seed=self.seed)
        present_K = parsed.presence[0, 0].numpy() >= 0.5
        texts, wrong = sampled.texts, wrong_text(sampled)
        asked = [Instruction.parse(text) for text in texts]
        truth = SegmentationGrounder.from_info(sampled.info)(parsed)
        seen = find_things(parsed, AppearanceGrounder.from_info(sampled.info), asked) or Grounding((), ())

        def read(
            attention: Sequence[np.ndarray], rollout: Rollout, things: Grounding = truth
        ) -> list[AttentionReading]:
            # What is read under the wrong sentence is for the scene's own.
            return [
                read_attention(one_TnhKW, present_K, things, one, ends_in_bowl(rollout, b, things, one))
                for b, (one_TnhKW, one) in enumerate(zip(attention, [*asked, asked[0]], strict=False))
            ]

        attention, rollout = imagine(model, parsed, [*texts, wrong], self.seed)
        *ours, misread = read(attention, rollout)
        without = without_color_term(model)
        readings = {
            BY_APPEARANCE: read(attention[:-1], rollout, seen),
            COLOR_TERM: read(color_term(model, parsed, texts, present_K), rollout) if without else [],
            OURS: ours,
            NO_COLOR_TERM: read(*imagine(without, parsed, texts, self.seed)) if without else [],
            WRONG: [misread],
        }
        figures = scene_figures(asked[0], Instruction.parse(wrong), readings)
        return AttentionOutcome(self.scene, readings, figures)


def scene_figures(
    own: Instruction, wrong: Instruction, readings: Mapping[str, Sequence[AttentionReading]]
) -> dict[tuple[str, str, str], Any]:
    """Figures of a scene, of its own instruction and the wrong one; see `AttentionOutcome`."""
    figures: dict[tuple[str, str, str], Any] = {}
    both, several = range(len(ROLES)), len(readings[OURS]) > 1
    for variant, texts, roles in (
        ("original", slice(0, 1), both),
        ("variants mean", slice(1, None), both if several else ()),
        # what no training caption named
        ("new names", slice(0, 1), [r for r in both if own.things[r].color not in SEEN]),
    ):
        chosen = {method: its[texts] for method, its in readings.items() if its[texts]}
        for r in roles:
            for method, its in chosen.items():
                if method != WRONG or own.things[r] != wrong.things[r]:
                    figures[method, variant, METRICS[r]] = [one.most_R[r] for one in its]
            figures[CHANCE, variant, METRICS[r]] = np.mean([one.chance_R[r] for one in chosen[OURS]])
            if leads := [one.lead_R[r] for one in chosen[OURS] if np.isfinite(one.lead_R[r])]:
                figures[OURS, variant, f"lead_{ROLES[r]}"] = np.mean(leads)
        for method in (OURS, NO_COLOR_TERM, WRONG):
            if roles and method in chosen:
                figures[method, variant, ENDS] = [one.ends_in_bowl for one in chosen[method]]
    for method in (OURS, NO_COLOR_TERM):
        for r, n, h in np.ndindex(readings[method][0].most_Rnh.shape) if several and readings[method] else ():
            name = f"{method}, layer {n + 1} head {h + 1}"
            figures[name, "all", METRICS[r]] = [one.most_Rnh[r, n, h] for one in readings[method]]
    return figures


@dataclass(frozen=True)
class AttentionPicture:
    """A unit of work: attention to the colour words, painted over what is imagined in one case of the study."""

    scene: StudyScene
    variants: int  # see `AttentionScene`
    seed: int
    variant: int  # which of its texts
    lead: float  # what it is chosen for: the smaller one of the two things, -inf if one has no slot
    success: bool  # whether both named things attend most to their colour words
    best: bool = True
    rank: int = 1  # its place among the best or the worst

    def run(self, worker: Worker) -> Clip:
        """Imagine it once more, and paint."""
        sampled = sample_scene(worker.environment(self.scene), self.scene, self.variants)
        parsed = worker.world_model.parse(sampled.observation["rgb"][None], seed=self.seed)
        text, kind = sampled.texts[self.variant], "best" if self.best else "worst"
        (attention_TnhKW,), rollout = imagine(worker.world_model, parsed, [text], self.seed)
        frames_THW3, masks_TKHW = to_uint8(rollout.frames[0]), rollout.masks[0].cpu().numpy()
        shares_TKW = attention_TnhKW.mean((1, 2))
        glowing = [glow(frames_THW3, masks_TKHW, shares_TKW[..., word]) for word in COLOR_WORDS]
        figure = f"lead {self.lead:.3f}" if np.isfinite(self.lead) else "a named thing has no slot"
        return Clip(
            name=f"attention-{kind}-{self.rank}.gif",
            gif=gif([[frames_THW3, *glowing]]),
            panels=("imagined", *(f'"{thing.color}"' for thing in Instruction.parse(text).things)),
            title=text,
            caption=f"{self.scene.split.replace('_', ' ')}, seed {self.scene.seed}; {figure}",
            badge=f"{kind} {self.rank}: {'both attend most' if self.success else 'missed'}",
            tone=tone(self.success),
        )


def check_model(run: Run) -> None:
    """Refuse a model that reads no text."""
    model = run.world_model
    if isinstance(model, WorldModel) and not model.model.predictor.uses_text:
        raise UsageError(f"{run.args.checkpoint} reads no text, so there is no attention to look at")


def units(run: Run) -> dict[str, Part]:
    """The scenes of every split."""
    seed, splits = run.args.seed, dict.fromkeys(split for split, _ in COLUMNS.values())
    scenes = [
        AttentionScene(scene, VARIANTS if split == VARIED else 0, seed)
        for split in splits
        for scene in study_scenes(split, run.sizes.scenes, seed)
    ]
    return {"scenes": Part(scenes), "pictures": Part((), 1.5, 2 * min(run.sizes.clips, len(scenes)))}


def extreme_cases(outcomes: Sequence[AttentionOutcome], seed: int, count: int) -> list[AttentionPicture]:
    """The cases with the largest and the smallest lead of the named things, each of another scene."""
    every = [
        AttentionPicture(o.scene, len(o.readings[OURS]) - 1, seed, v, float(one.lead_R.min()), bool(one.most_R.all()))
        for o in outcomes
        for v, one in enumerate(o.readings[OURS])
    ]  # fmt: skip
    return extremes_by_scene(every, [-case.lead for case in every], count)


def headline(run: Run) -> dict[str, Key]:
    """The figures that are asked for by name; those of the colour term only where the model has one."""
    endings = {"original": "", "variants mean": "_variants", "new names": "_new_names"}
    wanted: dict[str, Key] = {}
    for metric in (*METRICS, ENDS):
        for split, variant in COLUMNS.values():
            wanted[f"{metric}_{split}{endings[variant]}"] = (OURS, split, variant, metric)
        for method in (NO_COLOR_TERM, WRONG, CHANCE):
            wanted[f"{metric}_{method.replace(' ', '_')}"] = (method, VARIED, "original", metric)
    return wanted


# --- tables and page --------------------------------------------------------------------------------------------------

LINES = {
    line.key: line
    for line in (
        Line(key=OURS, note="slots named by the simulator's segmentation, for measuring only"),
        Line(key=BY_APPEARANCE, note="slots named by their appearance, as the planner does it"),
        Line(key=NO_COLOR_TERM, kind="control", note="the same weights without the term that compares colours"),
        Line(key=COLOR_TERM, kind="control", note="that term alone: whose colour is nearest to the word's, no network"),
        Line(key=WRONG, kind="control", note="under a sentence that names other things: should be near 0"),
        Line(key=CHANCE, kind="control", note="one guess among the slots that are present"),
    )
}  # fmt: skip
ATTENDS_TABLES = [
    TableSpec(f"The named {role} attends most to its colour word", columns(metric, COLUMNS), [*LINES.values()])
    for role, metric in zip(ROLES, METRICS, strict=True)
]
ENDS_LINES = [LINES[method] for method in (OURS, NO_COLOR_TERM, WRONG)]
ENDS_TABLE = TableSpec("The named block ends in the named bowl", columns(ENDS, COLUMNS), ENDS_LINES)


def page(run: Run, results: Results, found: Found) -> list[Section]:
    """The sections of the report."""
    here = [one.readings for one in found["scenes"] if one.scene.split == VARIED]
    methods = [method for method in (OURS, NO_COLOR_TERM) if here[0][method]]
    every = {method: [one for readings in here for one in readings[method]] for method in methods}
    maps_nhGW = mean_known([one.map_nhGW for one in every[OURS]])
    there = [g for g in range(len(GROUPS)) if not np.isnan(maps_nhGW[:, :, g]).any()]
    groups, maps_nhGW = [GROUPS[g] for g in there], maps_nhGW[:, :, there]
    layers = [f"layer {n + 1}" for n in range(len(maps_nhGW))]
    heads = [f"head {h + 1}" for h in range(maps_nhGW.shape[1])]
    by_head = [
        heat_map(f"heads_{role}{ending}.png", np.mean([one.most_Rnh[r] for one in every[method]], axis=0), layers,
                 heads, label="attends most", top=1.0, caption=f"{method}: the named {role} and its colour word.")
        for method, ending in zip(methods, ("", "_no_colour_term"), strict=False)
        for r, role in enumerate(ROLES)
    ]  # fmt: skip
    sections = [
        Section(
            "How often does the named thing attend most?",
            "Every slot divides its attention among the words: its shares sum to 1, less what special tokens get. It "
            "attends most to a word if its share for that word is larger than that of every other present slot, table "
            "included. Shares are averaged over steps, layers and heads first. A named thing without a slot counts as "
            "a miss. New names: the scenes in which the thing's colour name is in no training caption.",
            [table.table(results.rows) for table in ATTENDS_TABLES],
        ),
        Section(
            "Head by head, and what each thing attends to",
            "The same figure for each layer and head by itself, over all instructions of the scenes with 4 bowls. And "
            "the mean share of each thing's slots for each word, over scenes, instructions and steps.",
            [
                *by_head,
                heat_map("attention.png", maps_nhGW.mean((0, 1)), groups, SHORT_WORDS,
                         label="attention to words", caption="Mean over layers and heads."),
                heat_grid("attention_heads.png", maps_nhGW, groups, TEMPLATE,
                          [[f"{layer}, {head}" for head in heads] for layer in layers],
                          label="attention to words", caption="Head by head. All maps share one scale."),
            ],
        ),
        Section(
            "Over time",
            "For the two colour words while the arm reaches, carries and retreats; mean over layers and heads. Bands "
            "are 95 % intervals over scenes.",
            curves([readings[OURS] for readings in here]),
        ),
        Section(
            "Seen over the picture",
            "The cases in which the named things lead the most and the least. Each slot glows with its share of "
            "attention to the block's colour word and to the bowl's.",
            [Clips(found["pictures"])],
        ),
    ]  # fmt: skip
    if NO_COLOR_TERM in methods:
        text = (
            "This predictor adds to the attention logits how well a slot's colour fits the lexicon's colour of the "
            "word. With its learned gains set to 0 in a copy of the model, one sees what the rest has learned, and "
            f"whether the motion still ends within {RELATIONS['in'].within_px:g} px of the named bowl. The copy was "
            "not trained without the term: this says what these weights rely on, not what could be learned."
        )
        ends = ENDS_TABLE.table(results.rows)
        sections.insert(1, Section("Does the colour-matching term decide it?", text, [ends]))
    return sections


SHORT_WORDS = [word.replace("'s colour", "\ncolour") for word in TEMPLATE]


def curves(readings: Sequence[Sequence[AttentionReading]]) -> list[Figure]:
    """Step by step: the share of each group for each colour word, and how often the named thing attends most.

    Args:
        readings: of each scene. Its texts are not independent, so they are averaged first.
    """
    shares_NRTG = np.array([mean_known([one.shares_RTG for one in its]) for its in readings])
    most_NRT = np.array([np.mean([one.most_RT for one in its], axis=0) for its in readings])
    drawn = []
    for r, role in enumerate(ROLES):
        shares = [(group, curve(shares_NRTG[:, r, :, g])) for g, group in enumerate(GROUPS)]
        known, label = [one for one in shares if len(one[1])], f"share for the {role}'s colour"
        drawn.append(curve_plot(f"shares_{role}.png", known, label=label, across="step"))
    most = [(f"named {role}", curve(most_NRT[:, r])) for r, role in enumerate(ROLES)]
    marks = [(float(np.mean([one.chance_R for its in readings for one in its])), "chance")]
    return [*drawn, curve_plot("most.png", most, label="attends most", across="step", marks=marks)]


def curve(values_NT: np.ndarray) -> np.ndarray:
    """(T, 3) mean over scenes, low, high; without the scenes that have no such thing, and empty if all have none."""
    known_NT = values_NT[~np.isnan(values_NT).any(1)]
    intervals = [bootstrap_interval(column, resamples=500) for column in known_NT.T if len(known_NT)]
    return np.array([(one.value, one.low, one.high) for one in intervals])


_, PLAIN, OTHERS, _, NEW = COLUMNS.values()

STUDY = Study(
    name="interpretability",
    title="Which slot attends to which word",
    question="Does the slot of the thing that a sentence names attend to the word that names it?",
    sizes=lambda args: Sizes(scenes=30 if args.quick else 150, clips=10),
    prepare=check_model,
    units=units,
    cases=lambda run, found: {"pictures": extreme_cases(found["scenes"], run.args.seed, run.sizes.clips)},
    rows=lambda run, found: figure_rows((one.scene.split, one.figures) for one in found["scenes"]),
    tables=[*ATTENDS_TABLES, ENDS_TABLE],
    page=page,
    cards=[
        CardSpec(label, LINES[method], Column("", *place, metric), compare)
        for label, method, place, metric, compare in (
            ("Block, original", OURS, PLAIN, METRICS[0], "not in the paper"),
            ("Bowl, original", OURS, PLAIN, METRICS[1], "not in the paper"),
            ("Bowl, three other bowls", OURS, OTHERS, METRICS[1], "not in the paper"),
            ("Block, new colour names", OURS, NEW, METRICS[0], "not in the paper"),
            ("Bowl, wrong sentence", WRONG, PLAIN, METRICS[1], "should be near 0"),
            ("Chance", CHANCE, PLAIN, METRICS[1], "one guess among the slots"),
            ("Bowl, colour term off", NO_COLOR_TERM, PLAIN, METRICS[1], "what the rest has learned"),
            ("Ends in bowl, colour term off", NO_COLOR_TERM, PLAIN, ENDS, "what the motion owes to it"),
        )
    ],
    headline=headline,
)

if __name__ == "__main__":
    start(STUDY)
