"""Long goals: can the world model imagine several steps ahead, and what does looking again buy?

    python experiments/long_horizon.py              # default: about 12 minutes on 2 cores
    python experiments/long_horizon.py --quick      # a first look
    python experiments/long_horizon.py --full       # 100 scenes a column

Goals of one, two and three steps, and goals whose order matters because a bowl is taken and must be emptied first.
Ours: the planner imagines sequences of instructions, each step from where the last imagined one ended, and carries
out the best; with replanning it looks again after every action. Beside it: the goal's own steps in random order, which
shows what carrying out alone achieves; random steps; and the scripted expert. The simulator alone judges.
Writes `results.json`, `timings.json`, `report.html`, plots and clips into `--out`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from envs import TASKS
from envs.geometry import Sizes as ObjectSizes
from envs.splits import SPLITS
from experiments.report.page import CardSpec, Clips, Section
from experiments.report.plots import plot_table
from experiments.report.results import Results
from experiments.report.rows import Row, mean_row, rate_row
from experiments.report.tables import Cell, Column, Line, TableSpec, columns
from experiments.study.clips import episode_clips
from experiments.study.closed_loop import LoopEpisode, LoopOutcome, planning_seconds, timings
from experiments.study.methods import HORIZON, METHODS, PLANNERS, MakePlanner, Method
from experiments.study.pool import Unit
from experiments.study.run import Found, FullArgs, Part, Run, Study, start
from experiments.study.scenes import SCENES_PER_SEED, StudyScene, study_scenes
from planning import BeamPlanner, Goal, RandomPlanner

TAKEN = "bowl_taken"
FIRST_TAKEN = 4_000  # seeds of the test split that no other study uses
PLACES = {
    "one step": "test", "two steps": "two_steps", "three steps": "three_steps", "bowl taken": TAKEN,
}  # fmt: skip
"""Columns of the tables: title (also `variant` of the rows) -> split."""
SUCCESS = "closed_loop_success"


# --- who chooses the steps --------------------------------------------------------------------------------------------


def search() -> MakePlanner:
    """Imagines sequences of as many steps as the goal still needs."""
    return lambda model, goal, rng, seed: BeamPlanner(model, horizon=HORIZON, seed=seed)


def draw(**options: bool) -> MakePlanner:
    """Draws such sequences."""
    return lambda model, goal, rng, seed: RandomPlanner(model, rng, horizon=HORIZON, seed=seed, **options)  # type: ignore


def pair(method: Method, looking_again: str, one_plan: str) -> list[Method]:
    """The lines of a planner, and their notes: with another look after every action, and without."""
    again = replace(method, key=f"{method.key}, replanning", note=looking_again)
    return [again, replace(method, key=f"{method.key}, one plan", note=one_plan, replan=False)]


OURS = ("ours, replanning", "ours, one plan")
ANY_ORDER, ANY_STEPS = "random order, one plan", "random sequence, one plan"
EXPERT, AS_WRITTEN = "expert", "expert, order as written"
IN_ALL_STUDIES = [METHODS[key] for key in PLANNERS if not (METHODS[key].expert or METHODS[key].privileged)]
LINES = {
    line.key: line
    for line in (
        *pair(Method(key="ours", plan=search()), "imagine sequences, do the best one's first step, look, imagine again",
              "the first plan is carried out to its end, whatever happens"),
        # Any other planner of `METHODS`; these two are here in another form.
        *(line for one in IN_ALL_STUDIES if one.key not in ("ours", "random candidate")
          for line in pair(one, one.note, one.note)),
        *pair(Method(key="random order", kind="control", plan=draw(from_goal=True), chance=1),
              "told the goal's steps; only their order is left to chance",
              "the same, carried out without another look"),
        *pair(Method(key="random sequence", kind="control", plan=draw()),
              "as many random steps; drawn again after every action", "as many random steps"),
        replace(METHODS["expert"], key=EXPERT, note="scripted, knows every pose, and empties a taken bowl first"),
        replace(METHODS["expert"], key=AS_WRITTEN, kind="control",
                note="the expert without thinking: shows that order matters"),
    )
}  # fmt: skip
"""Who is measured, by key."""
ONLY_TAKEN = (AS_WRITTEN,)  # of interest only where the order matters


# --- units of work ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    scenes: tuple[int, ...]  # of each column, for every method
    clips: int  # how many failures and how many successes the report shows at most


QUICK, DEFAULT, FULL = Sizes((4, 4, 3, 3), clips=2), Sizes((20,) * 4, clips=10), Sizes((100,) * 4, clips=10)


def long_scenes(split: str, count: int, seed: int) -> list[StudyScene]:
    """`count` scenes of a column; each `seed` chooses other ones."""
    if split != TAKEN:
        return study_scenes(split, count, seed)
    first = SCENES_PER_SEED * seed + FIRST_TAKEN
    return [taken_scene(SPLITS["test"].seed(first + i)) for i in range(count)]


def taken_scene(seed: int) -> StudyScene:
    """A scene with a goal of two steps, the second of whose blocks lies in the first one's bowl.

    The sentence names them in the order that does not work: a bowl has room for one block.
    """
    task = TASKS["put_blocks_in_bowls"]
    # Another stream than the environment's own (the bare seed) and the splits' (1).
    scene = task.sample(np.random.default_rng([seed, 3]), task.request(2), ObjectSizes())
    first, second = scene.goal
    layout = []
    for index, item in enumerate(scene.objects):
        at = scene.objects[first.target] if index == second.thing else item
        layout.append({"kind": item.kind, "color": item.color, "xy": (at.x, at.y), "yaw": item.yaw})
    options = (("instruction", scene.instruction), ("layout", tuple(layout)))
    return StudyScene(TAKEN, seed, options, steps=2)


@dataclass(frozen=True)
class LongEpisode(LoopEpisode):
    """A unit of work: one line of the tables, one scene."""

    methods = LINES

    def order(self, goal: Goal) -> tuple[str, ...]:
        """What the expert does: an order that works, unless it shall keep to the sentence's."""
        written = super().order(goal)
        return written[::-1] if self.scene.split == TAKEN and self.method != AS_WRITTEN else written


def column_of(episode: LoopEpisode) -> str:
    """Title of its column."""
    return next(title for title, split in PLACES.items() if split == episode.scene.split)


def units(run: Run) -> dict[str, Part]:
    """Every episode of each column, scene by scene, so that all methods fill up together."""
    parts = {}
    for (title, split), count in zip(PLACES.items(), run.sizes.scenes, strict=True):
        scenes = long_scenes(split, count, run.args.seed)
        episodes = [
            LongEpisode(key, scene, seed=run.args.seed)
            for scene in scenes
            for key in LINES
            if split == TAKEN or key not in ONLY_TAKEN
        ]
        parts[title] = Part(episodes, float(scenes[0].steps if scenes else 1))
    return {**parts, "clips": Part(seconds=4.0, count=2 * run.sizes.clips)}


def outcomes_of(found: Found) -> list[LoopOutcome]:
    """Of all columns."""
    return [o for title in PLACES for o in found[title]]


def cases(run: Run, found: Found) -> dict[str, Sequence[Unit]]:
    """Episodes of ours."""
    return {"clips": episode_clips(outcomes_of(found), lambda e: f"{column_of(e)}, {e.method}", run.sizes.clips, OURS)}


# --- rows -------------------------------------------------------------------------------------------------------------


def rows(run: Run, found: Found) -> list[Row]:
    """Every figure of every line and column, as far as there are outcomes."""
    made = []
    for key, (title, split) in product(LINES, PLACES.items()):
        here = [o for o in found[title] if o.episode.method == key]
        if not here:
            continue
        place = key, split, title
        made.append(rate_row(*place, SUCCESS, [o.success for o in here]))
        made.append(rate_row(*place, "subgoals_reached", [o.gained for o in here]))
        made.append(mean_row(*place, "steps", [o.steps for o in here]))
        if all(o.believes_reached is not None for o in here):
            made.append(rate_row(*place, "wrong_belief", [o.believes_reached != o.success for o in here]))
        if split == TAKEN:
            made.append(rate_row(*place, "empties_first", [empties_first(o) for o in here]))
    return made


def empties_first(outcome: LoopOutcome) -> bool:
    """Whether the first step was the one that another one's place depends on."""
    return outcome.instructions[:1] == (Goal.parse(outcome.text).instructions[-1].text,)


HEADLINE = {
    f"{name}_{title.replace(' ', '_')}": (key, split, title, SUCCESS)
    for key, name in (
        (OURS[0], "closed_loop"), (OURS[1], "closed_loop_one_plan"), (ANY_ORDER, "random_order_one_plan"),
        (ANY_STEPS, "random_sequence_one_plan"), (EXPERT, "expert"),
    )
    for title, split in PLACES.items()
}  # fmt: skip


# --- tables and page --------------------------------------------------------------------------------------------------

COLUMNS = {title: (split, title) for title, split in PLACES.items()}
GOALS = TableSpec("Whole goal reached", columns(SUCCESS, COLUMNS), [*LINES.values()])
PARTS = TableSpec("Share of sub-goals reached", columns("subgoals_reached", COLUMNS), [*LINES.values()])
DETAILS = TableSpec(
    "Actions, beliefs and planning time",
    columns("", COLUMNS),
    [
        Line(key=key, kind=LINES[key].kind, metric=metric, label=f"{label}, {key}", digits=digits, note=note)
        for keys, metric, label, digits, note in (
            ((*OURS, EXPERT), "steps", "pick-and-places", 1, ""),
            (OURS, "wrong_belief", "wrong belief", 2, "the planner's verdict at the end is not the simulator's"),
            ((OURS[1], ANY_ORDER), "empties_first", "empties the bowl first", 2, ""),
            (OURS[:1], "seconds", "seconds a plan", 2, "on one core, as busy as it was; not in results.json"),
        )
        for key in keys
    ],
)
PLOTTED = [
    Line(key=key, label=label, hue=hue)
    for key, label, hue in (
        (OURS[0], "replanning", 0), (OURS[1], "one plan", 3), (ANY_ORDER, "random order", 1),
        (ANY_STEPS, "random steps", 2),
    )
]  # fmt: skip


def page(run: Run, results: Results, found: Found) -> list[Section]:
    """The sections of the report."""
    figures = list(results.rows)
    for title, value in planning_seconds(outcomes_of(found), column_of).get(OURS[0], {}).items():
        figures.append(Row(OURS[0], *COLUMNS[title], "seconds", value, value, value, 1))
    caption = "Dots with 95 % intervals over scenes; all but the first carry out one plan."
    success = plot_table("success.png", GOALS, figures, label="whole goal reached", caption=caption, lines=PLOTTED)
    return [
        Section(
            "Whole goals",
            "A goal of n steps names n blocks and a bowl for each. With one plan, n actions are made; with replanning, "
            "up to three times as many. In the first three columns the order of the steps does not matter, because no "
            "two of them share a bowl: the row with the goal's own steps in random order then shows what carrying out "
            "alone achieves, and what is lost against it was lost by choosing. In the last column one of the blocks "
            "lies in the bowl that the other is to go into, and the sentence names the moves in the order that does "
            "not work. No rule tells the planner so: it has to imagine it.",
            [GOALS.table(figures), success],
        ),
        Section(
            "Parts of goals",
            "How much of the goal holds at the end, by the simulator; nothing of it holds at the start.",
            [PARTS.table(figures), DETAILS.table(figures)],
        ),
        Section(
            "Planned beside executed",
            "Failures first, then the longest goals that were reached. Left: the course that each action was read off, "
            "one after another. Right: the camera.",
            [Clips(found["clips"])] if found["clips"] else [],
        ),
    ]


def cards(run: Run, results: Results) -> list[CardSpec]:
    """Ours in every column, and what carrying out alone achieves."""
    wanted = [
        ("Two steps, order left to chance", ANY_ORDER, "two steps", "told the steps"),
        ("Bowl taken, order left to chance", ANY_ORDER, "bowl taken", "order matters"),
        ("Two steps, random steps", ANY_STEPS, "two steps", "the floor"),
        ("Bowl taken, expert as written", AS_WRITTEN, "bowl taken", "must be 0"),
    ]
    for title in reversed(PLACES):
        compare = f"one plan {Cell.of(results.find(OURS[1], title, SUCCESS)).text}"
        wanted.insert(0, (f"{title.capitalize()}, replanning", OURS[0], title, compare))
    return [CardSpec(label, LINES[k], Column("", *COLUMNS[t], SUCCESS), text) for label, k, t, text in wanted]


STUDY = Study(
    name="long_horizon",
    title="Long goals",
    question="Can a robot that imagines several steps ahead reach goals that need them, and what does it gain by "
    "looking again after every step?",
    args=FullArgs,
    sizes=lambda args: QUICK if args.quick else FULL if args.full else DEFAULT,
    horizon=HORIZON,
    units=units,
    cases=cases,
    rows=rows,
    tables=(GOALS, PARTS),
    page=page,
    cards=cards,
    headline=lambda run: HEADLINE,
    first=(
        "closed_loop_two_steps", "closed_loop_three_steps", "closed_loop_bowl_taken",
        "closed_loop_one_plan_three_steps",
    ),
    files=lambda run, found: timings(outcomes_of(found), column_of),
)  # fmt: skip

if __name__ == "__main__":
    start(STUDY)
