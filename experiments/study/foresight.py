"""Who searches a course of sentences towards a goal, by foresight or without; and how often foresight is right."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch

from envs import Expert
from envs.tabletop import TabletopEnv
from envs.tasks.rearrange import Rearrange
from experiments.report.tables import Line
from experiments.study.pool import Worker
from experiments.study.scenes import StudyScene
from planning import (
    AnyGoal,
    AnySentencePlanner,
    BelievingPlanner,
    Foresees,
    Grounder,
    Grounding,
    LiteralPlanner,
    PictureGoal,
    Planner,
    SearchPlanner,
    SegmentationGrounder,
    Thing,
    Wanted,
    observe,
    places,
    seen_supports,
)
from planning.masks import centroids
from planning.planners import frames_ahead
from textocvp.protocols import LoadModel
from textocvp.rollout import Rollout

CASES = ("plain", "occupied", "covered", "both")
"""What a sentence finds: nothing on the thing and nothing at the target; something at the target, on the thing, or at
both."""
SENTENCES = 6  # that are played in a row in each of its scenes
BUDGETS = (15, 60, 250, 1000)  # sentences that a plan may imagine
MakeSearch = Callable[[Foresees, int], Planner]


class ByFilms:
    """A model without a predictor of whole sentences: it foresees where one leads by its whole film."""

    def __init__(self, model: Foresees) -> None:
        self.parse, self.rollout, self.longest_horizon = model.parse, model.rollout, model.longest_horizon

    def outcome(self, obs: Rollout, text: Sequence[str], *, seed: int = 0) -> Rollout:
        """See `Foresees`."""
        film = self.rollout(obs, text, horizon=frames_ahead(self), seed=seed)
        return replace(film, slots=film.slots[:, [0, -1]])


def foresight(model: object) -> Foresees:
    """The model, or what makes it foresee."""
    foresees = cast(Foresees, model)
    return foresees if getattr(model, "foresees", True) else ByFilms(foresees)


@dataclass
class TrueSlotsPlanner(SearchPlanner):
    """The same search, but slots are named and placed by the simulator's segmentation. A ceiling row."""

    def look(self, rgb: np.ndarray, goal: AnyGoal, grounder: Grounder) -> tuple[Rollout, Grounding, Wanted]:
        """See `SearchPlanner.look`; what hides in the picture stays where it was parsed."""
        parsed, grounding, wanted = super().look(rgb, goal, grounder)
        assert isinstance(grounder, SegmentationGrounder)
        positions_1K2 = parsed.positions[:, -1].clone()
        for item in grounder.objects:
            slots = list(grounding.things.get(Thing(item["color"], item["kind"]), ()))
            mask_HW = torch.as_tensor(grounder.segmentation == item["label"])
            if slots and mask_HW.any():
                positions_1K2[:, slots] = centroids(mask_HW)
        return parsed.moved(positions_1K2, [""]).last, grounding, wanted


@dataclass(frozen=True, kw_only=True)
class Searcher(Line):
    """A line of the tables, and the planner behind it; None for the scripted search in the simulator."""

    plan: MakeSearch | None = None
    privileged: bool = False  # whether the simulator's segmentation says which slot is what
    pictures: bool = True  # whether it takes pictures as goals; for these there is no segmentation either


def _with_budget(budget: int) -> MakeSearch:
    return lambda model, seed: SearchPlanner(model, budget=budget)


OURS = "ours"
LINES: dict[str, Searcher] = {
    line.key: line
    for line in (
        Searcher(key=OURS, hue=0, note="searches what it foresees", plan=_with_budget(BUDGETS[-1])),
        Searcher(key="no imagination", kind="control", hue=2, pictures=False,
                 note="carries out the goal's own sentences, in order",
                 plan=lambda model, seed: LiteralPlanner(model)),
        Searcher(key="believes", kind="control", hue=4, note="the same search; every sentence comes true as it says",
                 plan=lambda model, seed: BelievingPlanner(model)),
        Searcher(key="random", kind="control", hue=5, note="any sentence that the scene allows",
                 plan=lambda model, seed: AnySentencePlanner(model, rng=np.random.default_rng(seed))),
        Searcher(key="ours, slots from the simulator", kind="ceiling", hue=3, privileged=True, pictures=False,
                 note="the same, but slots are named and placed by the simulator's segmentation",
                 plan=lambda model, seed: TrueSlotsPlanner(model, budget=BUDGETS[-1])),
        Searcher(key="simulator", kind="ceiling", hue=1, note="searches in a copy of the simulator, knows every pose"),
    )
}  # fmt: skip
"""Who is measured in every family."""
CURVE = {
    f"budget {budget}": Searcher(key=f"budget {budget}", hue=0, note="ours", plan=_with_budget(budget))
    for budget in BUDGETS[:-1]
}


@dataclass(frozen=True)
class Foreseen:
    """What was foreseen of one scene: for each case, of each sentence whether it was right."""

    method: str
    right: Mapping[str, Sequence[bool]]


@dataclass(frozen=True)
class Foresight:
    """A unit of work: random sentences, one after another, each foreseen before it is played."""

    scene: StudyScene
    seed: int
    method: str = OURS
    load: LoadModel | None = None  # as of `Episode`

    def run(self, worker: Worker) -> Foreseen:
        """Play and compare: right is what ends with every block carried by what it was foreseen to be carried by."""
        env = worker.environment(self.scene, record=False)
        observation, info = env.reset(seed=self.scene.seed, options=dict(self.scene.options))
        base, rng = cast(TabletopEnv, env.unwrapped), np.random.default_rng([self.seed, self.scene.seed])
        model = foresight(worker.model(self.load))
        task = cast(Rearrange, base.task)
        right: dict[str, list[bool]] = {case: [] for case in CASES}
        for _ in range(SENTENCES):
            pairs = task.sentences(base.scene.objects, "seen")
            pair = pairs[int(rng.integers(len(pairs)))]
            text = task.scene(base.scene.objects, (pair,)).instruction
            before, grounder = info["supports"], SegmentationGrounder.from_info(info)
            parsed, grounding = observe(model, observation["rgb"], PictureGoal(observation["rgb"]), grounder)
            things = sorted(grounding.things)
            ends_1N2 = places(model.outcome(parsed, [text]), grounding, things)
            foreseen = seen_supports(ends_1N2, things, grounding.view)[0]
            observation, *_, info = env.step(Expert(env).primitive(pair))
            named = [Thing(item["color"], item["kind"]) for item in info["objects"]]
            carriers = [None if at < 0 else named[at] for at in info["supports"]]
            true = {one: at for one, at in zip(named, carriers, strict=True) if one.kind == "block"}
            covered = pair.thing in before
            taken = any(at == pair.target and one != pair.thing for one, at in enumerate(before))
            case = CASES[2 * covered + taken]
            right[case].append(foreseen == true)
        return Foreseen(self.method, right)
