"""Goals of one, two and three steps in the closed loop: who chooses the steps, and does anybody look again?

In most of these scenes the order of the steps does not matter, because no two of them share a bowl. In the scenes of
the column `bowl taken` it does: one named block lies in the bowl that another is to go into, and a bowl has room for
one, so the bowl must be emptied first. The sentence names the two moves in the order that does not work.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import gymnasium as gym
import numpy as np

from envs import Expert, format_instruction, parse_instruction
from envs.geometry import Sizes
from envs.sampling import SceneRequest, sample_scene
from envs.splits import SPLITS
from experiments.protocol.gallery import Picture, pixels
from experiments.protocol.predicted import HORIZON
from experiments.protocol.scenes import SCENES_PER_SEED, Drawn, TestScene, draw, test_scenes
from experiments.protocol.workers import Worker
from experiments.reporting import Clip
from experiments.reporting.clips import gif
from planning import EpisodeResult, Goal, Planner, RandomSequencePlanner, SequencePlanner, run_episode

TAKEN = "bowl_taken"
FIRST_TAKEN = 4_000  # seeds of the test split that no other study uses


@dataclass(frozen=True)
class LongColumn:
    """A column of the tables: its name, its split and how many steps its goals need."""

    name: str
    split: str
    steps: int


LONG_COLUMNS = (
    LongColumn("one step", "test", 1),
    LongColumn("two steps", "two_steps", 2),
    LongColumn("three steps", "three_steps", 3),
    LongColumn("bowl taken", TAKEN, 2),
)


@dataclass(frozen=True)
class LongMethod:
    """A row of the tables.

    Attributes:
        name: of the row.
        chooser: who chooses the steps. `plan`: the world model's best imagined sequence, among those that put no block
            into a bowl where another is seen. `plan, no rule`: among all. `told`: they are the goal's
            own, in random order. `random`: as many random instructions. `expert`: the scripted expert in an order
            that works. `as written`: the scripted expert in the sentence's order.
        replan: whether somebody looks again after every action, and chooses anew while the goal is not seen reached.
    """

    name: str
    chooser: Literal["plan", "plan, no rule", "told", "random", "expert", "as written"]
    replan: bool = False

    def plays(self, column: LongColumn) -> bool:
        """Whether it is a row of that column."""
        return self.chooser not in ("as written", "plan, no rule") or column.split == TAKEN


METHODS = (
    LongMethod("ours, replanning", "plan", True),
    LongMethod("ours, one plan", "plan"),
    LongMethod("ours without the rule, replanning", "plan, no rule", True),
    LongMethod("random order, replanning", "told", True),
    LongMethod("random order, one plan", "told"),
    LongMethod("random sequence, replanning", "random", True),
    LongMethod("random sequence, one plan", "random"),
    LongMethod("expert", "expert"),
    LongMethod("expert, order as written", "as written"),
)


def long_scenes(column: LongColumn, count: int, seed: int) -> list[TestScene]:
    """`count` scenes of a column; each `seed` chooses other ones."""
    if column.split != TAKEN:
        return test_scenes(column.split, count, seed)
    first = SCENES_PER_SEED * seed + FIRST_TAKEN
    return [taken_scene(SPLITS["test"].seed(first + i)) for i in range(count)]


def taken_scene(seed: int) -> TestScene:
    """A scene with a goal of two pairs, the second of whose blocks lies in the first one's bowl."""
    # Another stream than the environment's own (the bare seed) and the splits' (1).
    scene = sample_scene(np.random.default_rng([seed, 3]), SceneRequest(n_pairs=2), Sizes())
    (_, wanted), (inside, _) = scene.goal
    layout = []
    for index, item in enumerate(scene.objects):
        at = scene.objects[wanted] if index == inside else item
        layout.append({"kind": item.kind, "color": item.color, "xy": (at.x, at.y), "yaw": item.yaw})
    options = (("instruction", scene.instruction), ("layout", tuple(layout)))
    return TestScene(TAKEN, seed, options, steps=2)


@dataclass(frozen=True)
class LongOutcome:
    """What came of one episode.

    Attributes:
        episode: which one.
        text: the goal.
        success: the simulator's verdict.
        gained: share of the goal's pairs that hold at the end, by the simulator; none holds at the start.
        believes_reached: the planner's own verdict; None for the expert.
        instructions: what was carried out, in order.
        planning_seconds: mean time of a plan; None without one.
        error: why the loop gave up, or None.
    """

    episode: LongEpisode
    text: str
    success: bool
    gained: float
    believes_reached: bool | None
    instructions: tuple[str, ...]
    planning_seconds: float | None
    error: str | None

    @property
    def empties_first(self) -> bool:
        """Whether the first step was one that the goal asks for and that another one's place depends on."""
        pairs = parse_instruction(self.text)
        return bool(self.instructions) and self.instructions[0] == format_instruction([pairs[-1]])


@dataclass(frozen=True)
class LongEpisode:
    """A unit of work: one method, one scene."""

    method: LongMethod
    scene: TestScene
    seed: int = 0

    def run(self, worker: Worker) -> LongOutcome:
        """Play the episode."""
        env = worker.environment(self.scene)
        drawn = draw(env, self.scene)
        text = drawn.texts[0]
        if self.method.chooser in ("expert", "as written"):
            return self._by_expert(env, drawn)
        result = self.pursue(worker, drawn)
        return LongOutcome(
            episode=self,
            text=text,
            success=result.success,
            gained=round(result.gained, 6),
            believes_reached=result.believes_reached,
            instructions=tuple(attempt.instruction.text for attempt in result.attempts),
            planning_seconds=result.planning_seconds if result.attempts else None,
            error=result.error,
        )

    def pursue(self, worker: Worker, drawn: Drawn) -> EpisodeResult:
        """Plan and act until the goal is believed to be reached, or plan or attempts are used up."""
        return run_episode(
            worker.environment(self.scene),
            self._planner(worker),
            Goal.parse(drawn.texts[0]),
            seed=self.scene.seed,
            options=drawn.options(0),
            replan=self.method.replan,
        )

    def _planner(self, worker: Worker) -> Planner:
        if self.method.chooser in ("plan", "plan, no rule"):
            rule = self.method.chooser == "plan"
            return SequencePlanner(worker.world_model, horizon=HORIZON, one_a_bowl=rule, seed=self.seed)
        told = self.method.chooser == "told"
        # Seeded by the scene too: one stream for all episodes would depend on their order. With and without another
        # look the first sequence is the same.
        rng = np.random.default_rng([self.seed, self.scene.seed, int(told)])
        return RandomSequencePlanner(worker.world_model, rng, told, horizon=HORIZON, seed=self.seed)

    def _by_expert(self, env: gym.Env[Any, Any], drawn: Drawn) -> LongOutcome:
        pairs = parse_instruction(drawn.texts[0])
        works = self.scene.split == TAKEN and self.method.chooser == "expert"
        pairs = pairs[::-1] if works else pairs
        _, info = env.reset(seed=self.scene.seed, options=drawn.options(0))
        gained = 0.0
        for action in Expert(env).actions(format_instruction(pairs)):
            _, reward, _, _, info = env.step(action)
            gained += float(reward)
        done = tuple(format_instruction([pair]) for pair in pairs)
        return LongOutcome(
            self, drawn.texts[0], bool(info["is_success"]), round(gained, 6), None, done, None, None
        )


@dataclass(frozen=True)
class LongPicture:
    """A unit of work: draw one episode."""

    outcome: LongOutcome
    column: str
    rank: int

    def run(self, worker: Worker) -> Picture:
        """Play it once more."""
        outcome, episode = self.outcome, self.outcome.episode
        result = episode.pursue(worker, draw(worker.environment(episode.scene), episode.scene))
        imagined = [pixels(attempt.rollout) for attempt in result.attempts] or [result.frames[:1]]
        # Every other frame: films of three steps and more are long.
        films = [np.concatenate(imagined)[::2], result.frames[::2]]
        done = "; ".join(text.removeprefix("put ") for text in outcome.instructions) or "nothing"
        clip = Clip(
            name=f"long-{self.rank}.gif",
            gif=gif([films], seconds_a_frame=0.2),
            panels=("the plan, imagined", "what happened"),
            title=outcome.text,
            caption=f"{self.column}, {episode.method.name}, seed {episode.scene.seed}; done: {done}"
            + (f"; {outcome.error}" if outcome.error else ""),
            badge="success" if outcome.success else f"{outcome.gained:.0%} of the goal",
            tone="good" if outcome.success else "bad",
        )
        return Picture(clip)


def choose_long(outcomes: list[LongOutcome], count: int) -> list[LongPicture]:
    """Up to `count` failures of ours, one from each column in turn, then as many successes, longest goals first."""
    columns = {column.split: column.name for column in LONG_COLUMNS}
    ours = [o for o in outcomes if o.episode.method.chooser == "plan"]
    turns: list[tuple[int, int, LongOutcome]] = []
    for split in columns:
        failures = [o for o in ours if o.episode.scene.split == split and not o.success]
        turns += [(i, -o.episode.scene.steps, o) for i, o in enumerate(failures)]
    failures = [o for _, _, o in sorted(turns, key=lambda turn: turn[:2])][:count]
    successes = sorted((o for o in ours if o.success), key=lambda o: -o.episode.scene.steps)[:count]
    return [
        LongPicture(o, columns[o.episode.scene.split], rank)
        for rank, o in enumerate(failures + successes, start=1)
    ]
